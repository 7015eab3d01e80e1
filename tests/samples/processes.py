"""Processes of a test that find torch, and what trains, imported."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from typing import Any

from torch.multiprocessing import start_processes

# Each of them would take four seconds to import this. The process that they are forked from does
# so once; it has neither threads nor a graphics context.
IMPORTED = (
    "pytest",
    "torch._dynamo",
    "torch.distributed.fsdp",
    "transformers",
    "aegis_cli.cli.app",
    "aegis_cli.studies.pipeline",
)


def start(function: Callable[..., object], args: tuple[Any, ...], count: int) -> None:
    """Let `count` processes call a function with their number and `args`; wait for their end.

    Raises:
        ProcessExitedException, ProcessRaisedException: one of them has failed; the others are
            ended.
    """
    multiprocessing.set_forkserver_preload(list(IMPORTED))
    start_processes(function, args, nprocs=count, start_method="forkserver")
