"""What is given twice and taken once is refused, and what begins with a place is a text."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from samples.command import ROOT

from aegis_cli import recipes

Bad = Callable[..., str]


@pytest.mark.parametrize(
    ("command", "option"),
    [
        (("inspect", "x", "--plot", "a.png", "--plot", "b.png"), "--plot"),
        (("train", "reach", "--demos", "a", "--out", "x", "--demos=b"), "--demos"),
        (("probe", "--max-drop", "1", "x", "--max-drop", "2"), "--max-drop"),
    ],
)
def test_an_option_of_one_value_is_taken_once(
    command: tuple[str, ...], option: str, bad: Bad
) -> None:
    bad(*command, says=(f"{option} twice", f"one {option}"))


def test_options_of_several_values_may_be_repeated(bad: Bad) -> None:
    bad("train", "reach", "--out", "x", "--set", "a=1", "--set", "b=2", says=("'a'", "'b'"))


@pytest.mark.parametrize("text", ["{}", "{} Answer briefly: yes or no.", '"{}"'])
def test_what_a_question_becomes_needs_no_quotes(text: str) -> None:
    found = recipes.load(
        ROOT / "recipes" / "point.yaml", [f"probe.ask={text}", f"anchor.ask={text}"]
    )
    assert found.probe.ask == found.anchor.ask == text.strip('"')


def test_a_training_learns_from_what_its_recipe_names(
    aegis: Callable[..., tuple[int, str, str]], demos_file: Path, tmp_path: Path
) -> None:
    named = ("--set", f"demos.path={demos_file}", "--set", "train.steps=1")
    small = ("train", "reach", "--method", "naive", *named, "--set", "train.batch_size=2")
    for out, given in (("own", ()), ("other", ("--demos", str(demos_file.resolve())))):
        code, _, err = aegis(*small, *given, "--out", tmp_path / out)
        assert code == 0, err
        assert recipes.load(tmp_path / out / "recipe.yaml").demos.path == str(demos_file)


def test_a_run_says_what_it_was_trained_on(
    aegis: Callable[..., tuple[int, str, str]], demos_file: Path, tmp_path: Path
) -> None:
    small = ("train", "reach", "--method", "naive", "--set", "train.steps=1")
    other = ("--set", "demos.path=somewhere/else", "--set", "train.batch_size=2")
    code, _, err = aegis(*small, *other, "--demos", demos_file, "--out", tmp_path / "x")
    assert code == 0, err
    assert recipes.load(tmp_path / "x" / "recipe.yaml").demos.path == str(demos_file)
