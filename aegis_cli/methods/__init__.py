"""The methods by name. Each is the file of that name in this folder, if recipes list it.

A new method is a file with `METHOD = Method(...)`, its name in `recipes.METHODS` (in the order that
tables use), the parts of an anchor that it reads in `recipes.NEEDS`, and a section of options if it
has any. Recipes are read without torch, so they repeat names and needs.
"""

from collections.abc import Iterable
from importlib import import_module

from aegis_cli import recipes
from aegis_cli.common.errors import AegisError
from aegis_cli.methods.base import Method


def find(names: Iterable[str]) -> dict[str, Method]:
    """The methods with these names, from their files.

    Raises:
        ModuleNotFoundError: no file of that name.
        ValueError: a file disagrees with the recipes about its name or its needs.
    """
    return {name: _load(name) for name in names}


def get(name: str) -> Method:
    """The method with this name.

    Raises:
        AegisError: there is none.
    """
    if name not in METHODS:
        raise AegisError(f"method '{name}'", f"one of {', '.join(METHODS)}", "choose one of these")
    return METHODS[name]


def _load(name: str) -> Method:
    file = name.replace("-", "_")  # a module's name has no hyphen
    module = import_module(f"{__name__}.{file}")
    method: Method = module.METHOD
    if method.name != name:
        raise ValueError(f"{module.__name__} calls itself '{method.name}', recipes '{name}'")
    said = recipes.NEEDS.get(name, ())
    if method.needs != set(said):
        raise ValueError(f"'{name}' reads {set(method.needs)} of anchors, recipes say {said}")
    return method


METHODS = find(recipes.METHODS)
