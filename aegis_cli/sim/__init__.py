"""The tasks by name. A task's module, and MuJoCo with it, is imported when the task is made."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Sequence
from importlib import import_module

from aegis_cli.common.errors import AegisError
from aegis_cli.sim import metaworld_table
from aegis_cli.sim.contract import METAWORLD, SUITE, TOP, TaskEnv

# The class of each task by its name; every class follows `contract.TaskEnv`.
TASKS: dict[str, str] = {
    "reach": "aegis_cli.sim.reach:Reach",
    "point": "aegis_cli.sim.point:Point",
}


def is_suite(name: str) -> bool:
    """Whether the name is that of a suite task, which is measured by its return."""
    return name.startswith(SUITE)


def has_colors(name: str) -> bool:
    """Whether the task has coloured targets, as our own have."""
    return name in TASKS


def members(name: str) -> tuple[str, ...]:
    """The tasks of a set; of a task itself alone."""
    return metaworld_table.members(name) if name.startswith(METAWORLD) else (name,)


def member(name: str, number: int) -> str:
    """The task of the episode of that number: a set's tasks take turns."""
    tasks = members(name)
    return tasks[number % len(tasks)]


def cameras(name: str) -> tuple[str, ...]:
    """The cameras that a task can be seen by; the first takes the pictures if none is asked for."""
    return metaworld_table.CAMERAS if name.startswith(METAWORLD) else (TOP,)


def playable(task: str | None, seen_by: Collection[str]) -> str | None:
    """The task, if a policy of these cameras can act in it; None if none of ours shows as much."""
    # A single picture needs no name: the task's own camera takes its place.
    if task is None or len(seen_by) == 1 or {*seen_by} <= {*cameras(task)}:
        return task
    return None


def check(name: str) -> None:
    """Raise AegisError unless `name` is a task that can be made; needs no MuJoCo for our own."""
    if name in TASKS:
        return
    if name in metaworld_table.names():
        import_module("aegis_cli.sim.metaworld")  # raises where MetaWorld is not installed
        return
    suite = import_module("aegis_cli.sim.suite").names()
    if name in suite:
        return
    known = (*TASKS, *metaworld_table.names(), *suite)
    expected = (
        f"one of {', '.join(TASKS)}, a task of dm_control's suite, such as "
        "suite/cartpole-swingup, or of MetaWorld, such as metaworld/button-press"
    )
    # The name of a whole collection is no typing error for one of its tasks.
    examples = {SUITE: "suite/cartpole-swingup", METAWORLD: "metaworld/button-press"}
    example = examples.get(name.rstrip("/") + "/")
    if example is not None:
        raise AegisError(f"task '{name}'", expected, f"name the task too, e.g. {example}")
    raise AegisError(f"task '{name}'", expected, f"use {_close(name, known)}")


def _close(name: str, known: tuple[str, ...]) -> str:
    """Names that are meant, perhaps: `'reach'`, or several with commas."""
    for guess in (name, SUITE + name, METAWORLD + name):  # a prefix may have been forgotten
        close = difflib.get_close_matches(guess, known, n=3)
        if close:
            break
    return ", or ".join(f"'{other}'" for other in close or TASKS)


def check_cameras(name: str, seen_by: Sequence[str]) -> None:
    """Raise AegisError for a camera that a task does not have, or one twice."""
    known = cameras(name)
    unknown = [camera for camera in seen_by if camera not in known]
    if unknown or len(set(seen_by)) < len(seen_by):
        raise AegisError(
            f"{', '.join(unknown or seen_by)} as cameras of '{name}'",
            f"some of: {', '.join(known)}, each once",
            f"e.g. {known[-1]}",
        )


def make(name: str, threads: int = 1, number: int = 0, seen_by: tuple[str, ...] = ()) -> TaskEnv:
    """A new environment; all environments of a task share one rendering context.

    Args:
        threads: how many a suite task's planner simulates with.
        number: the episode's that it is for. The environments of a set differ by it.
        seen_by: cameras that take pictures, in their order; empty for the task's own.

    Raises:
        AegisError: an unknown name, a task whose package is missing, or a camera it does not have.
    """
    check(name)
    check_cameras(name, seen_by)
    if is_suite(name):
        return import_module("aegis_cli.sim.suite").SuiteTask(name, threads)
    if name.startswith(METAWORLD):
        return import_module("aegis_cli.sim.metaworld").MetaWorldTask(name, number, seen_by)
    module, cls = TASKS[name].split(":")
    return getattr(import_module(module), cls)()
