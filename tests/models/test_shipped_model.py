"""The VLM in the package: small enough, made by the recipe beside it, and as good as it says."""

from __future__ import annotations

from pathlib import Path

from aegis_cli.common import artifacts
from aegis_cli.data.vqa.dataset import load_scenes
from aegis_cli.data.vqa.metrics import by_family, grade, score
from aegis_cli.data.vqa.questions import FAMILIES
from aegis_cli.models import backbones
from aegis_cli.models.backbones.embedded import load_file
from aegis_cli.recipes import PretrainRecipe, digest, load

RECIPE = Path(__file__).parent.parent.parent / "recipes" / "pretrain-embedded.yaml"


def test_it_is_small() -> None:
    path = backbones.locate("embedded")
    assert path.stat().st_size <= 12e6
    assert sum(p.numel() for p in backbones.load("embedded").parameters()) <= 5e6


def test_its_provenance_names_the_recipe_that_makes_it() -> None:
    model, provenance = load_file(backbones.locate("embedded"))
    recipe = load(RECIPE, kind=PretrainRecipe)
    assert provenance["recipe_sha256"] == digest(recipe)
    assert (provenance["seed"], provenance["steps"]) == (recipe.seed, recipe.steps)
    assert provenance["questions"] >= 5000 and provenance["accuracy"] >= 0.92
    assert (
        set(provenance["families"]) == set(FAMILIES)
        and min(provenance["families"].values()) >= 0.80
    )
    assert artifacts.read_header(backbones.locate("embedded")).fingerprint == model.fingerprint()


def test_it_answers_held_out_questions_as_well_as_it_says() -> None:
    model, provenance = load_file(backbones.locate("embedded"))
    graded = grade(model.answer, model.answer_log_likelihood, load_scenes("probe", 350), 64)
    low, high = score(graded).interval
    assert low <= provenance["accuracy"] <= high
    assert all(s.accuracy >= 0.75 for s in by_family(graded).values())  # 50 questions each
