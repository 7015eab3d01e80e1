"""Figures of a report's JSON, each shown together with its path in the JSON.

A page is a function of the document that `--json` prints. A figure in it is a `data` element with
the exact value and its path in the document, so any difference between the two can be found.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from aegis_cli.cli.page.html import Child, Markup, element, join
from aegis_cli.cli.render.layout import fixed, number, percent


@dataclass(frozen=True)
class At:
    """A value of the document, and its path as a JSON pointer (RFC 6901): `/rows/0/accuracy`."""

    value: Any
    path: str = ""

    def __getitem__(self, key: str | int) -> At:
        """The value inside; nothing for a mapping without the key, or for nothing."""
        if self.value is None:
            return self
        inner = self.value.get(key) if isinstance(self.value, dict) else self.value[key]
        # "/" separates the parts of a pointer. "~" is escaped first, since escaping "/" adds it.
        word = str(key).replace("~", "~0").replace("/", "~1")
        return At(inner, f"{self.path}/{word}")

    def __iter__(self) -> Iterator[At]:
        """The items of a list, or the values of a mapping."""
        keys = self.value if isinstance(self.value, dict) else range(len(self.value or ()))
        return (self[key] for key in keys)

    def __bool__(self) -> bool:
        """Whether there is a value; 0 and False count as values."""
        return self.value is not None and self.value not in ([], {}, ())

    def __str__(self) -> str:
        return "" if self.value is None else str(self.value)

    @property
    def key(self) -> str:
        """The last part of the path."""
        return self.path.rpartition("/")[2].replace("~1", "/").replace("~0", "~")


def shown(at: At, write: Callable[[Any], str]) -> Markup:
    """A figure formatted by `write`; a dash for None."""
    if at.value is None:
        return Markup("–")
    return element("data", write(at.value), value=repr(at.value), data_path=at.path)


def share(at: At, digits: int = 1) -> Markup:
    """A share in [0, 1], in percent."""
    return shown(at, lambda value: percent(value, digits))


def decimal(at: At, digits: int = 2) -> Markup:
    return shown(at, lambda value: fixed(value, digits))


def plain(at: At) -> Markup:
    """A number with four digits."""
    return shown(at, number)


def whole(at: At) -> Markup:
    return shown(at, lambda value: f"{value:,}")


def between(interval: At | tuple[At, At] | None, write: Callable[[At], Child]) -> Markup | None:
    """The two ends of an interval in small type; None without an interval."""
    if not interval:
        return None
    low, high = write(interval[0]), write(interval[1])
    return element("small", low, " to ", high, class_="interval", title="95 %")


def farthest(*intervals: At) -> tuple[At, At] | None:
    """The lowest lower end and the highest upper end of the given intervals.

    Each keeps its path, so that the page still shows its origin.
    """
    known = [interval for interval in intervals if interval]
    if not known:
        return None
    low = min((interval[0] for interval in known), key=lambda end: end.value)
    high = max((interval[1] for interval in known), key=lambda end: end.value)
    return low, high


def with_interval(at: At, interval: At, write: Callable[[At], Child]) -> Markup:
    """A figure with its 95 % interval below it."""
    return join(write(at), between(interval, write))
