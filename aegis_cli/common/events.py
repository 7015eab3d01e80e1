"""What a running stage tells its caller; stages never print."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Progress:
    """`done` of `total` units of `stage` are finished; `metrics` are the latest figures to show."""

    stage: str
    done: int
    total: int
    unit: str
    metrics: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Warned:
    """`stage` goes on, but its result may not be what the user has in mind; `text` says why.

    That a signal has come is told from a thread of its own, while the stage is at work.
    """

    stage: str
    text: str


Event = Progress | Warned
OnEvent = Callable[[Event], None]


def ignore(_: Event) -> None:
    """The default listener: a stage called as a library function stays silent."""


@contextmanager
def loading_told(stage: str, on_event: OnEvent) -> Generator[None]:
    """Tell that a stage loads its model and what it reads, and when it has.

    Otherwise nobody hears of a stage for a minute or more, if its log is a pipe.
    """
    on_event(Progress(f"{stage} (loading)", 0, 1, "model"))
    yield
    on_event(Progress(f"{stage} (loading)", 1, 1, "model"))
