"""Events by which a running stage reports to its caller; stages never print."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TypeVar

Item = TypeVar("Item")


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
    """`stage` continues, but its result may not be what the user expects; `text` says why.

    The arrival of a signal is reported from a separate thread, while the stage is running.
    """

    stage: str
    text: str


Event = Progress | Warned
OnEvent = Callable[[Event], None]


def ignore(_: Event) -> None:
    """The default listener: a stage called as a library function stays silent."""


class Tally:
    """Reports the progress of many small units, once in `every` of them and at the end.

    Fewer than `every` are over in no time, and nothing is reported.
    """

    def __init__(self, stage: str, total: int, unit: str, every: int, on_event: OnEvent) -> None:
        self._stage, self._total, self._unit, self._every = stage, total, unit, every
        self._on_event = on_event
        self._done, self._reported = 0, 0

    def advance(self, count: int = 1) -> None:
        """Count `count` more units."""
        self._done += count
        is_due = self._done - self._reported >= self._every or self._done == self._total
        if self._total >= self._every and is_due:
            self._reported = self._done
            self._on_event(Progress(self._stage, self._done, self._total, self._unit))

    def each(self, items: Iterable[Item]) -> Iterator[Item]:
        """The items, each counted after it was used."""
        for item in items:
            yield item
            self.advance()


@contextmanager
def loading_told(stage: str, on_event: OnEvent) -> Generator[None]:
    """Report that a stage is loading its model and inputs, and when it has finished.

    Otherwise a stage whose log is a pipe would show nothing for a minute or more.
    """
    on_event(Progress(f"{stage} (loading)", 0, 1, "model"))
    yield
    on_event(Progress(f"{stage} (loading)", 1, 1, "model"))
