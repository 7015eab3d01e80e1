"""Worker processes: a pool for all who need several, their share of the cores, and their end.

Every worker is spawned. A forked one would inherit this process's OpenGL context and torch threads,
and hang or crash when it first uses them.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import connection, resource_tracker
from types import TracebackType
from typing import Any, TypeVar

from aegis_cli.common.errors import AegisError
from aegis_cli.common.interrupts import deferred, stop

Item = TypeVar("Item")
Result = TypeVar("Result")

# How a worker starts. Objects shared with workers, such as a queue, are created by it too.
SPAWN = multiprocessing.get_context("spawn")

# Chunks per worker that are being computed or wait for their results to be taken. Without a limit
# they would pile up in memory.
_AHEAD = 2

_GRACE_S = 10  # how long a worker whose parent is gone may clean up
_ENDED = 128 + signal.SIGTERM  # its exit code


class WorkerPool:
    """Spawned processes that work for the length of a `with` block, and never outlive it.

    If the block ends with an exception, processes that are still working are stopped, and clean up;
    otherwise the block waits for them. They end by themselves if this process dies.

    Args:
        workers: number of processes.
        name: name of one process, such as "a recording process", for the error if one dies.
        fix: what the user can do about it.
        begin: called once in each process before any work, with `arguments`.

    Raises:
        AegisError: at the end of the block, if a process died in it.
    """

    def __init__(
        self,
        workers: int,
        name: str,
        fix: str,
        begin: Callable[..., None] | None = None,
        arguments: tuple[Any, ...] = (),
    ) -> None:
        self.workers = workers
        self._name = name
        self._fix = fix
        self._older: set[Any] = set()
        self._executor = ProcessPoolExecutor(workers, SPAWN, _begin, (begin, *arguments))

    def __enter__(self) -> WorkerPool:
        self._older = set(multiprocessing.active_children())
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is not None:
            self._stop()
        self._executor.shutdown(cancel_futures=True)
        if isinstance(error, BrokenProcessPool):
            raise self._died() from None

    def submit(self, work: Callable[..., Result], *arguments: Any) -> Future[Result]:
        """Let a process call `work`, a function that it can import by name."""
        with interrupts_held():  # the call may start a process
            return self._executor.submit(_work, work, *arguments)

    def map(
        self, work: Callable[[Item], Result], items: Sequence[Item], chunk: int = 1
    ) -> Iterator[Result]:
        """Results in the order of the items, which are handed out as the results are taken.

        Args:
            chunk: number of items that a process takes at a time.
        """
        waiting: deque[Future[list[Result]]] = deque()  # in the order of the items
        for start in range(0, len(items), chunk):
            waiting.append(self.submit(_each, work, items[start : start + chunk]))
            if len(waiting) == _AHEAD * self.workers:
                yield from waiting.popleft().result()
        while waiting:
            yield from waiting.popleft().result()

    def _died(self) -> AegisError:
        if script := _unguarded_script():
            return AegisError(
                f"{self._name} died at its start: it imports '{script}', which calls Aegis again",
                "a script that calls nothing when it is imported",
                "put what it calls below: if __name__ == '__main__':",
            )
        plural = "running process" if self.workers == 1 else "running processes"
        return AegisError(f"{self._name} died", f"{self.workers} {plural}", self._fix)

    def _stop(self) -> None:
        """Stop the workers, and make the executor's thread notice it."""
        # Not those of another pool, unless they started after this one was opened.
        own = set(multiprocessing.active_children()) - self._older
        for process in own:
            process.terminate()
        deadline = time.monotonic() + _GRACE_S  # for all of them together
        for process in own:
            process.join(max(0.0, deadline - time.monotonic()))
            process.kill()
        # A worker may have died while writing a result. The executor's thread waits for the rest as
        # long as some process could still write it, and this process could.
        self._executor._result_queue._writer.close()  # pyrefly: ignore[missing-attribute]: private


def _unguarded_script() -> str | None:
    """The program's file, if a worker that imports it would run all of it."""
    file = getattr(sys.modules["__main__"], "__file__", None)
    if file is None or not os.path.isfile(file):
        return None
    with open(file, "rb") as script:
        return None if b"__main__" in script.read() else file


def _begin(begin: Callable[..., None] | None, *arguments: Any) -> None:
    """Start a worker."""
    threading.Thread(target=_watch_parent, daemon=True).start()
    if begin is not None:
        begin(*arguments)


def _watch_parent() -> None:
    """End this worker when its parent dies, however that happens: a pipe between them breaks."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    connection.wait([parent.sentinel])
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(_GRACE_S)
    os._exit(_ENDED)


def _work(work: Callable[..., Result], *arguments: Any) -> Result:
    """Do the work. At SIGTERM the worker ends, once the work's `finally` blocks have run."""
    idle = signal.signal(signal.SIGTERM, stop)
    try:
        return work(*arguments)
    except KeyboardInterrupt:
        # At once: the pool's own loop would send the exception as a result and continue.
        os._exit(_ENDED)
    finally:
        signal.signal(signal.SIGTERM, idle)


def _each(work: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    return [work(item) for item in items]


@contextmanager
def mapped(
    work: Callable[[Item], Result],
    items: Sequence[Item],
    workers: int,
    name: str,
    fix: str,
    chunk: int = 1,
) -> Generator[Iterator[Result]]:
    """Yield `map(work, items)`, from a pool if there is more than one worker.

    The results need not be consumed completely. For the arguments see `WorkerPool` and
    `WorkerPool.map`.
    """
    if workers == 1:
        yield map(work, items)
        return
    with WorkerPool(workers, name, fix) as pool:
        yield pool.map(work, items, chunk)


# --- cores ----------------------------------------------------------------------------------------


def worker_count(most: int) -> int:
    """Number of workers: one per core, at most `most`, at least one."""
    return max(1, min(_cores(), most))


def threads_per_worker(workers: int) -> int:
    """Number of threads per worker, so that together they fill the cores."""
    return max(1, _cores() // workers)


def _cores() -> int:
    return os.cpu_count() or 1


# --- Ctrl-C ---------------------------------------------------------------------------------------


@contextmanager
def interrupts_held() -> Generator[None]:
    """Hold signals back; processes started inside never receive those from a terminal.

    A terminal sends Ctrl-C, and SIGHUP when it closes, to each of its processes. Workers leave them
    to the process that started them, which handles a signal that came meanwhile when the block
    ends.

    The mask is for the children, which inherit it. It does not protect this process: the signal may
    reach another thread, of a library, and Python then interrupts the main thread anyway. So the
    handlers are deferred too.
    """
    # Starting the tracker unblocks SIGINT, so it has to run before the mask is set.
    resource_tracker.ensure_running()
    with deferred():
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
        try:
            yield
        finally:
            # A signal that is pending now reaches the deferred handler, and is raised once.
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
