"""Ctrl-C goes to every process of a terminal; worker processes leave it to the one that started them."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker


@contextmanager
def held() -> Iterator[None]:
    """Processes started inside never see Ctrl-C, not even while they start; one pressed meanwhile comes afterwards."""
    resource_tracker.ensure_running()  # else it is started inside, and lets Ctrl-C through from then on
    earlier = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, earlier)
