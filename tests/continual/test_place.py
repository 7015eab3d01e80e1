"""The position in a stream: what was saved is resumed, and anything else is refused."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from aegis_cli.continual.state import TaskInProgress

PLACE = TaskInProgress(
    step=3,
    phase=1,
    phase1_steps=None,
    trained_phase1={"map": 4},
    masses={"map": [0.25, 0.75]},
    pruned={"map": [1]},
    vqa=[[0.5, 1.25]],
    window=[2, 0.5],
)


def test_what_was_saved_is_a_place() -> None:
    TaskInProgress(**dataclasses.asdict(PLACE)).check(tasks=2, steps=5)
    TaskInProgress().check(tasks=1, steps=1)


@pytest.mark.parametrize(
    "change",
    [
        {"step": "3"},
        {"step": 6},
        {"task": 3},
        {"phase": 3},
        {"quiet": None},
        {"masses": {"map": "all"}},
        {"pruned": {"map": [0.5]}},
        {"window": [None]},
        {"vqa": [[0.5]]},
        {"vqa": [[float("nan"), 1.0]]},
        {"records": [{}]},
    ],
)
def test_another_type_or_number_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(ValueError):
        dataclasses.replace(PLACE, **change).check(tasks=2, steps=5)
