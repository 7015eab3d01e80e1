"""Ctrl-C and the signals that end a process from outside, all handled in the same way.

SIGTERM is sent by `kill`, containers and batch systems; SIGHUP arrives when a terminal closes.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Collection, Generator
from contextlib import contextmanager, nullcontext
from types import FrameType
from typing import Any, NoReturn

from aegis_cli.common.events import OnEvent, Warned

_ENDING = (signal.SIGTERM, signal.SIGHUP)
_AGAIN_S = 0.01  # delay before a signal is sent again whose exception was dropped


class Stopped(KeyboardInterrupt):
    """A signal that ends the process; it is handled like Ctrl-C."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


_stopped: list[int] = []  # signals that `stop` has raised since `listening` began


def stop(number: int, _: FrameType | None) -> NoReturn:
    """A signal handler that raises Stopped."""
    _stopped.append(number)
    raise Stopped(number)


def leave(number: int, _: FrameType | None) -> NoReturn:
    """A signal handler that ends the process at once, for use while no work is in progress."""
    raise SystemExit(128 + number)


def leave_at_ctrl_c() -> None:
    """Let Ctrl-C end the process with its own exit code until `listening` begins.

    Python's usual exception ends with a traceback, or, in some versions of typer, with code 1,
    which is that of a failed gate.
    """
    if _in_main() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, leave)


@contextmanager
def listening() -> Generator[None]:
    """Let SIGINT, SIGTERM and SIGHUP raise Stopped inside the block.

    A signal that is ignored, as SIGHUP is under nohup, or that has another handler, is left as is.

    Raises:
        Stopped: a signal came, even if it led to another error: a C library that is running at that
            moment may turn it into an error of its own.
    """
    usual = {signal.default_int_handler, leave, signal.SIG_DFL}
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, *_ENDING)}
    before = {n: handler for n, handler in handlers.items() if _in_main() and handler in usual}
    _stopped.clear()  # signals of an earlier block were raised there
    for number in before:
        signal.signal(number, stop)
    try:
        with _sending_again():
            yield
    except Exception as error:
        if _stopped:
            raise Stopped(_stopped[-1]) from error
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def ending_at_once() -> Generator[None]:
    """Let a signal that would raise Stopped end the process at once inside the block.

    A Python signal handler runs only when a call into C has returned, and a call that waits for
    other processes may never return. The block must leave nothing half-done.
    """
    numbers = (signal.SIGINT, *_ENDING) if _in_main() else ()
    before = {n: signal.getsignal(n) for n in numbers if signal.getsignal(n) is stop}
    for number in before:
        signal.signal(number, signal.SIG_DFL)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _sending_again() -> Generator[None]:
    """Send a signal again if its exception was dropped inside the block.

    A C or Rust library that is running at that moment and cannot propagate exceptions drops it.
    """
    usual = sys.unraisablehook
    timers: list[threading.Timer] = []

    def hook(dropped: Any) -> None:
        if not isinstance(dropped.exc_value, Stopped):
            usual(dropped)
            return
        # Not at once, because the handler would raise into this very hook. On a busy machine the
        # time may be over before `start` returns; then it raises here, and is sent once more.
        while True:
            timer = threading.Timer(_AGAIN_S, os.kill, (os.getpid(), dropped.exc_value.number))
            timer.daemon = True
            timers.append(timer)
            try:
                timer.start()
            except Stopped:
                continue
            return

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = usual
        for timer in timers:
            timer.cancel()


def _in_main() -> bool:
    """Whether this is the main thread; only it may set signal handlers, and they run in it."""
    return threading.current_thread() is threading.main_thread()


class Deferred:
    """A signal that waits until the work has reached a point where it can stop.

    Attributes:
        number: the signal; None until one comes.
    """

    def __init__(self) -> None:
        self.number: int | None = None

    def handle(self, number: int, _: FrameType | None) -> None:
        """Record a signal, or raise at the second one, because the user does not want to wait."""
        if self.number is not None:
            self.leave()
        self.number = number

    def leave(self) -> NoReturn:
        """Raise the exception that the signal would have raised."""
        if self.number in (None, signal.SIGINT):
            raise KeyboardInterrupt
        raise Stopped(self.number)


@contextmanager
def deferred(tell: Callable[[], None] | None = None) -> Generator[Deferred]:
    """Hold back the signals that would raise, until the block calls `leave` or ends.

    A signal with another handler, or none, is left as it is.

    Args:
        tell: called once, from a separate thread, as soon as a signal has come.
    """
    held = Deferred()
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, *_ENDING)}
    raising = (signal.default_int_handler, stop)
    before = {n: handler for n, handler in handlers.items() if _in_main() and handler in raising}
    telling = _telling(tell, before) if tell is not None and before else nullcontext()
    # Around everything, so that its thread has ended when a held signal is raised below.
    with telling:
        for number in before:
            signal.signal(number, held.handle)
        try:
            yield held
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
    if held.number is not None:
        held.leave()


@contextmanager
def saved_first(stage: str, on_event: OnEvent) -> Generator[Deferred]:
    """Like `deferred`, for a stage that saves its steps before it stops, and announces that."""
    text = (
        "received a signal: finishing and saving the current step first. A second signal ends the "
        "command at once and loses the steps since the last checkpoint"
    )
    with deferred(lambda: on_event(Warned(stage, text))) as held:
        yield held


@contextmanager
def _telling(tell: Callable[[], None], numbers: Collection[int]) -> Generator[None]:
    """Call `tell` once one of these signals has come inside the block.

    A Python signal handler waits for a call into C, such as a backward pass of many seconds. But
    Python also writes the signal's number to a file descriptor as soon as it comes, and a thread
    can read it there. If other code already reads it, `tell` is not called.
    """
    reader, writer = socket.socketpair()
    with reader, writer:
        writer.setblocking(False)
        before = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
        if before != -1:  # in use by other code, such as an asyncio event loop
            signal.set_wakeup_fd(before)
            yield
            return

        def listen() -> None:
            while came := reader.recv(1):
                if came[0] in numbers:
                    tell()
                    return

        thread = threading.Thread(target=listen, daemon=True)
        thread.start()
        try:
            yield
        finally:
            signal.set_wakeup_fd(-1)
            writer.shutdown(socket.SHUT_WR)  # the thread reads the end of the stream, and exits
            thread.join()
