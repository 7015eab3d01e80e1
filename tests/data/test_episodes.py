"""Which episodes `demos.only` names, and that nothing is learned from the others."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from aegis_cli import recipes
from aegis_cli.common.errors import AegisError
from aegis_cli.data import demonstrations, episodes, record
from aegis_cli.data.selection import Selection
from aegis_cli.evaluation import open_loop
from aegis_cli.recipes import Demos, Recipe
from aegis_cli.studies.cells import Cell
from aegis_cli.studies.policy_cells import cell_key

SPLITS = {"train": "0:3", "val": "3:5", "odd": "half"}


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("0", [0]),
        ("3,1", [1, 3]),
        ("0-2, 2-3", [0, 1, 2, 3]),
        ("train", [0, 1, 2]),
        ("val", [3, 4]),
    ],
)
def test_numbers_ranges_and_splits_are_taken(text: str, found: list[int]) -> None:
    assert episodes.chosen(text, 5, SPLITS, Path("x")) == found


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("test", "train, val"),
        ("odd", "ranges"),
        ("3-1", "ranges"),
        ("-1", "ranges"),
        ("4-5", "0 to 4"),
    ],
)
def test_others_are_refused(text: str, said: str) -> None:
    with pytest.raises(AegisError) as caught:
        episodes.chosen(text, 5, SPLITS, Path("x"))
    assert said in caught.value.expected and text.split("-")[-1] in caught.value.found


@pytest.mark.parametrize("seed", range(20))
def test_numbers_are_written_as_they_are_read(seed: int) -> None:
    rng = np.random.default_rng(seed)
    numbers = np.flatnonzero(rng.random(40) < rng.random()).tolist() or [3]
    text = episodes.as_text(numbers)
    assert episodes.listed(text) == numbers
    runs = 1 + sum(b != a + 1 for a, b in itertools.pairwise(numbers))
    assert text.count(",") == runs - 1  # each run of numbers is one range


def test_of_no_episodes_none_can_be_chosen() -> None:
    with pytest.raises(AegisError, match="which has no episode") as caught:
        episodes.chosen("0", 0, {}, Path("arm"))
    assert "-1" not in str(caught.value)
    assert episodes.chosen("train", 0, {"train": "0:0"}, Path("arm")) == []


def test_a_split_of_more_than_a_million_episodes_is_no_list_of_them() -> None:
    with pytest.raises(AegisError, match="demos.only: all"):
        episodes.chosen("all", 5, {"all": f"0:{10**15}"}, Path("x"))


def test_a_split_may_have_more_than_there_is() -> None:
    with pytest.raises(AegisError, match="episode 4 of"):
        episodes.chosen("val", 4, SPLITS, Path("x"))


@pytest.mark.parametrize("seed", range(4))
def test_training_and_validation_are_of_the_chosen_episodes(seed: int, demos_file: Path) -> None:
    found = demonstrations.load(demos_file, 0.3, seed, selection=Selection(only="1-3,6"))
    train, validation = (
        set(found.episode_of[rows].tolist()) for rows in (found.train, found.validation)
    )
    assert len(validation) == 1 and not train & validation
    assert train | validation == {1, 2, 3, 6}


def test_all_episodes_are_those_of_no_choice(demos_file: Path) -> None:
    whole = demonstrations.load(demos_file, 0.3, 0)
    named = demonstrations.load(demos_file, 0.3, 0, selection=Selection(only="0-7"))
    assert torch.equal(whole.train, named.train)
    assert torch.equal(whole.validation, named.validation)


def test_scales_are_of_the_chosen_episodes(demos_file: Path) -> None:
    one, other = (
        demonstrations.load(demos_file, 0.3, 0, selection=Selection(only=only))
        for only in ("0-3", "4-7")
    )
    assert not torch.equal(one.scales()[0].mean, other.scales()[0].mean)


def test_one_episode_is_too_few(demos_file: Path) -> None:
    with pytest.raises(AegisError, match=r"1 episode .* by demos.only: 3") as caught:
        demonstrations.load(demos_file, 0.3, 0, selection=Selection(only="3"))
    assert "demos.only" in caught.value.fix


def test_a_lerobot_datasets_splits_have_names(tmp_path: Path) -> None:
    folder = tmp_path / "dataset"
    record.run("reach", 4, 0, folder, form="lerobot", workers=1)
    info = json.loads((folder / "meta" / "info.json").read_text())
    assert info["splits"] == {"train": "0:4"}
    info["splits"] = {"train": "0:3", "later": "2:4", "strange": [1, 2]}
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    assert demonstrations.learned_from(folder, 4, "later").tolist() == [2, 3]
    found = demonstrations.load(folder, 0.5, 0, image_size=32, selection=Selection(only="later"))
    assert set(found.episode_of[torch.cat([found.train, found.validation])].tolist()) == {2, 3}
    with pytest.raises(AegisError, match="strange"):
        demonstrations.load(folder, 0.5, 0, image_size=32, selection=Selection(only="strange"))


def test_a_choice_is_part_of_the_record_and_none_is_not() -> None:
    plain = Recipe(name="x")
    some = replace(plain, demos=Demos(only="0-3"))
    assert "demos" not in recipes.training_part(plain)
    assert recipes.training_part(some)["demos"] == {"only": "0-3"}
    assert "only" not in recipes.recorded(plain.demos)
    keys = [cell_key(Cell("x", r), "a", demos_sha256="b") for r in (plain, some)]
    assert keys[0] != keys[1]


def test_what_was_not_learned_from_is_not_trained_on(
    recipe: Recipe, start: Callable[..., object], demos_file: Path, tmp_path: Path
) -> None:
    some = replace(recipe, demos=replace(recipe.demos, only="1-3,6"))
    start("naive", tmp_path, recipe=some)
    report = open_loop.run(tmp_path, demos_file, frames=8)
    assert report.split == "validation" and set(report.episodes) < {1, 2, 3, 6}
    asked = open_loop.run(tmp_path, demos_file, episodes=range(8), frames=200)
    assert set(asked.trained_on) == {1, 2, 3, 6} - set(report.episodes)
