"""How given options are handled: each once, texts as they are meant, demonstrations.

Advice that names options can be followed literally.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable
from pathlib import Path

import pytest
from samples.command import ROOT

from aegis_cli import recipes
from aegis_cli.common.events import Event, Warned
from aegis_cli.training import loading

Bad = Callable[..., str]


@pytest.mark.parametrize(
    ("command", "option"),
    [
        (("inspect", "x", "--plot", "a.png", "--plot", "b.png"), "--plot"),
        (("evaluate", "x", "--demos", "a", "--demos=b"), "--demos"),
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


@pytest.mark.parametrize("words", [("--demos=~/arm",), ("--demos", "~/arm")])
def test_a_path_in_the_home_folder_is_one_however_it_is_given(
    words: tuple[str, ...], bad: Bad, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    bad("train", "reach", "--out", "x", *words, says=(f"'{tmp_path}/arm'",))


def test_a_recipe_may_name_what_lies_in_the_home_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    file = tmp_path / "recipe.yaml"
    file.write_text("kind: policy\nname: x\nbackbone: ~/vlm\nprobe: {vqa: [~/a.jsonl, scenes]}\n")
    found = recipes.load(file, ["demos.path=~/arm", "anchor.vqa=./~/b.jsonl"])
    assert (found.backbone, found.demos.path) == (f"{tmp_path}/vlm", f"{tmp_path}/arm")
    assert found.probe.vqa == (f"{tmp_path}/a.jsonl", "scenes")
    assert found.anchor.vqa == "./~/b.jsonl"


@pytest.mark.parametrize(
    ("method", "asked", "command"),
    [
        (
            "nullspace",
            ("anchor.vqa=own.jsonl", "anchor.ask={} Be brief.", "anchor.skip_bad=true"),
            "aegis anchor --vqa own.jsonl --ask '{} Be brief.' --skip-bad --parts inputs",
        ),
        (
            "kfac",
            ("anchor.samples=600", "anchor.batch_size=8", "anchor.memory=900"),
            "aegis anchor --samples 600 --batch-size 8 --memory 900 --parts curvature",
        ),
        (
            "aegis",
            ("anchor.source=demos", "anchor.parts=[moments]"),
            "aegis anchor --demos DEMOS --parts moments",
        ),
    ],
)
def test_the_advice_for_a_missing_anchor_measures_as_the_recipe_says(
    method: str, asked: tuple[str, ...], command: str, bad: Bad, demos_file: Path, tmp_path: Path
) -> None:
    options = [word for each in asked for word in ("--set", each)]
    given = ("--method", method, "--demos", demos_file, "--out", tmp_path / "x")
    bad("train", "reach", *given, *options, says=("no anchor", f"{command} --out FILE"))


def test_the_advice_for_an_anchor_of_another_prompt_can_be_followed(anchor_file: Path) -> None:
    point, said = ROOT / "recipes" / "point.yaml", list[Event]()
    recipe = recipes.load(point, ["anchor.ask=Now {}"])
    loading._warn_of_another_prompt(anchor_file, recipe, said.append)
    assert isinstance(said[0], Warned) and "--ask 'Now {}'" in said[0].text
    advised = said[0].text.partition("or --set ")[2].partition(";")[0]
    assert recipes.load(point, shlex.split(advised)).anchor.ask == "{}"


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
