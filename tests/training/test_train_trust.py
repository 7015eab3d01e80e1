"""Trainings beside others, ended by signals, and resumed with files that do not belong to them."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from samples.small_run import flipped
from samples.training_runs import (
    SETTINGS,
    STEPS,
    Start,
    assert_same_run,
    contents,
    metrics,
    stop_at,
)
from torch import Tensor

from aegis_cli.common import artifacts, interrupts, locks
from aegis_cli.common.errors import AegisError, Diverged
from aegis_cli.common.events import Event, OnEvent, Progress
from aegis_cli.recipes import Recipe
from aegis_cli.training import checkpoint, train
from aegis_cli.training.assemble import TrainingRun


def refused(found: str, start: Start, method: str, out: Path, **changes: Any) -> AegisError:
    """The error of a training that cannot continue and leaves every file as it was."""
    before = contents(out)
    with pytest.raises(AegisError) as caught:
        start(method, out, **changes)
    assert found in caught.value.found, caught.value
    assert contents(out) == before
    return caught.value


# --- one process ----------------------------------------------------------------------------------


def test_a_second_training_in_the_same_folder_is_refused(start: Start, tmp_path: Path) -> None:
    tried: list[AegisError] = []

    def second(event: Progress) -> None:
        if event.stage == "train" and event.done == 3:
            with pytest.raises(AegisError) as caught:
                start("lora", tmp_path / "run", resume=True)
            tried.append(caught.value)

    start("naive", tmp_path / "run", on_event=second)
    assert f"is being written to by process {os.getpid()}" in tried[0].found


def test_a_refused_training_waits_for_nothing(start: Start, tmp_path: Path) -> None:
    with locks.alone(tmp_path / "run"):
        refused("is being written to", start, "naive", tmp_path / "run")
    start("naive", tmp_path / "run")


# --- signals --------------------------------------------------------------------------------------


def signal_at(done: int, *numbers: int, stage: str = "train") -> OnEvent:
    """Send this process these signals after that step, or that part of another stage."""

    def on_event(event: Event) -> None:
        if isinstance(event, Progress) and (event.stage, event.done) == (stage, done):
            for number in numbers:
                os.kill(os.getpid(), number)

    return on_event


@pytest.fixture
def ctrl_c() -> Any:
    """Ctrl-C as in a fresh process."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


# Resuming every method from a checkpoint is tested in `test_train_resume`. These differ in
# where they can save after a signal: two constrain updates of several steps, and three do not.
@pytest.mark.usefixtures("ctrl_c")
@pytest.mark.parametrize("method", ["naive", "aegis", "lora", "kfac", "nullspace"])
def test_ctrl_c_saves_the_steps_and_the_resumed_run_ends_in_the_same_bytes(
    method: str, whole_run: Callable[[str], Path], start: Start, tmp_path: Path
) -> None:
    """After step 3, between two checkpoints; a method that constrains continues to the next one."""
    with pytest.raises(KeyboardInterrupt):
        start(method, tmp_path, on_event=signal_at(3, signal.SIGINT))
    assert checkpoint.last(tmp_path).resolve().name in ("000003", "000004")
    torch.manual_seed(99)
    start(method, tmp_path, resume=True)
    assert_same_run(tmp_path, whole_run(method))


@pytest.mark.usefixtures("ctrl_c")
@pytest.mark.parametrize("at", [1, 3, 5])
def test_lines_of_metrics_are_means_over_an_interruption(
    at: int, start: Start, recipe: Recipe, tmp_path: Path
) -> None:
    slow = replace(recipe, train=replace(SETTINGS, log_every=4, checkpoint_every=STEPS))
    start("aegis", tmp_path / "whole", recipe=slow)
    for number in (signal.SIGINT, signal.SIGTERM):
        out = tmp_path / str(number)
        with pytest.raises(KeyboardInterrupt), interrupts.listening():
            start("aegis", out, recipe=slow, on_event=signal_at(at, number))
        assert checkpoint.last(out).resolve().name == f"{at:06d}"
        start("aegis", out, recipe=slow, resume=True)
        assert_same_run(out, tmp_path / "whole")


@pytest.mark.usefixtures("ctrl_c")
@pytest.mark.parametrize("times", [1, 2])
@pytest.mark.parametrize("at", [3, 6])
def test_a_validation_is_left_at_a_signal_and_made_again_by_the_resumed_run(
    at: int,
    times: int,
    start: Start,
    recipe: Recipe,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """After step 3, whose checkpoint is not kept, and after the last; also interrupted twice."""
    settings = replace(SETTINGS, validate_every=at, log_every=4, ema_decay=0.5, keep_checkpoints=1)
    one = replace(recipe, train=settings)
    start("aegis", tmp_path / "whole", recipe=one)
    monkeypatch.setattr(train, "_LONG_S", 0.0)
    validated: list[int] = []

    def left(event: Event) -> None:
        if isinstance(event, Progress) and event.stage == "validation":
            validated.append(event.done)
        signal_at(4, signal.SIGTERM, stage="validation")(event)

    out = tmp_path / "cut"
    for time in range(times):
        with pytest.raises(interrupts.Stopped), interrupts.listening():
            start("aegis", out, recipe=one, on_event=left, resume=time > 0)
        assert checkpoint.last(out).resolve().name == f"{at:06d}"
    assert validated == [0, 4] * times
    start("aegis", out, recipe=one, resume=True)
    assert_same_run(out, tmp_path / "whole")


@pytest.mark.parametrize("at", [3, 4, 6])
def test_a_validation_that_fails_leaves_a_checkpoint_of_its_step(
    at: int, start: Start, recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """This holds even if the resumed run is killed after it has written the step's line."""
    one = replace(recipe, train=replace(SETTINGS, validate_every=at, validate_actions=4))
    start("naive", tmp_path / "whole", recipe=one)

    def failing(*_: Any) -> float:
        raise RuntimeError("no simulator")

    with monkeypatch.context() as patched, pytest.raises(RuntimeError, match="no simulator"):
        patched.setattr(train, "validation_loss", failing)
        start("naive", tmp_path / "cut", recipe=one)
    assert checkpoint.last(tmp_path / "cut").resolve().name == f"{at:06d}"

    def killed(event: Event) -> None:
        is_there = isinstance(event, Progress) and (event.stage, event.done) == ("train", at)
        if is_there and metrics(tmp_path / "cut")[-1]["step"] == at:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        start("naive", tmp_path / "cut", recipe=one, resume=True, on_event=killed)
    start("naive", tmp_path / "cut", recipe=one, resume=True)
    assert_same_run(tmp_path / "cut", tmp_path / "whole")


@pytest.mark.usefixtures("ctrl_c")
def test_a_second_ctrl_c_does_not_wait(start: Start, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        start("naive", tmp_path, on_event=signal_at(3, signal.SIGINT, signal.SIGINT))
    assert checkpoint.last(tmp_path).resolve().name == "000002"


@pytest.mark.usefixtures("ctrl_c")
def test_ctrl_c_after_the_last_step_finishes_the_run(
    naive_run: Path, start: Start, tmp_path: Path
) -> None:
    with pytest.raises(KeyboardInterrupt):
        start("naive", tmp_path, on_event=signal_at(STEPS, signal.SIGINT))
    assert_same_run(tmp_path, naive_run)


# --- demonstrations and anchors that change -------------------------------------------------------


@pytest.mark.parametrize("changed", ["demos", "anchor"])
def test_a_file_that_is_written_to_while_it_is_trained_on(
    changed: str, start: Start, demos_file: Path, anchor_file: Path, tmp_path: Path
) -> None:
    """Its tensors are memory-mapped: training would use other data under the old file's digest."""
    files = {"demos": demos_file, "anchor": anchor_file}
    copied = shutil.copy(files[changed], tmp_path / "copy.safetensors")

    def change(event: Progress) -> None:
        if event.stage == "train" and event.done == 3:
            with open(copied, "r+b") as file:
                file.seek(-1, os.SEEK_END)
                file.write(b"\0")
            os.utime(copied, ns=(0, 12345))

    with pytest.raises(AegisError, match=r"copy.safetensors' was written to"):
        start("aegis", tmp_path / "run", on_event=change, **{changed: copied})
    assert checkpoint.last(tmp_path / "run").resolve().name == "000002"
    shutil.copy(files[changed], copied)
    start("aegis", tmp_path / "run", resume=True, **{changed: copied})


@pytest.mark.parametrize("touched", ["demos", "anchor"])
def test_a_file_that_is_only_touched_ends_no_training(
    touched: str, start: Start, demos_file: Path, anchor_file: Path, tmp_path: Path
) -> None:
    files = {"demos": demos_file, "anchor": anchor_file}
    copied = Path(shutil.copy(files[touched], tmp_path / "copy.safetensors"))

    def touch(event: Progress) -> None:
        if event.stage == "train":
            os.utime(copied, ns=(0, copied.stat().st_mtime_ns + 10**9))

    start("aegis", tmp_path / "run", on_event=touch, **{touched: copied})
    assert checkpoint.last(tmp_path / "run").resolve().name == f"{STEPS:06d}"


# --- weights --------------------------------------------------------------------------------------


# Found at a checkpoint, or from the next step's loss.
@pytest.mark.parametrize(("wrong", "good"), [(4, 2), (5, 4)])
def test_weights_that_are_not_finite_reach_no_checkpoint(
    wrong: int, good: int, start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A setting of 1e300 can cause this after a step whose loss and gradient are finite."""
    update = train.update

    def spoiled(run: TrainingRun, index: int, *args: Any, **options: Any) -> None:
        update(run, index, *args, **options)
        if index + 1 == wrong:
            next(run.policy.parameters()).data.view(-1)[0] = torch.nan

    monkeypatch.setattr(train, "update", spoiled)
    with pytest.raises(Diverged, match=f"not finite after step {wrong}") as caught:
        start("naive", tmp_path)
    assert caught.value.good_steps == good and f"{good} steps" in caught.value.fix
    assert checkpoint.last(tmp_path).resolve().name == f"{good:06d}"


# --- files of others ------------------------------------------------------------------------------


def interrupted(start: Start, method: str, out: Path, **changes: Any) -> Path:
    """A run after four steps."""
    with pytest.raises(KeyboardInterrupt):
        start(method, out, on_event=stop_at(5, KeyboardInterrupt()), **changes)
    return out


@pytest.fixture(scope="module")
def half(start: Start, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of aegis after four steps."""
    return interrupted(start, "aegis", tmp_path_factory.mktemp("half") / "run")


@pytest.fixture
def run(half: Path, tmp_path: Path) -> Path:
    return shutil.copytree(half, tmp_path / "run", symlinks=True)


def test_a_copy_that_followed_links_goes_on(half: Path, start: Start, tmp_path: Path) -> None:
    copied = shutil.copytree(half, tmp_path / "run", symlinks=False)
    assert not (copied / "checkpoints" / "last").is_symlink()
    start("aegis", copied, resume=True)
    assert checkpoint.last(copied).resolve().name == f"{STEPS:06d}"


def resaved(path: Path, change: Callable[[dict[str, Tensor], dict[str, Any]], object]) -> None:
    """Write the same artifact with other tensors or meta, and a header that lists them."""
    kept = artifacts.load(path)
    tensors = {name: tensor.clone() for name, tensor in kept.tensors.items()}
    meta, header = dict(kept.header.meta), kept.header
    change(tensors, meta)
    path.unlink()  # mapped data stays
    artifacts.save(
        path,
        header.kind,
        tensors,
        seed=header.seed,
        inputs=header.inputs,
        fingerprint=header.fingerprint,
        meta=meta,
    )


WEIGHT = "weight.backbone.layers.0.qkv.weight"


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda t, m: t.pop(WEIGHT), f"'{WEIGHT}' missing"),
        (lambda t, m: t.update({WEIGHT: torch.ones(1)}), "is float32 [1]"),
        (lambda t, m: t.update({WEIGHT: t[WEIGHT].double()}), "is float64"),
        (lambda t, m: [t.pop(n) for n in [*t] if n.startswith("optimizer.")], "missing"),
        (
            lambda t, m: t.update({n: t[n][:1] for n in t if "exp_avg/backbone" in n}),
            "'optimizer.exp_avg/backbone",
        ),
        (lambda t, m: t.update({"more": torch.ones(1)}), "'more' not part of it"),
        (lambda t, m: m.update(step=2), "after 2 steps"),
        (lambda t, m: m.update(step="many"), "is damaged"),
        (lambda t, m: m.pop("step"), "no 'step'"),
        (lambda t, m: m.update(method="naive"), "method 'naive'"),
        (lambda t, m: m.update(stateless=3), "is damaged"),
        (lambda t, m: m.update(interrupted={"loss": 1.0, "steps": "no"}), "is damaged"),
        (lambda t, m: m.update(interrupted=7), "is damaged"),
    ],
)
def test_a_training_state_that_does_not_fit_is_refused(
    change: Callable[[dict[str, Tensor], dict[str, Any]], object],
    found: str,
    run: Path,
    start: Start,
) -> None:
    resaved(checkpoint.last(run) / checkpoint.STATE, change)
    refused(found, start, "aegis", run, resume=True)


@pytest.mark.parametrize("keep", [0.0, 0.5, 0.99])
def test_a_run_with_a_damaged_state_goes_on_from_an_earlier_checkpoint_or_anew(
    keep: float, run: Path, start: Start, tmp_path: Path
) -> None:
    """As the error says: both end with the bytes of a run that was never interrupted."""
    state = checkpoint.last(run) / checkpoint.STATE
    data = state.read_bytes()
    state.write_bytes(data[: int(keep * len(data))])
    said = refused("truncated", start, "aegis", run, resume=True).fix
    link = run / "checkpoints" / "last"
    assert f"ln -sfn 000002 '{link}'" in said and "--overwrite" in said and "run '" not in said
    start("aegis", tmp_path / "whole")
    shutil.copytree(run, tmp_path / "anew", symlinks=True)
    start("aegis", tmp_path / "anew", overwrite=True)
    subprocess.run(said.partition("; ")[0].partition(": ")[2], shell=True, check=True)
    start("aegis", run, resume=True)
    for out in (run, tmp_path / "anew"):
        assert_same_run(out, tmp_path / "whole")


def test_the_only_checkpoints_damage_leaves_to_begin_anew(start: Start, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        start("naive", tmp_path, on_event=stop_at(3, KeyboardInterrupt()))
    state = checkpoint.last(tmp_path) / checkpoint.STATE
    state.write_bytes(flipped(state.read_bytes()))
    said = refused("is damaged", start, "naive", tmp_path, resume=True).fix
    assert "--overwrite" in said and "ln -sfn" not in said


def test_another_steps_state_is_refused(run: Path, start: Start) -> None:
    older = run / "checkpoints" / "000002" / checkpoint.STATE
    shutil.copy(older, checkpoint.last(run) / checkpoint.STATE)
    refused("a state after 2 steps", start, "aegis", run, resume=True)


def test_a_ledger_with_a_gap_or_of_another_run_is_refused(
    run: Path, start: Start, recipe: Recipe, tmp_path: Path
) -> None:
    ledger = run / "ledger.safetensors"
    kept = ledger.read_bytes()
    for rows in (slice(1, None), [0, 2, 3], slice(0, 3)):
        resaved(ledger, lambda t, _, rows=rows: t.update({n: t[n][rows] for n in t}))
        refused("without exactly the steps 1 to 4", start, "aegis", run, resume=True)
        ledger.write_bytes(kept)
    resaved(ledger, lambda _, m: m.update(groups=m["groups"][::-1]))
    refused("without exactly", start, "aegis", run, resume=True)
    other = interrupted(start, "naive", tmp_path / "other")
    shutil.copy(other / "ledger.safetensors", ledger)
    refused("the ledger.safetensors of another run", start, "aegis", run, resume=True)


@pytest.mark.parametrize("key", ["step", "loss", "step_s"])
@pytest.mark.parametrize("value", [None, "gone", 10**400, float("nan")])
def test_metrics_without_their_figures_are_refused_before_a_step(
    key: str, value: Any, run: Path, start: Start
) -> None:
    path = run / "metrics.jsonl"
    first, *rest = path.read_text().splitlines(keepends=True)
    path.write_text(json.dumps(json.loads(first) | {key: value}) + "\n" + "".join(rest))
    refused("is damaged: line 1", start, "aegis", run, resume=True)


def test_emptied_metrics_are_refused(run: Path, start: Start) -> None:
    (run / "metrics.jsonl").write_text("")
    with pytest.raises(AegisError, match=r"an empty metrics.jsonl after 4 steps"):
        start("aegis", run, resume=True)


# --- what a policy is loaded from -----------------------------------------------------------------

EXPERT = "expert.action_in.weight"


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda t, m: t.pop(EXPERT), f"'{EXPERT}' missing"),
        (lambda t, m: t.update({EXPERT: torch.ones(1)}), "is float32 [1]"),
        (lambda t, m: t.update({"other.x": torch.ones(1)}), "'other.x' not part of it"),
        (lambda t, m: t.pop("proprio.mean"), "'proprio.mean' missing"),
        (lambda t, m: t.update({"action.std": torch.ones(1)}), "'action.std' is float32 [1]"),
        (lambda t, m: m.pop("shape"), "no 'shape'"),
        (lambda t, m: m.update(shape=[1, 2]), "is damaged"),
        (lambda t, m: m["shape"].update(depth=10**9), "'depth' is 1000000000"),
        (lambda t, m: m["shape"].update(width=-1), "'width' is -1"),
        (lambda t, m: m["shape"].update(width=2**63), "'width' is"),
        (lambda t, m: m["shape"].update(width=True), "'width' is True"),
        (lambda t, m: m["shape"].update(chunk="4"), "'chunk' is '4'"),
        (lambda t, m: m["shape"].update(heads=1), "an expert of depth, heads"),
        (lambda t, m: m["shape"].update(more=1), "sizes"),
        (lambda t, m: m.update(replan="often"), "'replan' is 'often'"),
        (lambda t, m: m.pop("method"), "no 'method'"),
        (lambda t, m: m.pop("task"), "no 'task'"),
        (lambda t, m: m.pop("replan"), "no 'replan'"),
        (lambda t, m: m.update(task=3), "'task' is 3"),
        (lambda t, m: m.update(cameras=[1, 2]), "'cameras' is [1, 2]"),
        (lambda t, m: m.update(action_names=["dx"]), "'action_names' has 1 names for 2 numbers"),
        (lambda t, m: m.update(proprio_names="xy"), "'proprio_names' is 'xy'"),
        (lambda t, m: m.update(fps=0), "'fps' is 0"),
        (lambda t, m: m.update(fps="often"), "'fps' is 'often'"),
    ],
)
def test_an_expert_that_does_not_fit_is_refused(
    change: Callable[[dict[str, Tensor], dict[str, Any]], object], found: str, run: Path
) -> None:
    resaved(checkpoint.last(run) / checkpoint.EXPERT, change)
    with pytest.raises(AegisError) as caught:
        checkpoint.load_policy(run)
    assert found in caught.value.found, caught.value


BACKBONE = "layers.0.qkv.weight"


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda t, m: t.pop(BACKBONE), f"'{BACKBONE}' missing"),
        (lambda t, m: t.update({BACKBONE: torch.ones(1)}), "is float32 [1]"),
        (lambda t, m: t.update({BACKBONE: t[BACKBONE].long()}), "is int64"),
        (lambda t, m: t.update({"more": torch.ones(1)}), "'more' not part of it"),
        (lambda t, m: m.pop("vocabulary"), "no 'vocabulary'"),
        (lambda t, m: m.update(vocabulary=3), "is damaged"),
        (lambda t, m: m.update(vocabulary=["a", "b", "c"]), "a vocabulary starts with"),
        (lambda t, m: m["vocabulary"].__setitem__(9, None), "a vocabulary has words, not None"),
        (lambda t, m: m["shape"].update(depth=10**9), "'depth' is"),
        (lambda t, m: m["shape"].update(heads=3), "for 3 heads"),
        (lambda t, m: m.update(shape=None), "is damaged"),
    ],
)
def test_a_backbone_that_does_not_fit_is_refused(
    change: Callable[[dict[str, Tensor], dict[str, Any]], object], found: str, run: Path
) -> None:
    resaved(checkpoint.last(run) / "backbone" / "model.safetensors", change)
    with pytest.raises(AegisError) as caught:
        checkpoint.load_policy(run)
    assert found in caught.value.found, caught.value
