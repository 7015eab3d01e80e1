"""User errors, through the command line.

Each ends with exit 2, one error that says what to do, and nothing half-written.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import safetensors.torch
import torch
from samples.artifacts import forge
from samples.command import refused
from samples.tiny import make_tiny
from samples.user_folder import TRAIN, leftovers, training

from aegis_cli.common import artifacts

NAN = float("nan")


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
        ("demos: {episodes: 0}", ("demos.episodes", "from 1 to 10,000,000")),
        ("rollout: {episodes: 0}", ("rollout.episodes", "from 1 to 10,000,000")),
        ("train: {backbone_lr: .nan}", ("train.backbone_lr",)),
    ],
)
def test_recipes(
    command: tuple[str, ...], line: str, says: tuple[str, ...], bad: Callable[..., str], place: Path
) -> None:
    (place / "small.yaml").write_text(f"name: small\n{line}\n")
    bad(*command, says=("small.yaml", *says))


def test_all_mistakes_of_a_recipe_come_at_once(bad: Callable[..., str], place: Path) -> None:
    (place / "small.yaml").write_text(
        "name: small\ntask: raech\ntrain: {stesp: 5, batch_size: -1}\n"
    )
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
        (("evaluate", "nothing", "--demos", "demos.safetensors"), "nothing"),
        (("inspect", "nothing"), "nothing"),
        (("pretrain", "nothing.yaml"), "nothing.yaml"),
        (("run", "nothing.yaml"), "nothing.yaml"),
        (("run", "small.yaml", "--set", "methods=[naive]", "--out", "file"), "'file/small'"),
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
def test_truncated_files(
    keep: float, victim: str, command: tuple[str, ...], bad: Callable[..., str], place: Path
) -> None:
    path = place / f"{victim}.safetensors"
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data))])
    bad(*command, says=(path.name, "truncated"))


# `inspect` tells what is in such a file instead.
@pytest.mark.parametrize(("victim", "command"), [r for r in READERS if r[1][0] != "inspect"])
def test_foreign_files(
    victim: str, command: tuple[str, ...], bad: Callable[..., str], place: Path
) -> None:
    path = place / f"{victim}.safetensors"
    safetensors.torch.save_file({"weight": torch.zeros(3)}, path, {"format": "pt"})
    bad(*command, says=(path.name, "another program wrote it"))


@pytest.mark.parametrize(
    "command",
    [
        training(demos="anchor.safetensors"),
        training(anchor="demos.safetensors"),
        ("probe", "demos.safetensors"),
        ("rollout", "demos.safetensors"),
    ],
)
def test_files_in_each_others_place(command: tuple[str, ...], bad: Callable[..., str]) -> None:
    bad(*command)


@pytest.mark.parametrize("override", [(), ("--set", "demos.camera=top")])
def test_demonstrations_and_anchor_in_each_others_place_are_told_their_options(
    override: tuple[str, ...], bad: Callable[..., str]
) -> None:
    both = training(demos="anchor.safetensors", anchor="demos.safetensors")
    err = bad(*both, *override, says=("'demos.safetensors' is of kind 'demos'", "--demos"))
    assert "demos.camera" not in err
    swapped = training(demos="anchor.safetensors")
    err = bad(*swapped, *override, says=("'anchor.safetensors' is of kind 'anchor'", "--anchor"))
    assert "demos.camera" not in err
    bad(*training(anchor="demos.safetensors"), says=("of kind 'demos'", "belongs to --demos"))


@pytest.mark.parametrize("command", ["inspect", "probe", "rollout", "export"])
def test_a_run_whose_path_is_no_text_is_told_so(
    command: str, bad: Callable[..., str], trained: Path, place: Path
) -> None:
    """It is whole, but safetensors says that it is not."""
    run = place / os.fsdecode(b"caf\xe9")
    shutil.copytree(trained, run, symlinks=True)
    out = ("--out", place / "policy") if command == "export" else ()
    said = bad(command, run, *out, says=("caf\\udce9", "not UTF-8", "rename"))
    assert "truncated" not in said and "train" not in said


def test_a_checkpoint_that_lost_a_part(bad: Callable[..., str], trained: Path, place: Path) -> None:
    run = place / "run"
    shutil.copytree(trained, run, symlinks=True)
    (run / "checkpoints/last/expert.safetensors").write_bytes(b"")
    bad("rollout", "run", "--episodes", "1", says=("expert.safetensors", "truncated"))
    (run / "checkpoints/last/backbone/model.safetensors").unlink()
    bad("probe", "run", "--questions", "7", says=("'run/checkpoints/last/",))
    bad("probe", "run", "--questions", "7", "--baseline", "none", says=("'run'",))
    (run / "checkpoints/last").unlink()
    bad("rollout", "run", "--episodes", "1", says=("no checkpoint in 'run'", "aegis train"))


# --- inputs that do not belong together ----------------------------------------------------------


def test_an_anchor_of_another_backbone(bad: Callable[..., str], place: Path) -> None:
    make_tiny(seed=1).save(place / "other")
    ours, other = (
        artifacts.read_header(place / name).fingerprint
        for name in ("model.safetensors", "other/model.safetensors")
    )
    says = ("anchor.safetensors", ours[:12], other[:12])
    bad(*TRAIN, "--set", "backbone=other", says=(*says, "aegis anchor"))
    bad(
        "probe",
        "other",
        "--anchor",
        "anchor.safetensors",
        "--questions",
        "7",
        says=(*says, "measured on: --baseline "),
    )


def test_demonstrations_of_another_task(bad: Callable[..., str]) -> None:
    bad(*TRAIN, "--set", "task=point", says=("'reach'", "'point'", "--set task=reach"))


@pytest.mark.parametrize("episodes", [0, 1])
def test_an_empty_dataset(
    episodes: int, bad: Callable[..., str], place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without episodes it is no demonstrations file; with one, nothing is left for validation."""
    tensors, header = (
        artifacts.load("demos.safetensors").tensors,
        artifacts.read_header("demos.safetensors"),
    )
    frames = int(tensors["episode_starts"][episodes])
    cut = {name: tensors[name][:frames].clone() for name in ("frames", "proprio", "actions")}
    cut |= {name: tensors[name][:episodes].clone() for name in ("instruction", "target_color")}
    cut["episode_starts"] = tensors["episode_starts"][: episodes + 1].clone()
    with monkeypatch.context() as patch:  # a careless program
        patch.setattr(artifacts, "_validate", lambda *_: None)
        artifacts.save("empty.safetensors", "demos", cut, meta=header.meta)
    bad(
        *training(demos="empty.safetensors"),
        says=("empty.safetensors", f"{episodes} episode", "aegis demos"),
    )


def test_zero_episodes(bad: Callable[..., str], trained: Path) -> None:
    bad("demos", "reach", "--episodes", "0", "--out", "d.safetensors", says=("--episodes 0",))
    bad("rollout", trained, "--episodes", "0", says=("--episodes 0",))
    bad("run", "small.yaml", "--set", "demos.episodes=0", says=("demos.episodes",))


# --- numbers that are not finite -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("victim", "name"),
    [
        ("anchor", "layers.1.text.mean"),
        ("anchor", "layers.0.image.var"),
        ("demos", "actions"),
        ("demos", "proprio"),
    ],
)
def test_nan_in_statistics(victim: str, name: str, bad: Callable[..., str], place: Path) -> None:
    tensor = artifacts.load(f"{victim}.safetensors").tensors[name].clone()
    tensor.view(-1)[1] = NAN
    forge(place / f"{victim}.safetensors", **{name: tensor})
    bad(*TRAIN, says=(f"{victim}.safetensors", f"'{name}' has 1 NaN", f"aegis {victim}"))


def test_a_backbone_whose_activations_overflow(bad: Callable[..., str], place: Path) -> None:
    """Its weights are finite but its activations are not: no anchor is written."""
    model = make_tiny()
    with torch.no_grad():
        model.stem.position.weight.fill_(3e38)
    model.save(place / "huge")
    bad(
        "anchor",
        "--backbone",
        "huge",
        "--samples",
        "7",
        "--out",
        "a.safetensors",
        says=("'layers.0.norm1' that is not finite", "its weights are finite"),
    )


@pytest.mark.parametrize("setting", ["train.expert_lr=1e30", "train.backbone_lr=1e30"])
def test_training_that_diverges_keeps_its_last_good_step(setting: str, aegis, place: Path) -> None:
    err = refused(
        aegis(*TRAIN, "--set", setting, "--set", "train.steps=20", "--set", "train.warmup=0")
    )
    assert "finite numbers" in err and "runs/checkpoints/last" in err
    last = place / "runs" / "checkpoints" / "last"
    good = int(last.resolve().name)
    assert f"at step {good + 1}" in err
    assert all(
        artifacts.load(path)
        for path in (*last.resolve().rglob("*.safetensors"), place / "runs" / "ledger.safetensors")
    )
    assert not leftovers(place)


# --- names ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "close"),
    [
        (training(method="aegsi"), "'aegis'"),
        (training(method="stop_gradient"), "'stop-gradient'"),
        (("demos", "raech", "--out", "d.safetensors"), "'reach'"),
        (("demos", "pont", "--out", "d.safetensors"), "'point'"),
        (
            (
                "anchor",
                "--backbone",
                "model.safetensors",
                "--vqa",
                "scene",
                "--out",
                "a.safetensors",
            ),
            "scenes",
        ),
    ],
)
def test_unknown_names_get_the_close_one(
    command: tuple[str, ...], close: str, bad: Callable[..., str]
) -> None:
    bad(*command, says=(close,))


def test_demonstrations_that_cannot_be_compared_with(
    bad: Callable[..., str], trained: Path
) -> None:
    bad("evaluate", trained, "--demos", "nothing.safetensors", says=("'nothing.safetensors'",))
    bad("evaluate", trained, "--demos", "demos.safetensors", "--episodes", "8", says=("0 to 7",))
    bad("evaluate", trained, "--demos", "anchor.safetensors", says=("anchor",))


def test_another_task_than_the_runs(bad: Callable[..., str], trained: Path) -> None:
    bad("rollout", trained, "--task", "point", "--episodes", "1", says=("'point'", "--task reach"))
    bad("rollout", trained, "--task", "raech", "--episodes", "1", says=("use 'reach'",))
