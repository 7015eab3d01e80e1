"""`train.keep_checkpoints`: the last ones and the best one stay; there is always at least one."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from samples.training_runs import Start, assert_same_run, contents, stop_at

from aegis_cli.common.events import Event, Progress
from aegis_cli.recipes import Probe, Recipe, training_part
from aegis_cli.training import checkpoint, dry_run, retention, train

PLAIN = Recipe(name="plain")
LOSSES = {2: 5.0, 4: 1.0, 6: 4.0, 8: 3.0, 10: 2.0}


def of(recipe: Recipe, count: int | None, **changes: object) -> Recipe:
    """A recipe with five checkpoints, each with a validation loss."""
    settings = {"steps": 10, "checkpoint_every": 2, "validate_every": 2, **changes}
    return replace(recipe, train=replace(recipe.train, keep_checkpoints=count, **settings))


def steps_in(run: Path) -> list[int]:
    return [int(path.name) for path in checkpoint.whole(run)]


@pytest.fixture
def losses(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[int, float]]:
    """Validation losses by step, instead of measured ones."""
    chosen, begun = dict(LOSSES), train._log

    def log(run: train.TrainingRun, finished: int, *rest: object) -> dict[str, float]:
        with monkeypatch.context() as patch:
            patch.setattr(train, "validation_loss", lambda *_: chosen.get(finished, 9.0))
            return begun(run, finished, *rest)

    monkeypatch.setattr(train, "_log", log)
    yield chosen


@pytest.mark.parametrize(
    ("count", "stay"),
    [
        (1, [4, 10]),
        (2, [4, 8, 10]),
        (4, [4, 6, 8, 10]),
        (9, [2, 4, 6, 8, 10]),
        (None, [2, 4, 6, 8, 10]),
    ],
)
def test_the_last_ones_and_the_best_one_stay(
    count: int | None,
    stay: list[int],
    recipe: Recipe,
    start: Start,
    losses: dict[int, float],
    tmp_path: Path,
) -> None:
    start("naive", tmp_path / "run", recipe=of(recipe, count))
    assert steps_in(tmp_path / "run") == stay
    for path in checkpoint.whole(tmp_path / "run"):
        checkpoint.load_policy(path)
    assert not list((tmp_path / "run" / "checkpoints").glob(".*"))


def test_where_the_last_one_is_the_best_no_other_stays(
    recipe: Recipe, start: Start, losses: dict[int, float], tmp_path: Path
) -> None:
    losses.update({step: 20.0 - step for step in LOSSES})
    start("naive", tmp_path / "run", recipe=of(recipe, 1))
    assert steps_in(tmp_path / "run") == [10]


def test_a_loss_of_another_step_is_no_checkpoints(
    recipe: Recipe, start: Start, losses: dict[int, float], tmp_path: Path
) -> None:
    losses.update({3: 0.1, 6: 7.0, 9: 0.2, 10: 8.0})
    start("naive", tmp_path / "run", recipe=of(recipe, 1, validate_every=3))
    assert steps_in(tmp_path / "run") == [6, 10]


def test_at_no_time_is_there_no_checkpoint(
    recipe: Recipe, start: Start, losses: dict[int, float], tmp_path: Path
) -> None:
    run, most = tmp_path / "run", list[int]()

    def look(event: Event) -> None:
        if isinstance(event, Progress) and event.stage == "train" and event.done >= 2:
            newest = event.done - event.done % 2
            assert checkpoint.step_of(checkpoint.last(run)) == newest
            most.append(len(steps_in(run)))

    start("naive", run, recipe=of(recipe, 1), on_event=look)
    assert max(most) == 2


@pytest.mark.parametrize("cut_at", [3, 4, 5, 7])
def test_an_interrupted_run_ends_with_the_same_checkpoints(
    cut_at: int, recipe: Recipe, start: Start, losses: dict[int, float], tmp_path: Path
) -> None:
    """This holds even if the checkpoint at the interruption is the best so far, and is not kept."""
    losses.update({3: 0.5, 5: 0.4, 7: 0.3})
    kept = of(recipe, 1, validate_every=1)
    start("aegis", tmp_path / "whole", recipe=kept)
    with pytest.raises(KeyboardInterrupt):
        cut = stop_at(cut_at, KeyboardInterrupt())
        start("aegis", tmp_path / "cut", recipe=kept, on_event=cut)
    start("aegis", tmp_path / "cut", recipe=kept, resume=True)
    assert steps_in(tmp_path / "whole") == [4, 10]
    assert_same_run(tmp_path / "cut", tmp_path / "whole")


def test_a_run_may_go_on_with_another_number(
    recipe: Recipe, start: Start, losses: dict[int, float], tmp_path: Path
) -> None:
    """As when its disk is full: the number affects no weight."""
    many, few = of(recipe, None), of(recipe, 1)
    assert training_part(many) == training_part(few)
    with pytest.raises(KeyboardInterrupt):
        start("naive", tmp_path, recipe=many, on_event=stop_at(8, KeyboardInterrupt()))
    start("naive", tmp_path, recipe=few, resume=True)
    assert steps_in(tmp_path) == [4, 10]


def laid_out(run: Path, steps: Sequence[int], losses: dict[int, float]) -> Path:
    """The outline of a run: its log, and its checkpoints as far as they matter here."""
    for step in steps:
        folder = run / "checkpoints" / f"{step:06d}"
        folder.mkdir(parents=True)
        (folder / checkpoint.EXPERT).touch()
    lines = [json.dumps({"step": step, "validation_loss": loss}) for step, loss in losses.items()]
    (run / "metrics.jsonl").write_text("".join(f"{line}\n" for line in lines))
    return run


def test_later_checkpoints_than_the_new_one_stay(tmp_path: Path) -> None:
    """They exist if a user went back to an earlier checkpoint."""
    run = laid_out(tmp_path, (2, 4, 6, 8), {2: 1.0, 4: 2.0})
    retention.prune(run, 6, 1, PLAIN)
    assert steps_in(run) == [2, 6, 8]


def test_steps_of_seven_digits_are_later_than_those_of_six(tmp_path: Path) -> None:
    run = laid_out(tmp_path, (999_999, 1_000_000), {})
    retention.prune(run, 1_000_000, 1, PLAIN)
    assert steps_in(run) == [1_000_000]


def test_of_equal_losses_the_earliest_stays(tmp_path: Path) -> None:
    run = laid_out(tmp_path, (2, 4, 6), {2: 1.0, 4: 1.0, 6: 3.0})
    retention.prune(run, 6, 1, PLAIN)
    assert steps_in(run) == [2, 6]


@pytest.mark.parametrize(
    ("gate", "drops", "stay"),
    [
        ("mean", {2: 0.5, 4: 4.0, 6: 1.0}, [6, 8]),
        ("upper", {2: 0.5, 4: 4.0, 6: 1.0}, [2, 8]),  # the interval reaches one point further
        ("mean", {2: 5.0, 4: 4.0, 6: 6.0}, [4, 8]),  # none is within it: the smallest loss
        ("mean", {2: 0.5, 6: 1.0}, [6, 8]),  # nothing is known about the one with the smallest loss
        ("mean", {}, [4, 8]),
    ],
)
def test_the_best_one_loses_no_more_than_the_recipe_allows(
    gate: str, drops: dict[int, float], stay: list[int], tmp_path: Path
) -> None:
    run = laid_out(tmp_path, (2, 4, 6, 8), {})
    lines: list[dict[str, float]] = []
    for step, loss in {2: 5.0, 4: 1.0, 6: 4.0, 8: 9.0}.items():
        line: dict[str, float] = {"step": step, "validation_loss": loss}
        if (drop := drops.get(step)) is not None:
            ends = {"vqa_drop_low": drop - 1, "vqa_drop_high": drop + 1}
            line |= {"vqa_accuracy": 0.9, "vqa_cross_entropy": 0.1, "vqa_drop_points": drop} | ends
        lines.append(line)
    (run / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    limited = replace(PLAIN, probe=Probe(max_drop=1.5, gate=gate, while_training=100))
    retention.prune(run, 8, 1, limited)
    assert steps_in(run) == stay


def test_a_dry_run_counts_those_that_are_there_at_one_time(
    recipe: Recipe, demos_file: Path, tmp_path: Path
) -> None:
    def planned(count: int | None, **changes: object) -> int:
        settings = of(recipe, count, **changes)
        return dry_run.run(settings, "naive", demos_file, None, tmp_path / "run").checkpoints

    assert [planned(count) for count in (None, 1, 2, 9)] == [5, 3, 4, 5]
    assert retention.most_at_once(5, there=2, count=1) == 1
    assert contents(tmp_path) == {}
