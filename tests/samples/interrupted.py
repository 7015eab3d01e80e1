"""A job that is interrupted at one place after another and resumed after each."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import pytest
import torch

from aegis_cli.common.events import Progress

Place = tuple[str, int]  # a stage, and how much of it is done


def stop(stage: str, at: int, event: Progress) -> None:
    """An `on_event` that ends a job there, as Ctrl-C does."""
    if event.stage == stage and event.done >= at:
        raise KeyboardInterrupt


def at_each(places: Sequence[Place], start: Callable[..., Any]) -> Iterator[Place]:
    """Interrupt a job at each of these places, which are in order, and yield each place there.

    Args:
        start: called with `on_event` and, if part of the job is done, with `resume=True`.
    """
    for number, place in enumerate(places):
        torch.manual_seed(99 + number)  # another process has another random state
        with pytest.raises(KeyboardInterrupt):
            start(on_event=partial(stop, *place), resume=number > 0)
        yield place
