"""The tasks by name; a task's module, and MuJoCo with it, is imported when the task is made."""

from __future__ import annotations

import difflib
from importlib import import_module

from aegis_cli.errors import AegisError
from aegis_cli.tasks.contract import TaskEnv

# name -> class; every class follows `contract.TaskEnv`
TASKS: dict[str, str] = {
    "reach": "aegis_cli.tasks.reach:Reach",
    "point": "aegis_cli.tasks.point:Point",
}


def check(name: str) -> None:
    """Raise AegisError unless `name` is a task; needs no MuJoCo."""
    if name in TASKS:
        return
    close = difflib.get_close_matches(name, TASKS, n=1) or list(TASKS)[:1]
    raise AegisError(f"task '{name}'", f"one of: {', '.join(TASKS)}", f"use '{close[0]}'")


def make(name: str) -> TaskEnv:
    """A new environment; all environments of a task share one compiled model and one rendering context."""
    check(name)
    module, cls = TASKS[name].split(":")
    return getattr(import_module(module), cls)()
