"""Processes of a test that find torch and the training code already imported; worker processes."""

from __future__ import annotations

import contextlib
import gc
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import forkserver
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, TypeVar

import pytest
from torch.multiprocessing import start_processes

from aegis_cli.common import processes

# Each process would take four seconds to import these. The process from which they are forked
# imports them once; it has neither threads nor a graphics context.
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
    """What a function returns in a process of its own, in which it may change torch as it likes.

    Raises:
        Exception: what the function raises.
    """
    with ProcessPoolExecutor(1, _server()) as process:
        return process.submit(_begun, function, *args).result()


@contextlib.contextmanager
def aegis(args: Sequence[str], cwd: Path, said: Path) -> Iterator[BaseProcess]:
    """`aegis ARGS`, started in a folder as if by a terminal, in its own group; ended at the end.

    Args:
        said: file for its stdout and stderr, which is created.
    """
    said.touch()
    given = (_command, list(args), str(cwd), str(said))
    process = _server().Process(target=_begun, args=given)  # type: ignore[attr-defined]
    process.start()
    try:
        yield process
    finally:
        process.kill()
        process.join()


def _command(args: Sequence[str], cwd: str, said: str) -> None:
    from aegis_cli.cli.app import main

    os.setsid()
    # A shell's background job or nohup ignores this signal, and so would this process.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    written = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(written, sys.stdout.fileno())
    os.dup2(written, sys.stderr.fileno())
    os.chdir(cwd)
    sys.argv = ["aegis", *args]
    main()


def _server() -> multiprocessing.context.BaseContext:
    """The context whose processes are forked from one that has everything imported."""
    multiprocessing.set_forkserver_preload(list(IMPORTED))
    # Started here. Begun by a pool of workers, it would inherit the signals that are blocked there,
    # and so would every process that a later test sends one to.
    forkserver.ensure_running()
    return multiprocessing.get_context("forkserver")


def start(function: Callable[..., object], args: tuple[Any, ...], count: int) -> None:
    """Let `count` processes call a function with their number and `args`; wait until they end.

    Raises:
        ProcessExitedException, ProcessRaisedException: one of them has failed; the others are
            stopped.
    """
    _server()
    start_processes(partial(_begun, function), args, nprocs=count, start_method="forkserver")


def _begun(function: Callable[..., Found], *args: Any) -> Found:
    """Call the function; garbage collection skips the objects from before it."""
    gc.freeze()
    return function(*args)


@pytest.fixture
def quick_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Worker processes that start at once, for tests that only look at what they find."""
    from aegis_cli.studies import cells  # which the fast tests do not need

    for module in (processes, cells):
        monkeypatch.setattr(module, "SPAWN", _server())
