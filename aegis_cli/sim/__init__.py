"""The tasks by name. A task's module, and with it MuJoCo, is imported when the task is created."""

from __future__ import annotations

import difflib
import multiprocessing
from collections.abc import Collection, Sequence
from importlib import import_module

from aegis_cli.common import processes
from aegis_cli.common.errors import AegisError
from aegis_cli.sim import libero_table, metaworld_table
from aegis_cli.sim.contract import LIBERO, METAWORLD, SUITE, TOP, TaskEnv, TaskSpec

# The class of each task by name; every class implements `contract.TaskEnv`.
TASKS: dict[str, str] = {
    "reach": "aegis_cli.sim.reach:Reach",
    "point": "aegis_cli.sim.point:Point",
}


def is_suite(name: str) -> bool:
    """Whether the name is that of a dm_control suite task, which is measured by its return."""
    return name.startswith(SUITE)


def has_colors(name: str) -> bool:
    """Whether the task has coloured targets, as our own tasks do."""
    return name in TASKS


def of_datasets(name: str) -> TaskSpec | None:
    """The facts of a task that is learned only from data sets; None for one that has an expert.

    LIBERO's demonstrations were made by people, and its data sets do not name LIBERO, so a recipe
    has to.

    Raises:
        AegisError: LIBERO has no such task.
    """
    if not name.startswith(LIBERO):
        return None
    if name not in libero_table.names():
        raise _unknown(name, libero_table.names())
    return libero_table.spec(name)


def lockstep(name: str) -> int:
    """How many of the task's episodes are played at once; a LIBERO simulator is large."""
    return 10 if name.startswith(LIBERO) else 64


def workers(name: str, episodes: int) -> int:
    """How many processes simulate the task's episodes at once; 1: only the calling process.

    A LIBERO step takes tens of milliseconds of Python; for other tasks a process does not pay off.
    A process of a study simulates alone, because the others use the other cores.
    """
    if not name.startswith(LIBERO) or multiprocessing.parent_process() is not None:
        return 1
    return processes.worker_count(min(episodes, lockstep(name)))


def members(name: str) -> tuple[str, ...]:
    """The tasks of a set; for a single task, only itself."""
    if name.startswith(METAWORLD):
        return metaworld_table.members(name)
    return libero_table.members(name) if name.startswith(LIBERO) else (name,)


def suites(name: str) -> tuple[str, ...]:
    """The suites in a set of several, such as LIBERO's four; empty for anything else."""
    return libero_table.suites(name) if name.startswith(LIBERO) else ()


def member(name: str, number: int) -> str:
    """The task of the episode with that number: the tasks of a set take turns."""
    tasks = members(name)
    return tasks[number % len(tasks)]


def cameras(name: str) -> tuple[str, ...]:
    """The cameras of a task; the first is the default."""
    if name.startswith(METAWORLD):
        return metaworld_table.CAMERAS
    return tuple(libero_table.CAMERAS) if name.startswith(LIBERO) else (TOP,)


def camera(task: str | None, before: str, now: str) -> str:
    """A task's name for a policy's camera: the name before renaming, if the task has it."""
    return before if task is not None and before in cameras(task) else now


def playable(task: str | None, seen_by: Collection[str]) -> str | None:
    """The task, if it has the cameras that the policy needs; otherwise None."""
    # A single picture needs no name: the task's own camera stands in for it.
    if task is None or len(seen_by) == 1 or {*seen_by} <= {*cameras(task)}:
        return task
    return None


def check(name: str) -> None:
    """Raise AegisError unless `name` is a task that can be created; our own need no MuJoCo here."""
    if name in TASKS:
        return
    if name in metaworld_table.names():
        import_module("aegis_cli.sim.metaworld")  # raises if MetaWorld is not installed
        return
    if name in libero_table.names():
        import_module("aegis_cli.sim.libero")  # raises if LIBERO is not installed
        return
    suite = import_module("aegis_cli.sim.suite").names()
    if name in suite:
        return
    raise _unknown(name, (*TASKS, *metaworld_table.names(), *libero_table.names(), *suite))


def check_recordable(name: str) -> None:
    """Raise AegisError unless `name` is a task that can be created, with an expert to record."""
    if of_datasets(name) is not None:
        raise AegisError(
            f"task '{name}' to be recorded",
            "a task with an expert: LIBERO's demonstrations were recorded by people",
            "take a LeRobot dataset of them, such as HuggingFaceVLA/libero: aegis train --demos, "
            "demos.path in the recipe, or demos.paths of a stream",
        )
    check(name)


def _unknown(name: str, known: tuple[str, ...]) -> AegisError:
    # The name of a whole collection is not a misspelling of one of its tasks.
    examples = {
        SUITE: "suite/cartpole-swingup",
        METAWORLD: "metaworld/button-press",
        LIBERO: "libero/spatial",
    }
    expected = (
        f"one of {', '.join(TASKS)}, a task of dm_control's suite, such as {examples[SUITE]}, of "
        f"MetaWorld, such as {examples[METAWORLD]}, or of LIBERO, such as {examples[LIBERO]}"
    )
    example = examples.get(name.rstrip("/") + "/")
    if example is not None:
        return AegisError(f"task '{name}'", expected, f"name the task too, e.g. {example}")
    return AegisError(f"task '{name}'", expected, f"use {_close(name, known)}")


def _close(name: str, known: tuple[str, ...]) -> str:
    """Names that may be meant: `'reach'`, or several separated by commas."""
    # A prefix may be missing, and LIBERO calls a suite libero_spatial.
    for guess in (name, SUITE + name, METAWORLD + name, LIBERO + name, name.replace("_", "/")):
        close = difflib.get_close_matches(guess, known, n=3)
        if close:
            break
    return ", or ".join(f"'{other}'" for other in close or TASKS)


def check_cameras(name: str, seen_by: Sequence[str]) -> None:
    """Raise AegisError for a camera that a task does not have, or one listed twice."""
    known = cameras(name)
    unknown = [camera for camera in seen_by if camera not in known]
    if unknown or len(set(seen_by)) < len(seen_by):
        raise AegisError(
            f"{', '.join(unknown or seen_by)} as cameras of '{name}'",
            f"some of: {', '.join(known)}, each once",
            f"e.g. {known[-1]}",
        )


def make(
    name: str,
    threads: int = 1,
    number: int = 0,
    seen_by: tuple[str, ...] = (),
    published: bool = False,
) -> TaskEnv:
    """A new environment; except for LIBERO, those of a task share one rendering context.

    Args:
        threads: number of threads with which the planner of a suite task simulates.
        number: number of the episode that it is for; the environments of a set depend on it.
        seen_by: cameras that take pictures, in this order; empty for the task's own.
        published: whether to use the initial states that a benchmark has published, if there are
            any; otherwise each episode is drawn anew.

    Raises:
        AegisError: the name is unknown, the task's package is missing, or it lacks a camera.
    """
    check(name)
    check_cameras(name, seen_by)
    if is_suite(name):
        return import_module("aegis_cli.sim.suite").SuiteTask(name, threads)
    if name.startswith(METAWORLD):
        return import_module("aegis_cli.sim.metaworld").MetaWorldTask(name, number, seen_by)
    if name.startswith(LIBERO):
        return import_module("aegis_cli.sim.libero").LiberoTask(name, number, seen_by, published)
    module, cls = TASKS[name].split(":")
    return getattr(import_module(module), cls)()
