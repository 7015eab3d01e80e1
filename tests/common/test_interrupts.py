"""Signals that end a process: what raises, what waits, and what is left alone."""

from __future__ import annotations

import ctypes
import hashlib
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from aegis_cli.common import interrupts
from aegis_cli.common.events import Event, Warned
from aegis_cli.common.interrupts import Stopped, deferred, ending_at_once, listening, saved_first

ENDING = [signal.SIGTERM, signal.SIGHUP]


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """Handlers as in a fresh process, and afterwards those of the test's process."""
    numbers = (signal.SIGINT, *ENDING)
    before = [signal.getsignal(number) for number in numbers]
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in ENDING:
        signal.signal(number, signal.SIG_DFL)
    yield
    for number, handler in zip(numbers, before, strict=True):
        signal.signal(number, handler)


def send(number: int) -> None:
    os.kill(os.getpid(), number)


@pytest.mark.parametrize("number", ENDING)
def test_a_signal_from_outside_is_an_interruption(number: int) -> None:
    with pytest.raises(Stopped) as caught, listening():
        send(number)
    assert caught.value.number == number and isinstance(caught.value, KeyboardInterrupt)
    assert signal.getsignal(number) is signal.SIG_DFL


@pytest.mark.parametrize("number", [signal.SIGINT, *ENDING])
def test_a_process_that_waits_for_others_ends_at_once(number: int) -> None:
    """A Python handler would run only once the others have arrived."""
    with listening():
        with ending_at_once():
            assert signal.getsignal(number) is signal.SIG_DFL
        assert signal.getsignal(number) is interrupts.stop
    with ending_at_once():  # signals that nothing handles stay as they are
        expected = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
        assert signal.getsignal(number) is expected


@pytest.mark.parametrize("number", [signal.SIGINT, *ENDING])
def test_an_error_that_came_of_a_signal_is_the_signal(number: int) -> None:
    """safetensors and ctypes turn what a handler raises into an error of their own."""
    with pytest.raises(Stopped) as caught, listening():
        try:
            send(number)
        except KeyboardInterrupt:
            raise ValueError("could not determine the shape") from None
    assert caught.value.number == number and isinstance(caught.value.__cause__, ValueError)
    with pytest.raises(ValueError, match="of its own"), listening():
        raise ValueError("of its own")


@pytest.mark.parametrize("number", [signal.SIGINT, *ENDING])
def test_a_signal_whose_exception_a_c_library_drops_comes_again(number: int) -> None:
    call = ctypes.CFUNCTYPE(None)(lambda: send(number))  # ctypes cannot pass an exception on
    with pytest.raises(Stopped) as caught, listening():
        call()
        time.sleep(10)
    assert caught.value.number == number


def test_a_dropped_signal_comes_again_though_it_is_sent_while_its_timer_starts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    start, started = threading.Timer.start, list[threading.Timer]()

    def too_late(timer: threading.Timer) -> None:
        started.append(timer)
        if len(started) == 1:
            send(signal.SIGTERM)
        start(timer)

    monkeypatch.setattr(threading.Timer, "start", too_late)
    with pytest.raises(Stopped), listening():
        ctypes.CFUNCTYPE(None)(lambda: send(signal.SIGTERM))()
        time.sleep(10)
    assert len(started) == 2


def test_other_exceptions_that_are_dropped_are_told_as_ever(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told: list[Any] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda dropped: told.append(dropped.exc_type))
    with listening():
        ctypes.CFUNCTYPE(None)(lambda: 1 // 0)()
    assert told == [ZeroDivisionError]


def test_ctrl_c_before_anybody_listens_has_its_own_code_and_then_is_an_interruption() -> None:
    interrupts.leave_at_ctrl_c()
    with pytest.raises(SystemExit) as left:
        send(signal.SIGINT)
    assert left.value.code == 130
    with pytest.raises(Stopped), listening():
        send(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is interrupts.leave


def test_what_is_ignored_or_handled_stays_so() -> None:
    """nohup ignores SIGHUP, which is its purpose."""
    seen: list[int] = []
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda number, _: seen.append(number))
    with listening(), deferred() as held:
        send(signal.SIGHUP)
        send(signal.SIGTERM)
        assert held.number is None
    assert seen == [signal.SIGTERM]


@pytest.mark.parametrize("number", [signal.SIGINT, *ENDING])
def test_a_signal_waits_until_the_work_can_be_left(number: int) -> None:
    done = []
    with listening(), pytest.raises(KeyboardInterrupt) as caught, deferred() as held:
        send(number)
        assert held.number == number
        done.append("the step")
        held.leave()
    assert done == ["the step"]
    assert getattr(caught.value, "number", signal.SIGINT) == number
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_it_is_raised_at_the_end_at_the_latest() -> None:
    done = []
    with pytest.raises(KeyboardInterrupt), deferred():
        send(signal.SIGINT)
        done.append("all")
    assert done == ["all"]


def test_who_asks_twice_does_not_wait() -> None:
    with listening(), pytest.raises(Stopped), deferred():
        send(signal.SIGTERM)
        send(signal.SIGINT)
        pytest.fail("it went on")


def test_it_is_told_while_a_call_into_c_holds_up_the_handler() -> None:
    order: list[object] = []

    def tell() -> None:
        order.append("told")

    with listening(), pytest.raises(Stopped), deferred(tell) as held:
        threading.Timer(0.1, send, [signal.SIGTERM]).start()
        while "told" not in order:  # one call takes a second or so, and signals do not end it
            assert held.number is None, "the handler came before the message"
            hashlib.pbkdf2_hmac("sha256", b"", b"", 3_000_000)
        order.append(held.number)
    assert order == ["told", signal.SIGTERM]
    assert signal.set_wakeup_fd(-1) == -1


def test_without_a_signal_nothing_is_told_and_of_several_the_first() -> None:
    told: list[None] = []
    with deferred(lambda: told.append(None)):
        pass
    assert told == []
    with pytest.raises(KeyboardInterrupt), deferred(lambda: told.append(None)):
        send(signal.SIGINT)
        send(signal.SIGINT)
    assert len(told) == 1


def test_a_stage_that_saves_first_says_so() -> None:
    said: list[Event] = []
    with pytest.raises(KeyboardInterrupt), saved_first("train", said.append):
        send(signal.SIGINT)
    (event,) = said
    assert (
        isinstance(event, Warned)
        and event.stage == "train"
        and "the current step first" in event.text
    )


def test_somebody_elses_listener_for_signals_is_kept() -> None:
    reader, writer = socket.socketpair()
    with reader, writer:
        writer.setblocking(False)
        signal.set_wakeup_fd(writer.fileno())
        try:
            with deferred(lambda: pytest.fail("it is told")):
                pass
        finally:
            assert signal.set_wakeup_fd(-1) == writer.fileno()


def test_in_other_threads_nothing_changes() -> None:
    """Handlers can only be set in the main thread."""
    problems: list[BaseException] = []

    def work(call: Callable[[], object]) -> None:
        try:
            call()
        except BaseException as error:
            problems.append(error)

    def both() -> None:
        with interrupts.listening(), interrupts.deferred() as held:
            assert held.number is None

    thread = threading.Thread(target=work, args=(both,))
    thread.start()
    thread.join()
    assert problems == []
