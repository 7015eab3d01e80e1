"""The command in a forked child: it finds every module imported, so that a case takes little time.

A child has its own process group, address space and time limit.
"""

from __future__ import annotations

import atexit
import io
import os
import resource
import select
import signal
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

# The memory of a case beyond what is mapped at its start; a defect that needs more is found. With
# a smaller limit, threads that share torch's libraries have no room for their own heaps.
MORE_MEMORY = 4 << 30
TIMEOUT_S = 60.0
_WAIT_FOR_ORPHANS_S = 10.0


@dataclass(frozen=True)
class Ended:
    """How a child ended.

    Attributes:
        code: its exit code; if a signal ended it, minus the signal's number.
        hung: whether it was killed for taking too long.
        orphans: whether processes of its group outlived it.
    """

    code: int
    out: str
    err: str
    hung: bool
    orphans: bool


class Child:
    """A running command."""

    def __init__(self, pid: int, outputs: tuple[int, int]) -> None:
        self.pid = pid
        self._outputs = outputs
        self._handle = os.pidfd_open(pid)

    def has_ended(self, within_s: float = 0.0) -> bool:
        """Whether it ends within this time."""
        return bool(select.select([self._handle], [], [], within_s)[0])

    def kill(self, number: int, group: bool = False) -> None:
        """Send a signal to the command alone, or to its group as a terminal does."""
        try:
            (os.killpg if group else os.kill)(self.pid, number)
        except ProcessLookupError:  # it has no group yet
            os.kill(self.pid, number)

    def wait(self, timeout_s: float = TIMEOUT_S) -> Ended:
        """Wait for its end, at most `timeout_s`."""
        if hung := not self.has_ended(timeout_s):
            self.kill(signal.SIGKILL, group=True)
        _, status = os.waitpid(self.pid, 0)
        os.close(self._handle)
        orphans = _outlived(self.pid)
        out, err = (_read_and_close(number) for number in self._outputs)
        return Ended(os.waitstatus_to_exitcode(status), out, err, hung, orphans)


def start(
    args: Sequence[object],
    cwd: Path,
    limits: Callable[[], None] | None = None,
    stdout: int | None = None,
) -> Child:
    """Start `aegis ARGS` in a folder.

    Args:
        limits: called in the child before anything else; default: a limit to its memory.
        stdout: a descriptor to write to; None: its output is kept. -1: there is none.
    """
    return _fork(lambda: _command(args), cwd, limits or limit_memory, stdout)


def run(args: Sequence[object], cwd: Path, timeout_s: float = TIMEOUT_S) -> Ended:
    """Run `aegis ARGS` in a folder to its end."""
    return start(args, cwd).wait(timeout_s)


def call(function: Callable[[], object], cwd: Path) -> None:
    """Call a function in a child, for the files that it leaves.

    Raises:
        RuntimeError: it fails.
    """
    ended = _fork(function, cwd, lambda: None, None).wait(600.0)
    if ended.code:
        raise RuntimeError(ended.err or ended.out)


def limit_memory(more: int = MORE_MEMORY) -> None:
    """Limit this process's address space to `more` bytes beyond what it has."""
    pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[0])
    most = pages * resource.getpagesize() + more
    resource.setrlimit(resource.RLIMIT_AS, (most, most))


def _command(args: Sequence[object]) -> None:
    from aegis_cli.cli.app import main

    sys.argv = ["aegis", *map(str, args)]
    main()


def _fork(
    work: Callable[[], object], cwd: Path, limits: Callable[[], None], stdout: int | None
) -> Child:
    outputs = os.memfd_create("stdout"), os.memfd_create("stderr")
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid == 0:
        _be_child(work, cwd, limits, (outputs[0] if stdout is None else stdout, outputs[1]))
    return Child(pid, outputs)


def _be_child(
    work: Callable[[], object], cwd: Path, limits: Callable[[], None], streams: tuple[int, int]
) -> NoReturn:
    """Do the work as a fresh process would, and exit without the parent's exit handlers."""
    code = 1
    try:
        os.setsid()
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            usual = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
            signal.signal(number, usual)
        _redirect(*streams)
        os.chdir(cwd)
        atexit._clear()
        limits()
        work()
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        atexit._run_exitfuncs()
        for stream in (sys.stdout, sys.stderr):
            try:
                if stream is not None:
                    stream.flush()
            except (OSError, ValueError):  # the reader is gone, or it was closed
                pass
        os._exit(code)


def _redirect(stdout: int, stderr: int) -> None:
    """Streams as Python opens them at its start; -1 is a closed one."""
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    for number, source, name in ((1, stdout, "stdout"), (2, stderr, "stderr")):
        if source == -1:
            os.close(number)
            setattr(sys, name, None)
            continue
        os.dup2(source, number)
        raw = open(number, "wb", closefd=False)  # noqa: SIM115 (as long as the process)
        setattr(sys, name, io.TextIOWrapper(raw, "utf-8", line_buffering=True))
    sys.__stdout__, sys.__stderr__ = sys.stdout, sys.stderr


def _outlived(group: int) -> bool:
    """Whether processes of a group still exist after their grace period; kills them."""
    given_up = time.monotonic() + _WAIT_FOR_ORPHANS_S
    while time.monotonic() < given_up:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return False
        time.sleep(0.02)
    os.killpg(group, signal.SIGKILL)
    return True


def _read_and_close(number: int) -> str:
    with open(number, "rb") as file:
        file.seek(0)
        return file.read().decode("utf-8", "replace")
