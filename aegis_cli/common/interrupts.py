"""Ctrl-C goes to every process of a terminal; worker processes leave it to the one that started
them.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker


@contextmanager
def held() -> Iterator[None]:
    """Processes started inside never see Ctrl-C, not even while they start; one pressed meanwhile
    comes afterwards.

    The mask is for the children, who inherit it. It does not hold this process back: the signal may
    reach another thread of a library, and Python then interrupts the main thread all the same. So
    the handler waits too.
    """
    # else it is started inside, and lets Ctrl-C through from then on
    resource_tracker.ensure_running()
    pressed: list[int] = []
    in_main = threading.current_thread() is threading.main_thread()
    handler = (
        signal.signal(signal.SIGINT, lambda number, _: pressed.append(number)) if in_main else None
    )
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        # unmask first: a pending signal then reaches the waiting handler, and is raised once below
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        if in_main:
            signal.signal(signal.SIGINT, handler)
            if pressed:
                signal.raise_signal(signal.SIGINT)
