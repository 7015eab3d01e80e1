"""Batches of demonstration frames, read and prepared ahead of the steps that train on them."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor

from aegis_cli.common import devices, prefetch
from aegis_cli.data.batch import RobotBatch


@contextmanager
def batches(
    fetch: Callable[[int], RobotBatch], steps: Sequence[int], device: torch.device
) -> Generator[Iterator[RobotBatch]]:
    """The batch of each of these steps, fetched ahead.

    For a GPU several threads prepare them, as a model's own processor can take longer for a batch
    than the GPU for a step. Another thread sends only the next batch to the GPU, where a batch may
    take gigabytes.

    Args:
        fetch: the index of a step -> its batch; for a GPU prepared, and called by several threads.
    """
    if not devices.reading_stalls(device):
        with prefetch.ahead(fetch, steps) as ready:
            yield ready
        return
    with (
        prefetch.for_device(fetch, steps, device) as prepared,
        prefetch.ahead(lambda _: next(prepared).with_prepared_on(device), steps, 1) as sent,
    ):
        yield sent


def ready_at_once(device: torch.device) -> int:
    """How many batches may be ready for a GPU before it needs one."""
    return prefetch.workers() + 2 if devices.reading_stalls(device) else 0


def workers(device: torch.device) -> int | None:
    """Threads that prepare batches; None on a CPU."""
    return prefetch.workers() if devices.reading_stalls(device) else None


def preparing_s(prepare: Callable[[Tensor], object], rows: Tensor, most: int = 8) -> float:
    """Seconds in which one thread reads and processes the frames of a batch.

    Args:
        prepare: reads and processes the frames of some rows.
        rows: those of the batch; it is measured on the first `most` of them.
    """

    def measured(part: Tensor) -> float:
        began = time.perf_counter()
        prepare(part)
        return time.perf_counter() - began

    # In such a thread, which has one core.
    with prefetch.ahead(measured, [rows[:most]]) as seconds:
        return next(seconds) * len(rows) / min(most, len(rows))
