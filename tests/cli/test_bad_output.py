"""Where nothing can be written, and Ctrl-C.

There is one clear message, nothing half-written, and runs that go on.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from samples.command import ROOT, refused
from samples.disk import disk
from samples.user_folder import TRAIN, leftovers, snapshot, training

from aegis_cli import recipes
from aegis_cli.common import artifacts
from aegis_cli.common.events import Progress
from aegis_cli.training import train

# --- where nothing can be written ----------------------------------------------------------------


def outputs(place: str) -> dict[str, tuple[str, ...]]:
    """Every option that names something to write, by what it writes to."""
    return {
        "demos": ("demos", "point", "--episodes", "2", "--out", f"{place}/d.safetensors"),
        "preview": (
            "demos",
            "point",
            "--episodes",
            "2",
            "--out",
            "d.safetensors",
            "--preview",
            f"{place}/p.png",
        ),
        "anchor": (
            "anchor",
            "--backbone",
            "model.safetensors",
            "--samples",
            "7",
            "--out",
            f"{place}/a.safetensors",
        ),
        "train": training(out=f"{place}/run"),
        "pretrain": ("pretrain", "vlm.yaml", "--out", f"{place}/vlm"),
        "run": ("run", "small.yaml", "--out", place),
        "video": ("rollout", "RUN", "--episodes", "1", "--video", f"{place}/v.gif"),
        "plot": ("inspect", "RUN", "--plot", f"{place}/p.png"),
    }


@pytest.mark.parametrize(
    ("output", "where"),
    [
        (output, where)
        for output in outputs("")
        for where in ("file", "/proc")
        if (output, where) != ("preview", "/proc")
    ],
)
def test_a_place_that_cannot_be_written(
    output: str, where: str, bad: Callable[..., str], trained: Path
) -> None:
    """Below something that is no folder, and in a file system without files (for root too)."""
    bad(
        *(str(trained) if word == "RUN" else word for word in outputs(where)[output]), says=(where,)
    )


@pytest.mark.parametrize(
    "command", [training(out="file"), ("pretrain", "vlm.yaml", "--out", "file")]
)
def test_a_file_where_a_folder_is_to_be(command: tuple[str, ...], bad: Callable[..., str]) -> None:
    bad(*command, says=("'file'",))


@pytest.mark.parametrize("command", [outputs(".")["demos"], outputs(".")["anchor"]])
def test_a_folder_where_a_file_is_to_be(
    command: tuple[str, ...], bad: Callable[..., str], place: Path
) -> None:
    (place / Path(command[-1]).name).mkdir()
    bad(*command, says=(Path(command[-1]).name,))


@pytest.mark.parametrize(("output", "free"), [("demos", 100_000), ("anchor", 1000)])
def test_a_full_disk_leaves_no_artifact(output: str, free: int, bad: Callable[..., str]) -> None:
    with disk(free):
        bad(*outputs(".")[output], says=("cannot write", "free space"))


def test_a_full_disk_leaves_no_half_checkpoint_and_the_run_goes_on(
    aegis, place: Path, trained: Path
) -> None:
    with disk(20_000):
        assert "free" in refused(aegis(*TRAIN))
    assert not leftovers(place) and sorted(p.name for p in (place / "runs").iterdir()) == [
        "checkpoints",
        "ledger.safetensors",
        "metrics.jsonl",
        "recipe.yaml",
    ]
    assert not list((place / "runs" / "checkpoints").iterdir())
    assert aegis(*TRAIN, "--resume")[0] == 0
    for name in ("backbone/model.safetensors", "expert.safetensors"):
        path = Path("checkpoints") / "last" / name
        assert (place / "runs" / path).read_bytes() == (trained / path).read_bytes()


def test_a_full_disk_during_pretraining(aegis, place: Path) -> None:
    with disk(20_000):
        assert "free" in refused(aegis("pretrain", "vlm.yaml", "--out", "vlm"))
    assert not list((place / "vlm").iterdir())


def test_pretraining_replaces_no_model_that_it_did_not_begin(bad: Callable[..., str]) -> None:
    """Nor a finished one, whose state somebody has deleted, after an hour's work."""
    for resume in ([], ["--resume"]):
        bad(
            "pretrain",
            "vlm.yaml",
            "--out",
            ".",
            *resume,
            says=("a finished model in '.'", "another --out"),
        )


# --- Ctrl-C --------------------------------------------------------------------------------------


def interrupted(place: Path, args: tuple[str, ...], ready: Callable[[int, str], bool]) -> str:
    """Run `aegis` and press Ctrl-C once `ready`, which is told its process id and what it said.

    The whole group gets the signal.
    """
    # a background job of a shell starts with Ctrl-C ignored, and so would everything it starts
    heed = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    command = [sys.executable, "-c", f"{heed}; from aegis_cli.cli.app import main; main()", *args]
    said = place.parent / "stderr.txt"
    with open(said, "w") as err:
        process = subprocess.Popen(
            command,
            cwd=place,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            stdout=err,
            stderr=err,
            start_new_session=True,
        )
    try:
        while not ready(process.pid, said.read_text()):
            assert process.poll() is None, said.read_text()
            time.sleep(0.02)
        os.killpg(process.pid, signal.SIGINT)
        assert process.wait(timeout=300) == 130  # only a hang takes so long
    finally:
        process.kill()
    assert "Traceback" not in said.read_text() and said.read_text().count("interrupted") == 1, (
        said.read_text()
    )
    return said.read_text()


class Enough(Exception):
    """Ends a training that was only to be resumed."""


def test_ctrl_c_leaves_a_run_that_goes_on(place: Path) -> None:
    args = (*TRAIN, "--set", "train.steps=1000000")
    err = interrupted(
        place, args, lambda *_: (place / "runs/checkpoints/last/expert.safetensors").exists()
    )
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
        train.run(
            settings,
            "aegis",
            Path("demos.safetensors"),
            Path("anchor.safetensors"),
            Path("runs"),
            resume=True,
            on_event=one_step,
        )
    assert [event.done for event in seen] == [int(last.name) + 1]


def starting(pid: int, _: str) -> bool:
    """The first worker process is there, but has hardly begun to import anything."""
    tasks = Path(f"/proc/{pid}/task")
    return any(
        "multiprocessing.spawn" in command_of(child)
        for task in tasks.iterdir()
        for child in (task / "children").read_text().split()
    )


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
    "command",
    [
        ("demos", "point", "--episodes", "9999", "--out", "d.safetensors"),
        ("pretrain", "vlm.yaml", "--set", "scenes=9999", "--out", "empty"),
    ],
)
def test_ctrl_c_with_worker_processes(
    command: tuple[str, ...], moment: Callable[[int, str], bool], place: Path
) -> None:
    """None of them prints a traceback of its own, and no output is begun."""
    (place / "empty").mkdir()
    before = snapshot(place)
    interrupted(place, command, moment)
    assert snapshot(place) == before
