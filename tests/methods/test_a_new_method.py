"""What a new method takes: its file and its name, and nothing else in the package."""

from __future__ import annotations

from pathlib import Path

import pytest
from samples import package_copy

from aegis_cli import methods, recipes

HALF = '''
"""Plain fine-tuning with half the gradient in the backbone."""

from aegis_cli.methods.base import Method, Parts, Setting, train_all


def start(setting: Setting) -> Parts:
    learning = setting.learning().values()

    def halve() -> None:
        for parameter in learning:
            if parameter.grad is not None:
                parameter.grad.mul_(0.5)

    return Parts(pull=halve)


METHOD = Method("half-gradient", "half the gradient", train_all, start=start)
'''
RECIPE = """
name: new
backbone: {backbone}
expert: {{width: 16}}
train: {{method: half-gradient, steps: 2, batch_size: 2, warmup: 0}}
"""


def test_a_file_and_a_name_train(tmp_path: Path, tiny_folder: Path, demos_file: Path) -> None:
    package = package_copy.copied(tmp_path)
    (package / "methods" / "half_gradient.py").write_text(HALF)
    package_copy.declare(package, "METHODS", "half-gradient")
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(RECIPE.format(backbone=tiny_folder))
    command = ["-m", "aegis_cli", "train", recipe, "--demos", demos_file, "--out", tmp_path / "run"]
    done = package_copy.run(package, *command)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "half-gradient" in done.stdout
    assert (tmp_path / "run" / "checkpoints" / "last" / "expert.safetensors").is_file()


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
    """None is forgotten in recipes."""
    files = Path(methods.__file__).parent.glob("*.py")
    found = {path.stem for path in files if "\nMETHOD = " in path.read_text(encoding="utf-8")}
    assert found == {name.replace("-", "_") for name in recipes.METHODS}
