"""Patterns of dotted names: what each matches, and what is not a pattern."""

from __future__ import annotations

from pathlib import Path

import pytest

from aegis_cli import recipes
from aegis_cli.common.errors import AegisError
from aegis_cli.recipes import Recipe, patterns

NAMES = (
    *(f"layers.{i}" for i in range(12)),
    "vision",
    "model.vision.layers.0",
    "model.vision.layers.0.bias",
    "embeddings",
)


def stands_for(pattern: str) -> list[str]:
    return [name for name in NAMES if patterns.compiled(pattern).fullmatch(name)]


@pytest.mark.parametrize(
    ("pattern", "expected"),
    [
        ("vision", ["vision"]),
        ("layers.1", ["layers.1"]),
        ("layers.0-2", ["layers.0", "layers.1", "layers.2"]),
        ("layers.8-10", ["layers.8", "layers.9", "layers.10"]),
        ("layers.3-3", ["layers.3"]),
        ("layers.1?", ["layers.10", "layers.11"]),
        ("*.layers.0-5", ["model.vision.layers.0"]),
        ("*bias", ["model.vision.layers.0.bias"]),
        ("layer", []),
        ("Vision", []),
    ],
)
def test_what_a_pattern_stands_for(pattern: str, expected: list[str]) -> None:
    assert patterns.is_pattern(pattern)
    assert stands_for(pattern) == expected


def test_a_dot_is_no_wildcard() -> None:
    assert not patterns.compiled("a.b").fullmatch("axb")


@pytest.mark.parametrize(
    "text", ["", ".", "layers.", ".layers", "layers.[0-11]", "layers 0", "layers.5-2", "l.0-1000"]
)
def test_what_is_no_pattern(text: str) -> None:
    assert not patterns.is_pattern(text)


def test_the_ends_of_ranges() -> None:
    assert patterns.at_its_ends("layers.0-11") == ("layers.0", "layers.11")
    assert patterns.at_its_ends("a.1-2.b1-2.3-4") == ("a.1.b1-2.3", "a.2.b1-2.4")
    assert patterns.at_its_ends("layers.*") == ()


@pytest.mark.parametrize(
    ("written", "found"),
    [
        ("vision", "vision"),
        ("[vision, layers.0-11]", ("vision", "layers.0-11")),
        ('["*.bias"]', ("*.bias",)),
        ("null", None),
    ],
)
def test_a_recipe_says_what_does_not_learn(written: str, found: object, tmp_path: Path) -> None:
    path = tmp_path / "recipe.yaml"
    path.write_text(f"kind: policy\nname: r\ntrain:\n  freeze: {written}\n")
    recipe = recipes.load(path)
    assert recipe.train.freeze == found
    path.write_text(recipes.to_yaml(recipe))
    assert recipes.load(path) == recipe


@pytest.mark.parametrize("written", ["[]", "''", "'layers.[0-11]'", "[vision, vision]", "3"])
def test_a_recipe_with_no_pattern_is_refused(written: str, tmp_path: Path) -> None:
    path = tmp_path / "recipe.yaml"
    path.write_text(f"kind: policy\nname: r\ntrain:\n  freeze: {written}\n")
    with pytest.raises(AegisError, match=r"train\.freeze") as caught:
        recipes.load(path)
    assert "layers.0-11" in caught.value.expected


def test_what_is_frozen_is_part_of_what_shapes_the_training() -> None:
    """And the records of runs from before the key existed remain valid."""
    plain = recipes.training_part(Recipe("r"))["train"]
    assert "freeze" not in plain
    frozen = recipes.from_mapping({"name": "r", "train": {"freeze": "vision"}})
    assert recipes.training_part(frozen)["train"] == {**plain, "freeze": "vision"}
