"""Training on several sets of demonstrations: what it learns, records, and refuses."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from samples.sets import halves
from samples.training_runs import (
    SETTINGS,
    TIMES,
    Start,
    assert_resumes,
    assert_same_run,
    metrics,
)

from aegis_cli import inspection, recipes
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import ignore
from aegis_cli.data import demonstrations
from aegis_cli.evaluation import open_loop
from aegis_cli.merging.settings import MergeSettings
from aegis_cli.merging.sources import PolicyRun
from aegis_cli.methods import METHODS
from aegis_cli.publishing import card
from aegis_cli.recipes import Recipe
from aegis_cli.reporting import gather
from aegis_cli.studies.cells import Cell
from aegis_cli.studies.policy_cells import cell_key
from aegis_cli.training import assemble, dry_run, loading

EPISODES = 8
Aegis = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def sets(demos_file: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The two halves of the file."""
    return halves(demos_file, tmp_path_factory.mktemp("halves"), EPISODES)


def mixed(recipe: Recipe, sets: tuple[Path, ...], **demos: Any) -> Recipe:
    named = replace(recipe.demos, path=tuple(map(str, sets)), **demos)
    return replace(recipe, demos=named)


@pytest.fixture(scope="module")
def run(
    recipe: Recipe,
    start: Start,
    sets: tuple[Path, Path],
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    """A run on both, with two of three frames from the first; read-only."""
    out = tmp_path_factory.mktemp("run") / "mixed"
    start("naive", out, recipe=mixed(recipe, sets, weights=(2.0, 1.0)), demos=sets)
    return out


def weights(out: Path) -> dict[str, torch.Tensor]:
    """The weights that a run has learned."""
    last = out / "checkpoints" / "last"
    found = load_file(last / "expert.safetensors")
    return found | load_file(last / "backbone" / "model.safetensors")


def assert_same_training(one: Path, other: Path) -> None:
    here, there = weights(one), weights(other)
    assert here.keys() == there.keys()
    assert [name for name in here if not torch.equal(here[name], there[name])] == []
    assert metrics(one, TIMES) == metrics(other, TIMES)


def seed_of_one_split(share: float) -> int:
    """A seed with which the halves hold out the same episodes as the whole file."""
    middle = EPISODES // 2

    def agrees(seed: int) -> bool:
        of_half = set(demonstrations.held_out(middle, share, seed).tolist())
        wanted = of_half | {episode + middle for episode in of_half}
        return set(demonstrations.held_out(EPISODES, share, seed).tolist()) == wanted

    return next(filter(agrees, range(1000)))


# --- what is learned ------------------------------------------------------------------------------


def test_a_list_of_one_set_trains_to_the_same_bytes(
    naive_run: Path, start: Start, demos_file: Path, tmp_path: Path
) -> None:
    start("naive", tmp_path, demos=(demos_file,))
    assert_same_run(tmp_path, naive_run)


def test_two_halves_train_to_the_weights_of_the_whole(
    recipe: Recipe, start: Start, sets: tuple[Path, Path], tmp_path: Path
) -> None:
    share = 0.25
    same = replace(recipe, train=replace(SETTINGS, validation_share=share))
    same = replace(same, seed=seed_of_one_split(share))
    start("aegis", tmp_path / "whole", recipe=same)
    start("aegis", tmp_path / "halves", recipe=same, demos=sets)
    assert_same_training(tmp_path / "whole", tmp_path / "halves")


def test_weights_that_are_the_sizes_change_nothing_and_others_do(
    recipe: Recipe, start: Start, sets: tuple[Path, Path], run: Path, tmp_path: Path
) -> None:
    share, seed = SETTINGS.validation_share, recipe.seed
    sizes = tuple(float(len(demonstrations.load(path, share, seed).train)) for path in sets)
    for name, told in (("none", None), ("sizes", sizes)):
        chosen = mixed(recipe, sets, weights=told)
        start("naive", tmp_path / name, recipe=chosen, demos=sets)
    assert_same_training(tmp_path / "none", tmp_path / "sizes")
    learned, other = weights(run), weights(tmp_path / "none")
    assert any(not torch.equal(learned[name], other[name]) for name in learned)


def test_steps_have_the_shares_of_the_weights(
    recipe: Recipe, sets: tuple[Path, Path], tmp_path: Path
) -> None:
    chosen = mixed(recipe, sets, weights=(3.0, 1.0))
    made = assemble.build(chosen, METHODS["naive"], sets, None, tmp_path, ignore)
    total = len(made.demos.train)
    epoch = np.concatenate([made.order.rows(step) for step in range(total)])  # `batch_size` epochs
    episodes = made.demos.episode_of[made.demos.train[torch.from_numpy(epoch)]]
    share = float((episodes < EPISODES // 2).double().mean())
    assert share == pytest.approx(0.75, abs=1 / total)


def test_a_run_on_several_sets_is_resumed_to_the_same_bytes(
    recipe: Recipe, start: Start, sets: tuple[Path, Path], tmp_path: Path
) -> None:
    def begin(method: str, out: Path, **changes: Any) -> object:
        return start(method, out, demos=sets, **changes)

    assert_resumes(begin, "naive", mixed(recipe, sets, weights=(2.0, 1.0)), tmp_path)


# --- what is recorded -----------------------------------------------------------------------------


def test_a_run_is_not_resumed_on_other_sets(
    recipe: Recipe, start: Start, sets: tuple[Path, Path], run: Path, demos_file: Path
) -> None:
    chosen = mixed(recipe, sets, weights=(2.0, 1.0))
    with pytest.raises(AegisError, match="a different set 2 of the demonstrations than"):
        start("naive", run, recipe=chosen, demos=(sets[0], demos_file), resume=True)


def test_a_run_is_not_resumed_by_other_weights(
    recipe: Recipe, start: Start, sets: tuple[Path, Path], run: Path
) -> None:
    with pytest.raises(AegisError) as caught:
        start("naive", run, recipe=mixed(recipe, sets), demos=sets, resume=True)
    assert "demos.weights: [2.0, 1.0] there, nothing here" in caught.value.found


def test_weights_are_part_of_a_cells_key_and_none_are_not(
    recipe: Recipe, sets: tuple[Path, Path]
) -> None:
    plain, weighted = mixed(recipe, sets), mixed(recipe, sets, weights=(2.0, 1.0))
    keys = [cell_key(Cell("x", each), "a", demos_sha256="b") for each in (plain, weighted)]
    assert keys[0] != keys[1]
    assert keys[0] == cell_key(Cell("x", recipe), "a", demos_sha256="b")
    assert "demos" not in recipes.training_part(plain)


@pytest.mark.parametrize("number", [0, 1])
def test_each_set_is_known_to_its_run(number: int, sets: tuple[Path, Path], run: Path) -> None:
    report = open_loop.run(run, sets[number], frames=4, keep=False)
    held_out = demonstrations.load(sets[number], SETTINGS.validation_share, 0)
    own = set(held_out.episode_of[held_out.validation].tolist())
    assert report.split == "validation" and set(report.episodes) == own


def test_others_are_known_to_be_none_of_them(demos_file: Path, run: Path) -> None:
    report = open_loop.run(run, demos_file, frames=100, keep=False)
    assert (report.split, len(report.episodes)) == (open_loop.OTHER, EPISODES)


def test_a_run_and_its_report_tell_the_sets(sets: tuple[Path, Path], run: Path) -> None:
    facts = inspection.run(run).facts
    assert facts["demos"] == [str(path) for path in sets] and facts["weights"] == [2.0, 1.0]
    train = gather.run(run).commands[0]
    assert train.count("--demos") == 2 and all(str(path) in train for path in sets)


def test_a_dry_run_tells_what_is_seen_of_each_set(
    recipe: Recipe, sets: tuple[Path, Path], demos_file: Path, tmp_path: Path
) -> None:
    chosen = mixed(recipe, sets, weights=(2.0, 1.0))
    plan = dry_run.run(chosen, "naive", sets, None, tmp_path / "x")
    assert plan.sets is not None and list(plan.sets) == [str(path) for path in sets]
    found = list(plan.sets.values())
    assert sum(own["training_frames"] for own in found) == plan.training_frames
    assert found[0]["share"] == pytest.approx(2 / 3, abs=1 / plan.training_frames)
    seen = sum(own["training_frames"] * own["epochs"] for own in found)
    assert seen == pytest.approx(SETTINGS.steps * SETTINGS.batch_size)
    assert plan.memory_mb["method"] == 0  # no frame counts as memory
    assert dry_run.run(recipe, "naive", demos_file, None, tmp_path / "x").sets is None


def test_a_merge_finds_the_sets_by_the_recipe(run: Path, sets: tuple[Path, Path]) -> None:
    named, given = (PolicyRun(run, MergeSettings(demos=own), ignore) for own in (None, sets))
    assert named._demos.sha256 == given._demos.sha256
    with pytest.raises(AegisError, match="other demonstrations in"):
        _ = PolicyRun(run, MergeSettings(demos=(sets[1], sets[0])), ignore)._demos


def test_a_card_names_every_set_of_the_hub() -> None:
    front = card._front_matter(card.AEGIS, None, ["lab/arm", "lab/hand"])
    assert "datasets: [lab/arm, lab/hand]" in front


# --- the recipe and the command -------------------------------------------------------------------


def test_an_anchor_of_frames_is_of_one_set(recipe: Recipe, sets: tuple[Path, Path]) -> None:
    shown = replace(recipe.anchor, source="demos", parts=("moments",))
    with pytest.raises(AegisError, match=r"anchor.source: demos with demonstrations in .* and"):
        loading.check_named(replace(mixed(recipe, sets), anchor=shown), ignore)


def test_weights_belong_to_a_path(recipe: Recipe) -> None:
    alone = replace(recipe, demos=replace(recipe.demos, weights=(1.0, 1.0)))
    with pytest.raises(AegisError, match=r"demos.weights without demos.path"):
        loading.check_named(alone, ignore)


def test_weights_may_be_equal_and_paths_may_not(tmp_path: Path) -> None:
    made = tmp_path / "x.yaml"
    made.write_text("name: x\ndemos: {path: [a, b], weights: [1, 1]}\n")
    found = recipes.load(made).demos
    assert (found.path, found.weights) == (("a", "b"), (1.0, 1.0))
    again = tmp_path / "again.yaml"
    again.write_text(recipes.to_yaml(recipes.load(made)))
    assert recipes.load(again) == recipes.load(made)
    for bad in ("demos.path=[a, a]", "demos.weights=[1, 0]", "demos.weights=[]"):
        with pytest.raises(AegisError, match=bad.partition("=")[0]):
            recipes.load(made, [bad])


def test_the_command_takes_several_sets(
    aegis: Aegis, sets: tuple[Path, Path], tmp_path: Path
) -> None:
    small = ("--set", "train.steps=1", "--set", "train.batch_size=2", "--json")
    given = [word for path in sets for word in ("--demos", path)]
    command = ("train", "reach", "--method", "naive", *given, *small)
    code, text, err = aegis(*command, "--set", "demos.weights=[1, 3]", "--out", tmp_path / "x")
    assert code == 0, err
    assert json.loads(text)["steps"] == 1
    kept = recipes.load(tmp_path / "x" / "recipe.yaml").demos
    assert (kept.path, kept.weights) == (tuple(map(str, sets)), (1.0, 3.0))
    # The recipe in the run folder names them too.
    again = ("train", tmp_path / "x" / "recipe.yaml", "--out", tmp_path / "y", "--json")
    code, _, err = aegis(*again)
    assert code == 0, err
    assert_same_training(tmp_path / "x", tmp_path / "y")


def test_weights_that_do_not_fit_the_command_are_refused(
    bad: Callable[..., str], sets: tuple[Path, Path]
) -> None:
    given = [word for path in sets for word in ("--demos", path)]
    told = ("--set", "demos.weights=[1, 2, 3]")
    command = ("train", "reach", "--method", "naive", *given, *told, "--out", "x")
    bad(*command, says=("demos.weights: 1, 2, 3 with 2 sets",))
