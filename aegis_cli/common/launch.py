"""The environment variables by which a launcher such as torchrun describes this process.

Nothing is imported here, so that a command knows its rank before torch is loaded.
"""

from __future__ import annotations

import os

from aegis_cli.common.errors import AegisError

_MEETING = ("RANK", "MASTER_ADDR", "MASTER_PORT")  # needed for several processes to connect


def world_size() -> int:
    """How many processes were started together; 1 without a launcher."""
    return _number("WORLD_SIZE", 1)


def rank() -> int:
    """Number of this process among all, from 0."""
    return _number("RANK", 0)


def local_rank() -> int:
    """Number of this process among those on its machine, from 0."""
    return _number("LOCAL_RANK", 0)


def local_world_size() -> int:
    """How many of the processes are on this machine; by default all of them."""
    return _number("LOCAL_WORLD_SIZE", world_size())


def check_one() -> None:
    """Refuse to be one of several processes, because each would do all the work.

    Raises:
        AegisError: torchrun or another launcher has started several.
    """
    if world_size() > 1:
        raise AegisError(
            f"one of {world_size()} processes that a launcher such as torchrun started "
            "(WORLD_SIZE)",
            "one process: only anchor, train, probe and run (of a policy) share their work",
            "start it without torchrun, or unset WORLD_SIZE; a "
            "study measures several cells at a time with --workers N",
        )


def check_meeting() -> None:
    """Refuse an environment in which this process could not connect to the others.

    Raises:
        AegisError: a variable of the launcher is missing, or contradicts the others.
    """
    count = world_size()
    missing = [name for name in _MEETING if not os.environ.get(name)]
    if missing:
        found = f"WORLD_SIZE={count} in the environment, without {' and '.join(missing)}"
    elif not os.environ["RANK"].isdecimal() or rank() >= count:
        found = f"RANK={os.environ['RANK']} in the environment, of WORLD_SIZE={count} processes"
    else:
        return
    raise AegisError(
        found,
        "all the variables that a launcher sets for each process, or none of them",
        "start them with torchrun --nproc-per-node N -m aegis_cli ...; for one process alone: "
        "unset WORLD_SIZE",
    )


def _number(name: str, default: int) -> int:
    said = os.environ.get(name, "")
    return int(said) if said.isdecimal() else default
