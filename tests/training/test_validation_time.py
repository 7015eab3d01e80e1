"""How long a validation takes in a dry run: estimated from the second pass of each part."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from samples.training_runs import SETTINGS, contents

from aegis_cli.common.events import Event, OnEvent, Progress, Warned
from aegis_cli.recipes import Probe, Recipe
from aegis_cli.training import dry_run, validation_time
from aegis_cli.training.validation_time import expected_s


class Clock:
    """A clock that advances only when told to."""

    def __init__(self) -> None:
        self.now = 0.0

    def perf_counter(self) -> float:
        return self.now


SIZES = st.lists(st.integers(1, 9), min_size=1, max_size=6)


@given(sizes=SIZES, first=st.integers(0, 50), each=st.integers(1, 5))
def test_what_is_done_once_does_not_count_where_there_is_a_second_part(
    sizes: list[int], first: int, each: int
) -> None:
    """Each part takes time in proportion to its size, and the first one takes extra time."""
    clock, done = Clock(), 0
    taken: list[int] = []

    def work(on_event: OnEvent) -> None:
        nonlocal done
        on_event(Warned("x", "not of the progress"))
        on_event(Progress("x", 0, sum(sizes), "frames"))
        clock.now += first
        for size in sizes:
            clock.now += each * size
            done += size
            taken.append(size)
            on_event(Progress("x", done, sum(sizes), "frames"))

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(validation_time, "time", clock)
        found = expected_s(work)
    once = 0 if len(sizes) > 1 else first
    assert found == pytest.approx(once + each * sum(sizes))
    assert taken == sizes[:2]


def test_an_error_of_the_work_is_its_own() -> None:
    def work(on_event: OnEvent) -> None:
        on_event(Progress("x", 1, 9, "frames"))
        raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        expected_s(work)


@pytest.fixture
def watching(recipe: Recipe) -> Recipe:
    """Everything that a validation can do, with several passes for each part."""
    return replace(
        recipe,
        train=replace(SETTINGS, validate_actions=12, validation_share=0.4),
        probe=Probe(while_training=24, batch_size=4),
        rollout=replace(recipe.rollout, while_training=2),
    )


@pytest.mark.parametrize(
    ("method", "without"), [("naive", set()), ("lora", set()), ("stop-gradient", {"questions"})]
)
def test_a_dry_run_tells_the_parts_that_there_are(
    method: str, without: set[str], watching: Recipe, demos_file: Path, tmp_path: Path
) -> None:
    """A frozen backbone is not asked again."""
    events: list[Event] = []
    plan = dry_run.run(watching, method, demos_file, None, tmp_path / "run", False, events.append)
    # After the steps, whose gradients and moments are in memory during a training's validation.
    stages = [e.stage for e in events if isinstance(e, Progress) and e.stage.startswith("dry run")]
    assert stages.index("dry run (validation)") > max(
        place for place, stage in enumerate(stages) if stage == "dry run"
    )
    assert plan.validation_s is not None and plan.step_s is not None
    assert plan.validation_s.keys() == {"loss", "questions", "episodes", "actions"} - without
    assert all(seconds > 0 for seconds in plan.validation_s.values())
    validations = SETTINGS.steps // SETTINGS.validate_every
    took = SETTINGS.steps * plan.step_s + validations * sum(plan.validation_s.values())
    assert plan.hours == pytest.approx(took / 3600)
    assert contents(tmp_path) == {}
