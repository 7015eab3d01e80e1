"""The dual encoder in the package: small, made by its recipe, and as good as it claims."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from aegis_cli.common import artifacts
from aegis_cli.common.events import ignore
from aegis_cli.data.streams import embedded, names
from aegis_cli.evaluation import zero_shot
from aegis_cli.models import backbones
from aegis_cli.models.backbones.embedded_dual import load_file
from aegis_cli.recipes import DualRecipe, digest, load

PATH = backbones.locate("embedded-dual")
RECIPE = Path(__file__).parent.parent.parent / "recipes" / "pretrain-dual.yaml"
MAIN = names.STREAMS["primer-1"]


def test_it_is_small() -> None:
    assert PATH.stat().st_size <= 4e6
    assert sum(p.numel() for p in backbones.load_dual("embedded-dual").parameters()) <= 1.5e6


def test_its_provenance_names_the_recipe_that_makes_it() -> None:
    model, provenance = load_file(PATH)
    recipe = load(RECIPE, kind=DualRecipe)
    assert provenance["recipe_sha256"] == digest(recipe)
    assert (provenance["seed"], provenance["steps"]) == (recipe.seed, recipe.steps)
    assert set(provenance["zero_shot"]) == set(names.TASKS) and provenance["image_to_text"] >= 0.9
    assert artifacts.read_header(PATH).fingerprint == model.fingerprint()


@pytest.mark.parametrize("name", MAIN)
def test_zero_shot_is_well_above_chance_and_leaves_something_to_learn(name: str) -> None:
    accuracy, chance = load_file(PATH)[1]["zero_shot"][name], 1 / len(names.TASKS[name].classes)
    assert 1.5 * chance <= accuracy <= 0.85


@pytest.mark.parametrize("name", ["digits", "letters", "places"])
def test_it_names_validation_pictures_as_well_as_it_says(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Within three standard errors; only the first pictures of that part are rendered."""
    model, provenance = load_file(PATH)
    if name != "digits":
        monkeypatch.setattr(embedded, "COUNTS", {"train": 8, "validation": 100, "test": 8})
    task = embedded.task(name, model.image_size, tmp_path, ignore)
    said = provenance["zero_shot"][name]
    found = zero_shot.accuracy(model, task, task.validation)
    assert (
        abs(found - said)
        <= 3 * math.sqrt(said * (1 - said) * (1 / len(task.validation) + 1 / 200)) + 0.01
    )
