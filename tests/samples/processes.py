"""Processes of a test that find torch, and what trains, imported; and worker processes that do."""

from __future__ import annotations

import gc
import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import Any, TypeVar

import pytest
from torch.multiprocessing import start_processes

from aegis_cli.common import processes

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

Found = TypeVar("Found")


def alone(function: Callable[..., Found], *args: Any) -> Found:
    """What a function returns in a process of its own, which may do to torch what it likes.

    Raises:
        Exception: what the function raises.
    """
    multiprocessing.set_forkserver_preload(list(IMPORTED))
    context = multiprocessing.get_context("forkserver")
    with ProcessPoolExecutor(1, context) as process:
        return process.submit(_begun, function, *args).result()


def start(function: Callable[..., object], args: tuple[Any, ...], count: int) -> None:
    """Let `count` processes call a function with their number and `args`; wait for their end.

    Raises:
        ProcessExitedException, ProcessRaisedException: one of them has failed; the others are
            ended.
    """
    multiprocessing.set_forkserver_preload(list(IMPORTED))
    start_processes(partial(_begun, function), args, nprocs=count, start_method="forkserver")


def _begun(function: Callable[..., Found], *args: Any) -> Found:
    """Call the function; no collection of garbage looks through what was there before it."""
    gc.freeze()
    return function(*args)


@pytest.fixture
def quick_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Worker processes that start at once, where a test looks at what they find alone."""
    from aegis_cli.studies import cells  # which the fast tests have no need of

    multiprocessing.set_forkserver_preload(list(IMPORTED))
    for module in (processes, cells):
        monkeypatch.setattr(module, "SPAWN", multiprocessing.get_context("forkserver"))
