"""Worker processes: one pool for all who need several, its share of the cores, and its end.

Every worker is spawned. A forked one would inherit this process's OpenGL context and torch's
threads, and hang or crash at their first use.
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

# How a worker starts. Whatever is shared with the workers, a queue for one, is made by it too.
SPAWN = multiprocessing.get_context("spawn")

# Chunks per worker that are computed, or wait for whoever takes the results. Without a limit they
# would pile up in memory.
_AHEAD = 2

_GRACE_S = 10  # how long a worker whose parent is gone may clean up
_ENDED = 128 + signal.SIGTERM  # its exit code


class WorkerPool:
    """Spawned processes that work for the length of a `with` block, and never outlive it.

    The processes that are still at work when the block ends with an exception are stopped, and
    clean up; a block that ends well waits for them. They end by themselves when this process dies.

    Args:
        workers: number of processes.
        name: what one of them is, for the error of a process that dies: "a recording process".
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
        """Have a process call `work`, a function that it can import by name."""
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
        """End the workers, and let the executor's thread notice it."""
        # Not those of another pool, unless it was opened with this one.
        own = set(multiprocessing.active_children()) - self._older
        for process in own:
            process.terminate()
        deadline = time.monotonic() + _GRACE_S  # for all of them together
        for process in own:
            process.join(max(0.0, deadline - time.monotonic()))
            process.kill()
        # A worker may have died while it wrote a result. The executor's thread waits for the rest
        # of it as long as somebody could write it, and this process could.
        self._executor._result_queue._writer.close()  # pyrefly: ignore[missing-attribute]: private


def _unguarded_script() -> str | None:
    """The program's file, if a worker that imports it would run all of it."""
    file = getattr(sys.modules["__main__"], "__file__", None)
    if file is None or not os.path.isfile(file):
        return None
    with open(file, "rb") as script:
        return None if b"__main__" in script.read() else file


def _begin(begin: Callable[..., None] | None, *arguments: Any) -> None:
    """What a worker does first."""
    threading.Thread(target=_watch_parent, daemon=True).start()
    if begin is not None:
        begin(*arguments)


def _watch_parent() -> None:
    """End this worker when its parent dies, by whatever signal: a pipe between them breaks."""
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
        # At once: the pool's own loop would send the exception as a result, and go on.
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
    """Give `map(work, items)`, from a pool if there is to be more than one worker.

    The results can be left early. For the arguments see `WorkerPool` and `WorkerPool.map`.
    """
    if workers == 1:
        yield map(work, items)
        return
    with WorkerPool(workers, name, fix) as pool:
        yield pool.map(work, items, chunk)


# --- cores ----------------------------------------------------------------------------------------


def worker_count(most: int) -> int:
    """Number of workers for work that repays at most so many: one per core, at least one."""
    return max(1, min(_cores(), most))


def threads_per_worker(workers: int) -> int:
    """Number of threads that each of the workers may use, so that together they fill the cores."""
    return max(1, _cores() // workers)


def _cores() -> int:
    return os.cpu_count() or 1


# --- Ctrl-C ---------------------------------------------------------------------------------------


@contextmanager
def interrupts_held() -> Generator[None]:
    """Hold signals back; processes started inside never see those of a terminal.

    A terminal sends Ctrl-C, and SIGHUP when it closes, to each of its processes. Workers leave them
    to the process that started them, which receives one that came meanwhile when the block ends.

    The mask is for the children, who inherit it. It does not hold this process back: the signal may
    reach another thread of a library, and Python then interrupts the main thread all the same. So
    the handlers wait too.
    """
    # To start the tracker unblocks SIGINT, so it has to run before the mask is set.
    resource_tracker.ensure_running()
    with deferred():
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
        try:
            yield
        finally:
            # A signal that is pending now reaches the waiting handler, and is raised once after it.
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
