"""The learners of streams by name: each is the file of that name in this folder.

A new learner needs a file with `LEARNER = Learner(...)`, its name in `recipes.LEARNERS` (in the
order of tables), and a section of options if it has any. The recipes list the names themselves
because they are read without torch.
"""

from collections.abc import Iterable
from importlib import import_module

from aegis_cli import recipes
from aegis_cli.common.errors import AegisError
from aegis_cli.continual.learners.base import Learner


def find(names: Iterable[str]) -> dict[str, Learner]:
    """The learners of these names from their files.

    Raises:
        ModuleNotFoundError: there is no file of that name.
        ValueError: a file's learner has another name.
    """
    return {name: _load(name) for name in names}


def get(name: str) -> Learner:
    """The learner of that name.

    Raises:
        AegisError: there is no such learner.
    """
    if name not in LEARNERS:
        raise AegisError(
            f"learner '{name}'", f"one of {', '.join(LEARNERS)}", "choose with --method"
        )
    return LEARNERS[name]


def _load(name: str) -> Learner:
    file = name.replace("-", "_")  # a module's name has no hyphen
    module = import_module(f"{__name__}.{file}")
    learner: Learner = module.LEARNER
    if learner.name != name:
        raise ValueError(f"{module.__name__} calls itself '{learner.name}', recipes '{name}'")
    return learner


LEARNERS = find(recipes.LEARNERS)
