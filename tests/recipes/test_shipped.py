"""The recipes that are shipped with Aegis, by name."""

from __future__ import annotations

from pathlib import Path

import pytest

from aegis_cli.common.errors import AegisError
from aegis_cli.recipes import shipped
from aegis_cli.recipes.kinds import KINDS, name_of
from aegis_cli.recipes.study_cells import load_any

NAMES = [recipe.name for recipe in shipped.listed().recipes]


@pytest.mark.parametrize("name", NAMES)
def test_a_recipe_that_ships_can_be_read_and_says_its_command_and_purpose(name: str) -> None:
    (recipe,) = [recipe for recipe in shipped.listed().recipes if recipe.name == name]
    loaded = load_any(shipped.path(name))
    assert loaded.name == name and name_of(type(loaded)) == recipe.kind
    assert recipe.command.startswith("aegis ") and f"recipes/{name}.yaml" in recipe.command
    assert len(recipe.about) > 20


def test_recipes_of_a_kind_stand_together_and_the_quickstart_comes_first() -> None:
    found = [recipe.kind for recipe in shipped.listed().recipes]
    assert NAMES[0] == "quickstart"
    assert found == sorted(found, key=list(KINDS).index) and set(found) == set(KINDS)


def test_a_path_that_exists_comes_before_a_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert shipped.find(Path("quickstart")) == shipped.path("quickstart")
    Path("quickstart").write_text("name: mine", encoding="utf-8")
    assert shipped.find(Path("quickstart")) == Path("quickstart")
    for given in ("quickstart.yaml", "recipes/quickstart", "./none/quickstart"):
        assert shipped.find(Path(given)) == Path(given)


def test_a_name_that_no_recipe_has_is_told_all_that_there_are() -> None:
    with pytest.raises(AegisError) as found:
        shipped.find(Path("quikstart"))
    assert all(name in found.value.expected for name in NAMES)
