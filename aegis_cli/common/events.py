"""Events by which a running stage reports to its caller; stages never print."""

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
    """`stage` continues, but its result may not be what the user expects; `text` says why.

    The arrival of a signal is reported from a separate thread, while the stage is running.
    """

    stage: str
    text: str


Event = Progress | Warned
OnEvent = Callable[[Event], None]


def ignore(_: Event) -> None:
    """The default listener: a stage called as a library function stays silent."""


@contextmanager
def loading_told(stage: str, on_event: OnEvent) -> Generator[None]:
    """Report that a stage is loading its model and inputs, and when it has finished.

    Otherwise a stage whose log is a pipe would show nothing for a minute or more.
    """
    on_event(Progress(f"{stage} (loading)", 0, 1, "model"))
    yield
    on_event(Progress(f"{stage} (loading)", 1, 1, "model"))
