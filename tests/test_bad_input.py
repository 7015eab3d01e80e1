"""What goes wrong for users, through the command line: exit 2, one error that says what to do, nothing half-written."""

from __future__ import annotations

import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import safetensors.torch
import torch
from conftest import make_tiny
from small_run import recipe, write
from test_artifacts_refused import forge
from test_cli import ROOT, aegis, refused  # noqa: F401  (aegis is a fixture)

from aegis_cli import artifacts
from aegis_cli import recipe as recipes
from aegis_cli.events import Progress
from aegis_cli.recipe import Model, PretrainRecipe
from aegis_cli.stages import train

PRETRAIN = PretrainRecipe(name="vlm", scenes=8, probe_questions=7, steps=2, batch_size=4, model=Model(width=32, depth=2, heads=2))
NAN = float("nan")


@pytest.fixture
def place(tmp_path: Path, tiny_folder: Path, demos_file: Path, anchor_file: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with everything a user has: recipes, demonstrations, an anchor, and something that is no folder."""
    folder = tmp_path / "place"
    folder.mkdir()
    write(folder, tiny_folder)
    (folder / "vlm.yaml").write_text(recipes.to_yaml(PRETRAIN))
    for name, source in (("demos", demos_file), ("anchor", anchor_file), ("model", tiny_folder / "model.safetensors")):
        (folder / f"{name}.safetensors").write_bytes(source.read_bytes())
    (folder / "file").write_text("not a folder")
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory, tiny_folder: Path, demos_file: Path, anchor_file: Path) -> Path:
    """A finished run; read only."""
    out = tmp_path_factory.mktemp("runs") / "x"
    train.run(recipe(tiny_folder), "aegis", demos_file, anchor_file, out)
    return out


def snapshot(folder: Path) -> dict[str, bytes | None]:
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None for p in folder.rglob("*")}


@pytest.fixture
def bad(aegis, place: Path) -> Callable[..., str]:  # noqa: F811
    """Run a command that has to be refused and leave the folder as it was; returns the error."""

    def call(*args: object, says: tuple[str, ...] = ()) -> str:
        before = snapshot(place)
        code, out, err = aegis(*args)
        assert (code, out) == (2, "") and "Traceback" not in err
        assert re.findall(r"^(found|expected|fix):", err, re.MULTILINE) == ["found", "expected", "fix"], err
        assert snapshot(place) == before
        assert [word for word in says if word not in err] == [], err
        return err

    return call


TRAIN = ("train", "small.yaml", "--method", "aegis", "--demos", "demos.safetensors", "--anchor", "anchor.safetensors", "--out", "runs")


def training(**changes: str) -> tuple[str, ...]:
    """The training command with the values of some options changed."""
    args = list(TRAIN)
    for option, value in changes.items():
        args[args.index(f"--{option}") + 1] = value
    return tuple(args)


# --- recipes -------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", [TRAIN, ("run", "small.yaml", "--out", "runs")])
@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("trian: {steps: 5}", ("'trian'", "'train'")),
        ("train: {stesp: 5}", ("stesp", "'train.steps'")),
        ("train: {steps: many}", ("train.steps", "'many'", "whole number")),
        ("train: 5", ("train", "5")),
        ("methods: [naive, aegsi]", ("aegsi", "'aegis'")),
        ("task: raech", ("raech", "'reach'")),
        ("demos: {episodes: 0}", ("demos.episodes", "above 0")),
        ("rollout: {episodes: 0}", ("rollout.episodes", "above 0")),
        ("train: {backbone_lr: .nan}", ("train.backbone_lr",)),
    ],
)
def test_recipes(command: tuple[str, ...], line: str, says: tuple[str, ...], bad: Callable[..., str], place: Path) -> None:
    (place / "small.yaml").write_text(f"name: small\n{line}\n")
    bad(*command, says=("small.yaml", *says))


def test_all_mistakes_of_a_recipe_come_at_once(bad: Callable[..., str], place: Path) -> None:
    (place / "small.yaml").write_text("name: small\ntask: raech\ntrain: {stesp: 5, batch_size: -1}\n")
    bad(*TRAIN, says=("problems", "raech", "stesp", "train.batch_size"))


# --- files that are not there, not whole, or not ours --------------------------------------------


@pytest.mark.parametrize(
    ("command", "missing"),
    [
        (("train", "nothing.yaml", *TRAIN[2:]), "nothing.yaml"),
        (training(demos="nothing.safetensors"), "nothing.safetensors"),
        (training(anchor="nothing.safetensors"), "nothing.safetensors"),
        ((*TRAIN, "--set", "backbone=nothing"), "nothing"),
        (("anchor", "--backbone", "nothing", "--out", "a.safetensors"), "nothing"),
        (("probe", "nothing"), "nothing"),
        (("probe", "model.safetensors", "--baseline", "nothing", "--questions", "7"), "nothing"),
        (("rollout", "nothing", "--episodes", "1"), "nothing"),
        (("inspect", "nothing"), "nothing"),
        (("pretrain", "nothing.yaml"), "nothing.yaml"),
        (("run", "nothing.yaml"), "nothing.yaml"),
        (("run", "small.yaml", "--set", "backbone=nothing", "--set", "methods=[naive]", "--out", "file"), "file"),
    ],
)
def test_missing_files(command: tuple[str, ...], missing: str, bad: Callable[..., str]) -> None:
    bad(*command, says=(missing,))


def test_a_method_that_needs_an_anchor(bad: Callable[..., str]) -> None:
    without = [word for word in TRAIN if word not in ("--anchor", "anchor.safetensors")]
    bad(*without, says=("'aegis'", "--anchor"))


READERS = [
    ("demos", TRAIN),
    ("anchor", TRAIN),
    ("model", ("probe", "model.safetensors", "--questions", "7")),
    ("model", ("anchor", "--backbone", "model.safetensors", "--out", "a.safetensors")),
    ("demos", ("inspect", "demos.safetensors")),
]


@pytest.mark.parametrize(("victim", "command"), READERS)
@pytest.mark.parametrize("keep", [0.0, 0.5, 0.99])
def test_truncated_files(keep: float, victim: str, command: tuple[str, ...], bad: Callable[..., str], place: Path) -> None:
    path = place / f"{victim}.safetensors"
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data))])
    bad(*command, says=(path.name, "truncated"))


@pytest.mark.parametrize(("victim", "command"), READERS)
def test_foreign_files(victim: str, command: tuple[str, ...], bad: Callable[..., str], place: Path) -> None:
    path = place / f"{victim}.safetensors"
    safetensors.torch.save_file({"weight": torch.zeros(3)}, path, {"format": "pt"})
    bad(*command, says=(path.name, "another program wrote it"))


@pytest.mark.parametrize(
    "command",
    [training(demos="anchor.safetensors"), training(anchor="demos.safetensors"), ("probe", "demos.safetensors"), ("rollout", "demos.safetensors")],
)
def test_files_in_each_others_place(command: tuple[str, ...], bad: Callable[..., str]) -> None:
    bad(*command)


def test_a_checkpoint_that_lost_a_part(bad: Callable[..., str], trained: Path, place: Path) -> None:
    run = place / "run"
    shutil.copytree(trained, run, symlinks=True)
    (run / "checkpoints/last/expert.safetensors").write_bytes(b"")
    bad("rollout", "run", "--episodes", "1", says=("expert.safetensors", "truncated"))
    (run / "checkpoints/last/backbone/model.safetensors").unlink()
    bad("probe", "run", "--questions", "7", says=("'run'",))
    (run / "checkpoints/last").unlink()
    bad("rollout", "run", "--episodes", "1", says=("no checkpoint in 'run'", "aegis train"))


# --- inputs that do not belong together ----------------------------------------------------------


def test_an_anchor_of_another_backbone(bad: Callable[..., str], place: Path) -> None:
    make_tiny(seed=1).save(place / "other")
    ours, other = (artifacts.read_header(place / name).fingerprint for name in ("model.safetensors", "other/model.safetensors"))
    says = ("anchor.safetensors", ours[:12], other[:12], "aegis anchor")
    bad(*TRAIN, "--set", "backbone=other", says=says)
    bad("probe", "other", "--anchor", "anchor.safetensors", "--questions", "7", says=says)


def test_demonstrations_of_another_task(bad: Callable[..., str]) -> None:
    bad(*TRAIN, "--set", "task=point", says=("'reach'", "'point'", "--set task=reach"))


@pytest.mark.parametrize("episodes", [0, 1])
def test_an_empty_dataset(episodes: int, bad: Callable[..., str], place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """None at all is no demonstrations file; one leaves nothing to validate on."""
    tensors, header = artifacts.load("demos.safetensors").tensors, artifacts.read_header("demos.safetensors")
    frames = int(tensors["episode_starts"][episodes])
    cut = {name: tensors[name][:frames].clone() for name in ("frames", "proprio", "actions")}
    cut |= {name: tensors[name][:episodes].clone() for name in ("instruction", "target_color")}
    cut["episode_starts"] = tensors["episode_starts"][: episodes + 1].clone()
    with monkeypatch.context() as patch:  # a careless program
        patch.setattr(artifacts, "_validate", lambda *_: None)
        artifacts.save("empty.safetensors", "demos", cut, meta=header.meta)
    bad(*training(demos="empty.safetensors"), says=("empty.safetensors", f"{episodes} episode", "aegis demos"))


def test_zero_episodes(bad: Callable[..., str], trained: Path) -> None:
    bad("demos", "reach", "--episodes", "0", "--out", "d.safetensors", says=("--episodes 0",))
    bad("rollout", trained, "--episodes", "0", says=("--episodes 0",))
    bad("run", "small.yaml", "--set", "demos.episodes=0", says=("demos.episodes",))


# --- numbers that are none -----------------------------------------------------------------------


@pytest.mark.parametrize(("victim", "name"), [("anchor", "layers.1.mean"), ("anchor", "layers.0.var"), ("demos", "actions"), ("demos", "proprio")])
def test_nan_in_statistics(victim: str, name: str, bad: Callable[..., str], place: Path) -> None:
    tensor = artifacts.load(f"{victim}.safetensors").tensors[name].clone()
    tensor.view(-1)[1] = NAN
    forge(place / f"{victim}.safetensors", **{name: tensor})
    bad(*TRAIN, says=(f"{victim}.safetensors", f"'{name}' has 1 NaN", f"aegis {victim}"))


def test_a_backbone_whose_activations_overflow(bad: Callable[..., str], place: Path) -> None:
    """Its weights are finite, what comes out of them is not: no anchor is written."""
    model = make_tiny()
    with torch.no_grad():
        model.stem.position.fill_(3e38)
    model.save(place / "huge")
    bad("anchor", "--backbone", "huge", "--samples", "7", "--out", "a.safetensors", says=("a.safetensors", "NaN or infinite"))


@pytest.mark.parametrize("setting", ["train.expert_lr=1e30", "train.backbone_lr=1e30"])
def test_training_that_diverges_keeps_its_last_good_step(setting: str, aegis, place: Path) -> None:  # noqa: F811
    err = refused(aegis(*TRAIN, "--set", setting, "--set", "train.steps=20", "--set", "train.warmup=0"))
    assert "finite numbers" in err and "runs/checkpoints/last" in err
    last = place / "runs" / "checkpoints" / "last"
    good = int(last.resolve().name)
    assert f"at step {good + 1}" in err
    assert all(artifacts.load(path) for path in (*last.resolve().rglob("*.safetensors"), place / "runs" / "ledger.safetensors"))
    assert not leftovers(place)


# --- where nothing can be written ----------------------------------------------------------------


def leftovers(folder: Path) -> list[Path]:
    """Temporary files and folders that somebody forgot."""
    return [p for p in folder.rglob("*") if p.name.startswith(".") or p.name.endswith(".tmp")]


def outputs(place: str) -> dict[str, tuple[str, ...]]:
    """Every option that names something to write, by what it writes to."""
    return {
        "demos": ("demos", "point", "--episodes", "2", "--out", f"{place}/d.safetensors"),
        "preview": ("demos", "point", "--episodes", "2", "--out", "d.safetensors", "--preview", f"{place}/p.png"),
        "anchor": ("anchor", "--backbone", "model.safetensors", "--samples", "7", "--out", f"{place}/a.safetensors"),
        "train": training(out=f"{place}/run"),
        "pretrain": ("pretrain", "vlm.yaml", "--out", f"{place}/vlm"),
        "run": ("run", "small.yaml", "--out", place),
        "video": ("rollout", "RUN", "--episodes", "1", "--video", f"{place}/v.gif"),
        "plot": ("inspect", "RUN", "--plot", f"{place}/p.png"),
    }


@pytest.mark.parametrize(
    ("output", "where"),
    [(output, where) for output in outputs("") for where in ("file", "/proc") if (output, where) != ("preview", "/proc")],
)
def test_a_place_that_cannot_be_written(output: str, where: str, bad: Callable[..., str], trained: Path) -> None:
    """Below something that is no folder, and in a file system that takes no files: so for root, too."""
    bad(*(str(trained) if word == "RUN" else word for word in outputs(where)[output]), says=(where,))


@pytest.mark.parametrize("command", [training(out="file"), ("pretrain", "vlm.yaml", "--out", "file")])
def test_a_file_where_a_folder_is_to_be(command: tuple[str, ...], bad: Callable[..., str]) -> None:
    bad(*command, says=("'file'",))


@pytest.mark.parametrize("command", [outputs(".")["demos"], outputs(".")["anchor"]])
def test_a_folder_where_a_file_is_to_be(command: tuple[str, ...], bad: Callable[..., str], place: Path) -> None:
    (place / Path(command[-1]).name).mkdir()
    bad(*command, says=(Path(command[-1]).name,))


@contextmanager
def disk(free: int) -> Iterator[None]:
    """No file may grow beyond `free` bytes: what a full disk looks like to a program."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (free, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.mark.parametrize(("output", "free"), [("demos", 100_000), ("anchor", 1000)])
def test_a_full_disk_leaves_no_artifact(output: str, free: int, bad: Callable[..., str]) -> None:
    with disk(free):
        bad(*outputs(".")[output], says=("cannot write", "free space"))


def test_a_full_disk_leaves_no_half_checkpoint_and_the_run_goes_on(aegis, place: Path, trained: Path) -> None:  # noqa: F811
    with disk(20_000):
        assert "free" in refused(aegis(*TRAIN))
    assert not leftovers(place) and sorted(p.name for p in (place / "runs").iterdir()) == ["checkpoints", "ledger.safetensors", "metrics.jsonl", "recipe.yaml"]
    assert not list((place / "runs" / "checkpoints").iterdir())
    assert aegis(*TRAIN, "--resume")[0] == 0
    for name in ("backbone/model.safetensors", "expert.safetensors"):
        path = Path("checkpoints") / "last" / name
        assert (place / "runs" / path).read_bytes() == (trained / path).read_bytes()


def test_a_full_disk_during_pretraining(aegis, place: Path) -> None:  # noqa: F811
    with disk(20_000):
        assert "free" in refused(aegis("pretrain", "vlm.yaml", "--out", "vlm"))
    assert not list((place / "vlm").iterdir())


# --- names ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "close"),
    [
        (training(method="aegsi"), "'aegis'"),
        (training(method="stop_gradient"), "'stop-gradient'"),
        (("demos", "raech", "--out", "d.safetensors"), "'reach'"),
        (("demos", "pont", "--out", "d.safetensors"), "'point'"),
        (("anchor", "--backbone", "model.safetensors", "--vqa", "scene", "--out", "a.safetensors"), "scenes"),
    ],
)
def test_unknown_names_get_the_close_one(command: tuple[str, ...], close: str, bad: Callable[..., str]) -> None:
    bad(*command, says=(close,))


def test_another_task_than_the_runs(bad: Callable[..., str], trained: Path) -> None:
    bad("rollout", trained, "--task", "point", "--episodes", "1", says=("'point'", "--task reach"))
    bad("rollout", trained, "--task", "raech", "--episodes", "1", says=("use 'reach'",))


# --- Ctrl-C --------------------------------------------------------------------------------------


def interrupted(place: Path, args: tuple[str, ...], ready: Callable[[int, str], bool]) -> str:
    """Run `aegis` and press Ctrl-C once `ready` (told its process id and what it said): the whole group gets the signal."""
    command = [sys.executable, "-c", "from aegis_cli.cli import main; main()", *args]
    said = place.parent / "stderr.txt"
    with open(said, "w") as err:
        process = subprocess.Popen(
            command, cwd=place, env=os.environ | {"PYTHONPATH": str(ROOT)}, stdout=err, stderr=err, start_new_session=True
        )
    try:
        while not ready(process.pid, said.read_text()):
            assert process.poll() is None, said.read_text()
            time.sleep(0.02)
        os.killpg(process.pid, signal.SIGINT)
        assert process.wait(timeout=300) == 130  # only a hang takes so long
    finally:
        process.kill()
    assert "Traceback" not in said.read_text() and said.read_text().count("interrupted") == 1, said.read_text()
    return said.read_text()


class Enough(Exception):
    """Ends a training that was only to be resumed."""


def test_ctrl_c_leaves_a_run_that_goes_on(place: Path) -> None:
    args = (*TRAIN, "--set", "train.steps=1000000")
    err = interrupted(place, args, lambda *_: (place / "runs/checkpoints/last/expert.safetensors").exists())
    assert f"resume with: aegis {' '.join(args)} --resume" in err
    assert not leftovers(place)
    last = (place / "runs/checkpoints/last").resolve()
    assert all(artifacts.load(path) for path in last.rglob("*.safetensors"))
    seen: list[Progress] = []

    def one_step(event: Progress) -> None:
        seen.append(event)
        raise Enough

    settings = recipes.load(place / "small.yaml", ["train.steps=1000000"])
    with pytest.raises(Enough):
        train.run(settings, "aegis", Path("demos.safetensors"), Path("anchor.safetensors"), Path("runs"), resume=True, on_event=one_step)
    assert [event.done for event in seen] == [int(last.name) + 1]


def starting(pid: int, _: str) -> bool:
    """The first worker process is there, but has hardly begun to import anything."""
    tasks = Path(f"/proc/{pid}/task")
    return any("multiprocessing.spawn" in command_of(child) for task in tasks.iterdir() for child in (task / "children").read_text().split())


def command_of(pid: str) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_text()
    except OSError:  # it has just ended
        return ""


def working(_: int, said: str) -> bool:
    """Workers have delivered something."""
    return "demos: " in said or "render: " in said


@pytest.mark.parametrize("moment", [starting, working])
@pytest.mark.parametrize(
    "command", [("demos", "point", "--episodes", "9999", "--out", "d.safetensors"), ("pretrain", "vlm.yaml", "--set", "scenes=9999", "--out", ".")]
)
def test_ctrl_c_with_worker_processes(command: tuple[str, ...], moment: Callable[[int, str], bool], place: Path) -> None:
    """None of them prints a traceback of its own, and no output is begun."""
    before = snapshot(place)
    interrupted(place, command, moment)
    assert snapshot(place) == before
