"""What a new learner of streams needs: its file and its name, and no other change."""

from __future__ import annotations

from pathlib import Path

import pytest
from samples import package_copy

from aegis_cli import recipes
from aegis_cli.continual import learners

IDLE = '''
"""Nothing learns."""

from aegis_cli.continual.learners.base import Learner

LEARNER = Learner("idle", "nothing learns", trains="nothing", shared=True)
'''
PROGRAM = """
from aegis_cli import recipes
from aegis_cli.continual import learners
assert learners.get("idle").summary == "nothing learns"
assert recipes.StreamTrain(method="idle").method == "idle"
"""


def test_a_file_and_a_name_are_enough(tmp_path: Path) -> None:
    package = package_copy.copied(tmp_path)
    (package / "continual" / "learners" / "idle.py").write_text(IDLE)
    package_copy.declare(package, "LEARNERS", "idle")
    done = package_copy.run(package, PROGRAM)
    assert done.returncode == 0, done.stderr
    shown = package_copy.run(package, "aegis_cli", "train", "--help")
    assert shown.returncode == 0 and "idle" in shown.stdout


def test_a_name_without_its_file_is_an_error() -> None:
    with pytest.raises(ModuleNotFoundError, match="no_such_learner"):
        learners.find(["no-such-learner"])


def test_a_file_with_another_learners_name_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learners, "__path__", [*learners.__path__, str(tmp_path)])
    (tmp_path / "misnamed_learner.py").write_text(IDLE)
    with pytest.raises(ValueError, match="calls itself 'idle'"):
        learners.find(["misnamed-learner"])


def test_every_file_of_a_learner_is_known() -> None:
    """The recipes list all of them."""
    files = Path(learners.__file__).parent.glob("*.py")
    found = {path.stem for path in files if "\nLEARNER = " in path.read_text(encoding="utf-8")}
    assert found == {name.replace("-", "_") for name in recipes.LEARNERS}
