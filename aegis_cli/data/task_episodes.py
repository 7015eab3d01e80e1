"""Which episodes of a dataset belong to a LIBERO task: those with its instructions."""

from __future__ import annotations

from collections.abc import Mapping

from aegis_cli import sim
from aegis_cli.common.errors import AegisError
from aegis_cli.data.lerobot.dataset import Dataset
from aegis_cli.sim import libero_table


def is_task(only: str, splits: Mapping[str, str]) -> bool:
    """Whether `demos.only` names a LIBERO task; a split of that name takes precedence.

    Raises:
        AegisError: LIBERO does not have the task.
    """
    return only not in splits and sim.of_datasets(only) is not None


def of_task(found: Dataset, task: str) -> list[int]:
    """The numbers of a task's episodes, or of a suite's, in ascending order.

    Raises:
        AegisError: there are none, or its instructions may belong to another task's scene.
    """
    own = {*libero_table.members(task)}
    numbers = [n for n, tasks in enumerate(_tasks_of_each(found)) if tasks & own]
    if not numbers:
        raise AegisError(
            f"no episode of '{task}' in '{found.folder}', by the instructions of its meta folder",
            f"episodes with instructions of it, such as '{libero_table.instructions(task)[0]}'",
            "give demonstrations of that task, or choose episodes by their numbers (demos.only)",
        )
    _check_told_apart(found, task, own)
    return numbers


def is_choice(found: Dataset, task: str, shared: bool) -> bool:
    """Whether a task has to select its episodes, because the dataset holds others too.

    If no instruction is LIBERO's, all episodes belong to the task: they may have been reworded.

    Args:
        shared: whether other tasks are trained on the dataset as well.

    Raises:
        AegisError: it is shared, and no instruction shows which task an episode belongs to.
    """
    own = {*libero_table.members(task)}
    tasks_of_each = _tasks_of_each(found)
    if any(tasks_of_each):
        return not all(tasks & own for tasks in tasks_of_each)
    if shared:
        raise AegisError(
            f"'{found.folder}' for '{task}' and other tasks, which has none of their instructions",
            f"instructions such as '{libero_table.instructions(task)[0]}'",
            "choose the episodes of each task by their numbers: demos.only",
        )
    return False


def check_own(texts: list[str], task: str, where: str) -> None:
    """Raise AegisError for an instruction that belongs to another LIBERO task.

    Args:
        texts: the instructions of the selected data.
        where: its name in a sentence.
    """
    own = {*libero_table.members(task)}
    for text in texts:
        told = libero_table.told(text)
        if told and not own & {*told}:
            raise AegisError(
                f"'{text}' in {where} for '{task}'",
                f"instructions of that task; this one is {told[0]}'s",
                "correct demos.only, demos.paths or tasks",
            )


def _tasks_of_each(found: Dataset) -> list[set[str]]:
    """The tasks that each episode may belong to: those that have all its instructions."""
    return [
        set.intersection(*(set(libero_table.told(text)) for text in episode.tasks or ("",)))
        for episode in found.episodes
    ]


def _check_told_apart(found: Dataset, task: str, own: set[str]) -> None:
    """Raise AegisError if another task, whose suite is also present, shares an instruction.

    `turn on the stove` is used in one scene of libero/goal, and in two of libero/90.
    """
    texts = dict.fromkeys(text for episode in found.episodes for text in episode.tasks)
    suites_of_each = [{libero_table.place(t)[0] for t in libero_table.told(text)} for text in texts]
    there = set[str]().union(*(suites for suites in suites_of_each if len(suites) == 1))
    for text in texts:
        told = {*libero_table.told(text)}
        for other in sorted(told - own if told & own else ()):
            if libero_table.place(other)[0] in there:
                raise AegisError(
                    f"'{text}' in '{found.folder}', an instruction of both '{other}' and '{task}'",
                    "instructions that tell the two tasks apart",
                    "choose the episodes by their numbers: demos.only",
                )
