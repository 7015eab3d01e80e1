"""Recipe settings for a merge after the training."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from aegis_cli.common.errors import AegisError
from aegis_cli.merging.settings import MergeSettings
from aegis_cli.recipes import MERGE_NEEDS, MERGES, Anchor, Merge, Recipe, changed, check_run
from aegis_cli.recipes.cross_checks import merge_checks

PARTS = ("moments", "inputs", "curvature")


def recipe(methods: tuple[str, ...] = ("naive",), parts: Any = PARTS, **merge: Any) -> Recipe:
    anchor = replace(Anchor(), parts=parts)
    return Recipe(name="x", methods=methods, anchor=anchor, merge=Merge(**merge))


def test_without_a_method_nothing_is_merged_and_nothing_is_asked() -> None:
    assert changed(Merge()) == {} and Merge().method is None
    assert list(merge_checks(recipe(("naive", "stop-gradient")), ("naive", "stop-gradient"))) == []


@pytest.mark.parametrize("method", MERGES)
def test_each_method_is_accepted_with_the_anchors_part_that_it_reads(method: str) -> None:
    check_run(recipe(method=method, strength=0.5))
    if method in MERGE_NEEDS:
        with pytest.raises(AegisError, match=MERGE_NEEDS[method]):
            check_run(recipe(parts=("moments",), method=method))


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ({"strength": 3.0}, "without merge.method"),
        ({"damping": 0.5}, "without merge.method"),
        ({"method": "linear", "strength": 2.0}, "from 0 to 1"),
        ({"method": "linear", "strength": 0.5, "damping": 0.5}, "a method that reads it"),
        ({"method": "kfac-shrink", "frames": 9}, "a method that reads it"),
        ({"method": "factors", "methods": ("naive", "stop-gradient")}, "stop-gradient"),
    ],
)
def test_what_means_nothing_is_refused(keys: dict[str, Any], says: str) -> None:
    with pytest.raises(AegisError, match=says):
        check_run(recipe(**keys))


def test_command_and_recipe_have_the_same_defaults() -> None:
    command, section = MergeSettings(), Merge()
    assert (command.damping, command.frames) == (section.damping, section.frames)
