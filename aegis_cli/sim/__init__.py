"""The tasks by name. A task's module, and MuJoCo with it, is imported when the task is made."""

from __future__ import annotations

import difflib
from importlib import import_module

from aegis_cli.common.errors import AegisError
from aegis_cli.sim.contract import SUITE, TaskEnv

# name -> class; every class follows `contract.TaskEnv`
TASKS: dict[str, str] = {
    "reach": "aegis_cli.sim.reach:Reach",
    "point": "aegis_cli.sim.point:Point",
}


def is_suite(name: str) -> bool:
    """Whether the name is that of a suite task.

    Such a task is measured by its return and has no target colours.
    """
    return name.startswith(SUITE)


def check(name: str) -> None:
    """Raise AegisError unless `name` is a task; needs no MuJoCo for our own."""
    if name in TASKS:
        return
    known = (*TASKS, *import_module("aegis_cli.sim.suite").names())
    if name in known:
        return
    expected = (
        f"one of {', '.join(TASKS)}, or a task of dm_control's suite, such as "
        "suite/cartpole-swingup"
    )
    if name.rstrip("/") == SUITE.rstrip("/"):
        raise AegisError(
            f"task '{name}'", expected, "name the task too, e.g. suite/cartpole-swingup"
        )
    close = difflib.get_close_matches(name, known, n=3)
    close = close or difflib.get_close_matches(SUITE + name, known, n=3) or list(TASKS)
    use = ", or ".join(f"'{other}'" for other in close)
    raise AegisError(f"task '{name}'", expected, f"use {use}")


def make(name: str, threads: int = 1) -> TaskEnv:
    """A new environment; all environments of a task share one rendering context.

    Args:
        threads: how many a suite task's planner simulates with.

    Raises:
        AegisError: an unknown name.
    """
    check(name)
    if is_suite(name):
        return import_module("aegis_cli.sim.suite").SuiteTask(name, threads)
    module, cls = TASKS[name].split(":")
    return getattr(import_module(module), cls)()
