"""What is not looked through for garbage: modules, and all there is when a process ends."""

from __future__ import annotations

import gc
import sys
from collections.abc import Generator
from contextlib import contextmanager


@contextmanager
def left_out() -> Generator[None]:
    """Collect no garbage within the block, and look through nothing of what is there at its end.

    It is for imports. What trains, torch above all, has hundreds of thousands of objects, of which
    hardly one is garbage: to look through them again and again takes an eighth of the time.
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
    """Let Python end without looking through all that torch and a model consist of.

    Else it does so again and again: seconds, and many of them on a busy machine. Where triton is
    there, which PyTorch's builds for GPUs bring, it has to: the bindings of triton 3.9 write dozens
    of lines about whatever is left of them.
    """
    if "triton" in sys.modules:
        gc.unfreeze()
    else:
        gc.freeze()
