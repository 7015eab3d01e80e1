"""The VLMs in the package: small enough, made by their recipes, and as good as they claim."""

from __future__ import annotations

from pathlib import Path

import pytest

from aegis_cli.common import artifacts, files
from aegis_cli.common.errors import AegisError
from aegis_cli.data.vqa import easy, sets
from aegis_cli.data.vqa.easy import NAME as EASY
from aegis_cli.data.vqa.metrics import by_family, grade, score
from aegis_cli.data.vqa.questions import FAMILIES
from aegis_cli.models import backbones
from aegis_cli.models.backbones.embedded import load_file
from aegis_cli.recipes import PretrainRecipe, digest, load

RECIPES = Path(__file__).parent.parent.parent / "recipes"
NAMES = ("embedded", "embedded-easy")
SHA256 = "e576cf9fdf9f053d37736ef1946cf5a1bf247519f923b09e9becc104a0316a56"
FINGERPRINT = "efaf5fc3906ddcfc9ff03180743e496c479e618fcf5aa9ba3a8483afd13af818"
# The accuracy that every family of each set reaches, whichever thirty or so questions are asked.
LEAST = 0.75


@pytest.mark.parametrize("name", NAMES)
def test_it_is_small(name: str) -> None:
    path = backbones.locate(name)
    assert path.stat().st_size <= 12e6
    assert sum(p.numel() for p in backbones.load(name).parameters()) <= 5e6


@pytest.mark.parametrize("name", NAMES)
def test_its_provenance_names_the_recipe_that_makes_it(name: str) -> None:
    model, provenance = load_file(backbones.locate(name))
    recipe = load(RECIPES / f"pretrain-{name}.yaml", kind=PretrainRecipe)
    assert provenance["recipe_sha256"] == digest(recipe)
    assert (provenance["seed"], provenance["steps"]) == (recipe.seed, recipe.steps)
    assert provenance["questions"] >= 5000 and provenance["accuracy"] >= 0.92
    assert (
        set(provenance["families"]) == set(FAMILIES)
        and min(provenance["families"].values()) >= 0.80
    )
    assert artifacts.read_header(backbones.locate(name)).fingerprint == model.fingerprint()


def test_the_weights_that_finished_cells_are_kept_under_have_not_changed() -> None:
    assert artifacts.read_header(backbones.locate("embedded")).fingerprint == FINGERPRINT
    assert files.sha256_file(backbones.locate("embedded")) == SHA256


@pytest.mark.parametrize(
    ("name", "vqa"), [("embedded", "scenes"), ("embedded-easy", "scenes"), ("embedded-easy", EASY)]
)
def test_it_answers_held_out_questions_as_well_as_it_says(name: str, vqa: str) -> None:
    model, provenance = load_file(backbones.locate(name))
    said = provenance if vqa == "scenes" else provenance[vqa]
    asked = sets.read(vqa).choose("probe", 210, 0).sized(model.image_size)
    graded = grade(model.answers, asked, 64)
    low, high = score(graded).interval
    assert low <= said["accuracy"] <= high
    assert all(s.accuracy >= LEAST for s in by_family(graded).values())


def test_embedded_easy_was_asked_the_whole_test_part_of_easy_vqa() -> None:
    _, provenance = load_file(backbones.locate("embedded-easy"))
    own = provenance[EASY]
    assert own["questions"] == 9673 and own["accuracy"] >= 0.95
    assert set(own["families"]) == set(easy.FAMILIES)


def test_embedded_easy_is_inspected_by_name(aegis) -> None:
    code, out, _ = aegis("inspect", "embedded-easy")
    assert code == 0 and "easy-vqa" in out and "exists-not" in out


def test_embedded_easy_reads_robot_instructions_that_embedded_does_not() -> None:
    backbones.load("embedded-easy").check_text("press the button from above", "yes")
    with pytest.raises(AegisError, match="the word 'press'"):
        backbones.load("embedded").check_text("press the button from above", "yes")
