"""Streams through the command line: train, inspect, probe, and what is refused."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
from samples.artifacts import forge
from samples.streams import recipe, write

from aegis_cli.common import artifacts
from aegis_cli.recipes import StreamRecipe, load, load_training, to_yaml

pytestmark = pytest.mark.usefixtures("tiny_streams")

Aegis = Callable[..., tuple[int, str, str]]


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with a stream's recipe, and one for demonstrations."""
    write(tmp_path, recipe("igsp"))
    (tmp_path / "robot.yaml").write_text("name: robot\ntrain: {steps: 5}\n")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def done(aegis: Aegis, *args: object) -> dict[str, Any]:
    code, out, err = aegis(*args, "--json")
    assert code == 0, err
    return json.loads(out)


@pytest.mark.parametrize("method", ["igsp", "sequential", "zero-shot"])
def test_train_inspect_and_probe_agree(aegis: Aegis, place: Path, method: str) -> None:
    trained = done(
        aegis, "train", "stream.yaml", "--out", "run", "--method", method, "--set", "train.steps=6"
    )
    assert trained["method"] == method and len(trained["oracle"]) == 3
    probed = done(aegis, "probe", "run")
    assert probed["oracle"] == trained["oracle"] and probed["largest_difference"] == 0
    inspected = done(aegis, "inspect", "run")
    assert inspected["kind"] == "stream-run"
    assert inspected["report"]["records"] == trained["records"]
    assert load_training(place / "run" / "recipe.yaml").train.method == method
    assert not list(place.rglob("*.tmp")) and not list(place.rglob(".*"))
    for file in place.rglob("*.safetensors"):
        if method == "igsp":
            assert done(aegis, "inspect", file)["kind"] in ("experts", "routing")


def test_what_sequential_stores_is_its_own_encoder(aegis: Aegis, place: Path) -> None:
    _, out, _ = aegis(
        "train", "stream.yaml", "--out", "run", "--method", "sequential", "--set", "train.steps=1"
    )
    assert (
        "numbers stored, the encoder that it has changed among them, 0 of them to tell tasks"
        in " ".join(out.split())
    )


def test_what_is_shown(aegis: Aegis, place: Path) -> None:
    code, out, _ = aegis("train", "stream.yaml", "--out", "run")
    assert code == 0 and "small: igsp on small" in out
    words = (
        "task told",
        "task inferred",
        "after three",
        "On test parts",
        "Transfer %",
        "Forgetting (points)",
    )
    for word in (*words, "numbers stored beside the bare encoder"):
        assert word in out
    code, out, _ = aegis("inspect", "run", "--plot", "routing.png")
    assert code == 0 and "image.out" in out and "Old experts" in out and "Trained in phase 1" in out
    rows = [
        line for line in out.splitlines() if re.match(r" *(one|two|three) +(image|text)\.", line)
    ]
    assert len(rows) == 3 * 6
    assert (place / "routing.png").read_bytes().startswith(b"\x89PNG")
    assert (place / "routing.png").stat().st_size > 10_000
    code, out, _ = aegis("probe", "run")
    assert code == 0 and "measured again: 3 of 3 rows, largest difference 0" in out


def test_an_interrupted_stream_says_how_to_go_on(
    aegis: Aegis, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from aegis_cli.continual import loop

    step = loop.take

    def stops(run: Any, training: Any, number: int, *rest: Any) -> float:
        if number == 7:
            raise KeyboardInterrupt
        return step(run, training, number, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(loop, "take", stops)
        code, _, err = aegis("train", "stream.yaml", "--out", "run")
    assert code == 130 and err.endswith("resume with: aegis train run\n")
    log = place / "run" / "metrics.jsonl"
    whole = log.read_text()
    log.write_text("[]\n" + whole)
    code, _, err = aegis("train", "stream.yaml", "--out", "run", "--resume")
    assert code == 2 and "metrics.jsonl is damaged: line 1: no object with task, step" in err
    log.write_text(whole)
    assert aegis("train", "run")[0] == 0
    assert not (place / "run" / "state.safetensors").exists()


TRAIN = ("train", "stream.yaml", "--out", "run")


@pytest.mark.parametrize(
    ("args", "says"),
    [
        ((*TRAIN, "--method", "igps"), ("igps", "did you mean 'igsp'?")),
        ((*TRAIN, "--method", "lora"), ("train.method: 'lora'", "sequential-lora")),
        (
            (*TRAIN, "--demos", "d", "--dry-run"),
            ("--demos, --dry-run with the stream of 'small'", "leave out"),
        ),
        ((*TRAIN, "--set", "igsp.kapa=1"), ("igsp.kapa", "did you mean 'igsp.kappa'?")),
        ((*TRAIN, "--set", "igsp.kappa=1.5"), ("igsp.kappa", "above 0 and below 1")),
        ((*TRAIN, "--set", "igsp.candidates=0"), ("igsp.candidates", "above 0")),
        ((*TRAIN, "--set", "train.label_smoothing=1"), ("train.label_smoothing", "below 1")),
        ((*TRAIN, "--set", "inference.quantile=-1"), ("inference.quantile",)),
        ((*TRAIN, "--set", "split=valid"), ("split: 'valid'", "did you mean 'validation'?")),
        ((*TRAIN, "--set", "order=[one, one]"), ("order", "different words")),
        ((*TRAIN, "--set", "order=[one, six]"), ("order: six", "one, two, three")),
        ((*TRAIN, "--set", "stream=large"), ("no stream 'large'",)),
        ((*TRAIN, "--set", "encoder=huge"), ("no dual encoder 'huge'",)),
        (("train", "stream.yaml", "--out", "robot.yaml"), ("'robot.yaml' is no folder",)),
        (("train", "robot.yaml", "--out", "run"), ("no --demos for 'robot.yaml'", "aegis demos")),
        (("train", "nothing.yaml", "--out", "run"), ("nothing.yaml",)),
        (("run", "stream.yaml"), ("a stream of tasks", "aegis train stream.yaml")),
        (("pretrain", "stream.yaml"), ("a stream of tasks", "aegis train stream.yaml")),
    ],
)
def test_what_cannot_be_trained(
    bad: Callable[..., None], args: tuple[str, ...], says: tuple[str, ...]
) -> None:
    bad(*args, says=says)


def test_runs_that_are_not_what_was_asked_for(
    aegis: Aegis, place: Path, bad: Callable[..., None]
) -> None:
    done(aegis, *TRAIN, "--set", "train.steps=4")
    bad(*TRAIN, "--set", "train.steps=4", says=("an existing run", "--resume"))
    bad(*TRAIN, "--resume", says=("other settings",))
    bad(
        "probe",
        "run",
        "--baseline",
        "run",
        "--max-drop",
        0,
        says=("--baseline, --max-drop with the stream",),
    )
    dropped = ("--vqa", "scenes", "--questions", 5000, "--skip-bad", "--batch-size", 64, "--json")
    bad(
        "probe",
        "run",
        *dropped,
        says=("--vqa, --questions, --skip-bad, --batch-size with the stream",),
    )
    bad("inspect", "run", "--plot", "x.txt", says=(".png",))
    bad("inspect", "run", "--plot", "nowhere/x.png", says=("nowhere",))
    kept = (place / "run" / "stream.json").read_text()
    for damage, says in (("{", "not JSON"), ("{}", "damaged"), (None, "is not finished")):
        (place / "run" / "stream.json").unlink()
        if damage is not None:
            (place / "run" / "stream.json").write_text(damage)
        for command in ("inspect", "probe"):
            bad(command, "run", says=(says,))
        (place / "run" / "stream.json").write_text(kept)


@pytest.mark.parametrize(
    "line",
    [b'{"task": 0, "st', b"\xff", b"3", b'{"task": 0, "step": 4}', b'{"seconds": "long"}', b""],
)
def test_a_damaged_line_of_the_log_is_one_error(
    line: bytes, aegis: Aegis, place: Path, bad: Callable[..., None]
) -> None:
    done(aegis, *TRAIN, "--set", "train.steps=4")
    log = place / "run" / "metrics.jsonl"
    whole = log.read_bytes()
    log.write_bytes(line + b"\n" + whole)
    for command in (
        ("inspect", "run"),
        ("probe", "run"),
        (*TRAIN, "--set", "train.steps=4", "--resume"),
    ):
        bad(*command, says=("metrics.jsonl is damaged: line 1", "delete the damaged line"))
    log.write_bytes(whole + line)  # the line being written when the run stopped
    done(aegis, "inspect", "run")
    log.unlink()
    bad("inspect", "run", says=("no file 'run/metrics.jsonl'",))


def test_damaged_experts_are_refused(aegis: Aegis, place: Path, bad: Callable[..., None]) -> None:
    done(aegis, *TRAIN, "--set", "train.steps=4")
    for name in ("experts", "routing"):
        path = place / "run" / f"{name}.safetensors"
        kept = path.read_bytes()
        path.write_bytes(kept[:-40])
        bad("probe", "run", says=("truncated", path.name))
        path.write_bytes(kept)
        first = next(
            n for n, t in artifacts.load(path).tensors.items() if n.endswith((".a", ".read"))
        )
        forge(path, **{first: safetensors.torch.load_file(path)[first] * float("nan")})
        bad("probe", "run", says=("NaN", first))
        path.write_bytes(kept)
        forge(path, lambda header: header.update(fingerprint="0" * 64))
        says = (f"run/{name}.safetensors", "not those of 'tiny'", "bring", "train")
        bad("probe", "run", says=says)
        path.write_bytes(kept)


def test_a_run_without_routers_has_no_plot(
    aegis: Aegis, place: Path, bad: Callable[..., None]
) -> None:
    done(aegis, *TRAIN, "--method", "zero-shot")
    bad("inspect", "run", "--plot", "x.png", says=("no routers",))


def test_recipes_of_both_kinds_are_told_apart(place: Path) -> None:
    assert isinstance(load_training(place / "stream.yaml"), StreamRecipe)
    assert not isinstance(load_training(place / "robot.yaml"), StreamRecipe)
    (place / "typo.yaml").write_text(
        "kind: stream\nname: x\nstraem: small\nigsp: {rank: 2}\ninference: {quantile: 0.1}\n"
    )
    with pytest.raises(Exception, match="did you mean 'stream'"):
        load_training(place / "typo.yaml")
    made = recipe("moe-adapters", order=("two", "one"))
    (place / "again.yaml").write_text(to_yaml(made))
    assert load(place / "again.yaml", kind=StreamRecipe) == made
