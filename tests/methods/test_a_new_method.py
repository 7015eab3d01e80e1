"""What a new method needs: its file, its name and its options, and no other change."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import pytest
from samples import package_copy
from samples.command_blocks import ROOT

from aegis_cli import methods, recipes
from aegis_cli.common import artifacts
from aegis_cli.methods.base import Method, MethodContext, Parts, Pass

HALF = '''
"""Plain fine-tuning with half the gradient in the backbone."""

from aegis_cli.methods.base import Method, Parts, MethodContext, train_all


def start(context: MethodContext) -> Parts:
    learning = context.learning().values()

    def halve() -> None:
        for parameter in learning:
            if parameter.grad is not None:
                parameter.grad.mul_(0.5)

    return Parts(pull=halve)


METHOD = Method("half-gradient", "half the gradient", train_all, start=start)
'''
AWAY = '''
"""Project the task gradient off that of the activations' squares, for which no anchor is read."""

import torch

from aegis_cli.core import projection
from aegis_cli.methods.base import Method, Parts, MethodContext, train_all


def start(context: MethodContext) -> Parts:
    def penalty(seen):
        each = torch.stack([hidden.square().mean() for hidden in seen.hidden])
        return each.mean(), each.detach()

    return Parts(penalty=penalty, combine=projection.aegis)


METHOD = Method("away", "a penalty of its own", train_all, start=start)
'''
PAGE = (ROOT / "docs" / "add-a-method.md").read_text(encoding="utf-8")
OPTIONS = """
@section
class Leash:
    \"\"\"Options of the method leash.\"\"\"

    weight: float = key(NOT_NEGATIVE, default=0.1, doc="Share of the gradient's norm that pulls.")
"""
RECIPE = """
name: new
backbone: {backbone}
expert: {{width: 16}}
train: {{method: {method}, steps: 2, batch_size: 2, warmup: 0}}
"""


def trained(package: Path, method: str, backbone: Path, demos: Path, more: str = "") -> Path:
    """The run of a copy of the package that includes the method."""
    recipe, run = package.parent / "recipe.yaml", package.parent / "run"
    recipe.write_text(RECIPE.format(method=method, backbone=backbone) + more)
    done = package_copy.run(package, "aegis_cli", "train", recipe, "--demos", demos, "--out", run)
    assert done.returncode == 0, done.stdout + done.stderr
    assert method in done.stdout
    return run


def test_the_pages_method_trains(tmp_path: Path, tiny_folder: Path, demos_file: Path) -> None:
    """A reader follows the page, and does nothing else."""
    package = package_copy.copied(tmp_path)
    source = re.search(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    assert source is not None
    (package / "methods" / "leash.py").write_text(source[1], encoding="utf-8")
    package_copy.declare(package, "METHODS", "leash")
    package_copy.declare_options(package, OPTIONS, "Leash", "leash")
    run = trained(package, "leash", tiny_folder, demos_file, "leash: {weight: 0.5}\n")
    assert (run / "checkpoints" / "last" / "expert.safetensors").is_file()


def test_a_penalty_needs_no_anchor(tmp_path: Path, tiny_folder: Path, demos_file: Path) -> None:
    """Any penalty has a second backward pass, so its inner products are in the ledger."""
    package = package_copy.copied(tmp_path)
    (package / "methods" / "away.py").write_text(AWAY)
    package_copy.declare(package, "METHODS", "away")
    run = trained(package, "away", tiny_folder, demos_file)
    kept = artifacts.load(run / "ledger.safetensors", "ledger").tensors
    assert kept["step"].tolist() == [1, 2]
    assert bool((kept["aa"] > 0).any()) and bool((kept["w2"] > 0).all())


@pytest.mark.parametrize("described", [Method, Parts, MethodContext, Pass])
def test_the_page_names_every_field(described: type) -> None:
    """A method's author finds everything that it may use on one page."""
    fields = [field.name for field in dataclasses.fields(described)]
    assert fields
    assert [name for name in fields if not re.search(rf"`{name}[`=]", PAGE)] == []


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder whose files count as methods."""
    monkeypatch.setattr(methods, "__path__", [*methods.__path__, str(tmp_path)])
    return tmp_path


def test_a_name_without_its_file_is_an_error() -> None:
    with pytest.raises(ModuleNotFoundError, match="no_such_method"):
        methods.find(["no-such-method"])


def test_a_file_with_another_methods_name_is_an_error(folder: Path) -> None:
    (folder / "misnamed_method.py").write_text(HALF)
    with pytest.raises(ValueError, match="calls itself 'half-gradient'"):
        methods.find(["misnamed-method"])


def test_needs_that_recipes_do_not_know_are_an_error(folder: Path) -> None:
    needy = HALF.replace("half-gradient", "needy").replace(
        "start=start", 'start=start, needs=frozenset({"fisher"})'
    )
    (folder / "needy.py").write_text(needy)
    with pytest.raises(ValueError, match="'needy' reads .*fisher"):
        methods.find(["needy"])


def test_every_file_of_a_method_is_known() -> None:
    """The recipes list all of them."""
    files = Path(methods.__file__).parent.glob("*.py")
    found = {path.stem for path in files if "\nMETHOD = " in path.read_text(encoding="utf-8")}
    assert found == {name.replace("-", "_") for name in recipes.METHODS}
