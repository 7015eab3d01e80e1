"""What a running stage tells its caller; stages never print."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Progress:
    """`done` of `total` units of `stage` are finished; `metrics` are the latest figures to show."""

    stage: str
    done: int
    total: int
    unit: str
    metrics: Mapping[str, float] = field(default_factory=dict)


OnEvent = Callable[[Progress], None]


def ignore(_: Progress) -> None:
    """The default listener: a stage called as a library function stays silent."""
