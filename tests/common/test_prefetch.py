"""How many threads prepare batches for a GPU, and how many batches wait."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

import pytest
import torch

from aegis_cli.common import devices, launch, memory, prefetch, processes

CPU = torch.device("cpu")


@pytest.fixture
def waits(monkeypatch: pytest.MonkeyPatch) -> None:
    """The CPU is treated as a GPU, for which threads prepare."""
    monkeypatch.setattr(devices, "reading_stalls", lambda _: True)


@pytest.mark.fast
@pytest.mark.parametrize(
    ("cores", "allowed", "processes_here", "expected"),
    [(64, 64, 1, 16), (16, 16, 1, 15), (16, 16, 4, 3), (64, 8, 1, 7), (64, 8, 8, 7), (1, 1, 1, 1)],
)
def test_threads_fill_this_processes_cores_but_one_up_to_16(
    cores: int,
    allowed: int,
    processes_here: int,
    expected: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(processes, "_cores", lambda: cores)
    monkeypatch.setattr(prefetch.os, "sched_getaffinity", lambda _: set(range(allowed)))
    monkeypatch.setattr(launch, "local_world_size", lambda: processes_here)
    assert prefetch.workers() == expected


@pytest.mark.fast
def test_the_number_that_is_asked_for_holds_inside_the_block(waits: None) -> None:
    before = prefetch.workers()
    met = threading.Barrier(23)
    with prefetch.using(23):
        assert prefetch.workers() == 23
        # Each call waits for 22 others at the same time.
        with prefetch.ahead(lambda _: met.wait(60), range(23), 23, prefetch.workers()) as made:
            assert len(list(made)) == 23
        with prefetch.using(None):
            assert prefetch.workers() == before
    assert prefetch.workers() == before


@pytest.mark.fast
def test_few_batches_wait_for_steps_that_take_longer_than_a_batch(waits: None) -> None:
    """However many threads there are, of which each could hold gigabytes."""
    begun = list[int]()
    with (
        prefetch.using(40),
        prefetch.for_device(lambda i: begun.append(i) or i, range(100), CPU) as made,
    ):
        for number, i in zip(range(20), made, strict=False):
            assert i == number
            wanted = number + 1 + prefetch.DEPTH
            until(lambda wanted=wanted: len(begun) >= wanted)
            time.sleep(0.01)  # a step
    # A first batch may be waited for, which doubles their number once.
    assert len(begun) <= 20 + 2 * prefetch.DEPTH


@pytest.mark.fast
def test_every_thread_prepares_where_steps_wait(waits: None) -> None:
    busy, most, lock = 0, 0, threading.Lock()

    def prepare(i: int) -> int:
        nonlocal busy, most
        with lock:
            busy += 1
            most = max(most, busy)
        time.sleep(0.05)
        with lock:
            busy -= 1
        return i

    with prefetch.using(9), prefetch.for_device(prepare, range(60), CPU) as made:
        assert list(made) == list(range(60))
    assert most == 9


@dataclass(frozen=True)
class Batch:
    """A batch as it comes from a thread: tensors in tuples and mappings."""

    images: tuple[torch.Tensor, ...]
    extra: dict[str, list[torch.Tensor]]


@pytest.mark.fast
@pytest.mark.parametrize("several", [1, 2])
@pytest.mark.parametrize("short", [0, 1])
def test_no_more_batches_are_made_at_once_than_there_is_memory_for(
    several: int, short: int, waits: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Even if steps wait; the processes of one machine share its memory."""
    size, alive, most, lock = 3000, 0, 0, threading.Lock()
    # A batch takes twice its size while it is made, and half of the memory stays free.
    monkeypatch.setattr(memory, "free", lambda _: several * 4 * size - short)
    monkeypatch.setattr(launch, "local_world_size", lambda: several)

    def prepare(_: int) -> Batch:
        nonlocal alive, most
        with lock:
            alive += 1
            most = max(most, alive)
        time.sleep(0.02)
        return Batch((torch.zeros(1000, dtype=torch.uint8),) * 2, {"a": [torch.zeros(250)]})

    with prefetch.using(50), prefetch.for_device(prepare, range(30), CPU) as made:
        for _ in made:
            with lock:
                alive -= 1
    assert most == prefetch.DEPTH + 1 if short else most > prefetch.DEPTH + 1


def until(holds: object) -> None:
    """Wait until a condition holds."""
    assert callable(holds)
    given_up = time.monotonic() + 60
    while not holds():
        assert time.monotonic() < given_up
        time.sleep(0.001)
