"""Objects that garbage collection skips: modules, and everything when a process ends."""

from __future__ import annotations

import gc
import sys
from collections.abc import Generator
from contextlib import contextmanager


@contextmanager
def left_out() -> Generator[None]:
    """Collect no garbage inside the block, and exclude all objects that exist at its end.

    It is for imports. The training libraries, torch above all, have hundreds of thousands of
    objects, hardly any of which is garbage: scanning them again and again takes an eighth of the
    time.
    """
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if collects:
            gc.enable()


def leave_at_end() -> None:
    """Let Python exit without scanning all objects of torch and a model.

    Otherwise it does so several times, which takes seconds, and many on a busy machine. With
    triton, which comes with PyTorch's GPU builds, the scan is necessary: the bindings of triton 3.9
    print dozens of lines about their objects that are left.
    """
    if "triton" in sys.modules:
        gc.unfreeze()
    else:
        gc.freeze()
