"""Selection of a dataset's episodes, by numbers or by the name of a split."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from aegis_cli.common.errors import AegisError

_MOST = 1_000_000  # numbers in one range or split


def listed(text: str) -> list[int]:
    """The numbers of a list such as `0,4,7-9`.

    Raises:
        ValueError: it is no such list, or a range runs backwards or has over a million numbers.
    """
    found: list[int] = []
    for part in text.split(","):
        first, _, last = part.strip().partition("-")
        last = last or first  # a single number is a range of one
        if not (first.isdecimal() and last.isdecimal()):
            raise ValueError(part)
        start, end = int(first), int(last)
        # The bound keeps a mistyped number from filling the memory.
        if not 0 <= end - start < _MOST:
            raise ValueError(part)
        found += range(start, end + 1)
    return found


def as_text(numbers: Sequence[int]) -> str:
    """The text that `listed` reads as these ascending numbers: `0,4,7-9`."""
    parts = list[list[int]]()  # a single number, or the first and last of a range
    for number in numbers:
        if parts and number == parts[-1][-1] + 1:
            parts[-1] = [parts[-1][0], number]
        else:
            parts.append([number])
    return ",".join("-".join(map(str, ends)) for ends in parts)


def chosen(text: str, count: int, splits: Mapping[str, str], path: Path) -> list[int]:
    """The episodes that `demos.only` names, in order and once each.

    Args:
        text: numbers from 0 and ranges of them, or the name of a split.
        count: how many episodes there are.
        splits: names of splits -> their episodes as LeRobot writes them, `0:40` for the first
            forty.

    Raises:
        AegisError: it is neither, or some episodes do not exist.
    """
    try:
        numbers = _named(text, splits)
    except ValueError:
        names = f", or a split: {', '.join(splits)}" if splits else ""
        raise AegisError(
            f"demos.only: {text} of '{path}'",
            f"numbers from 0 and ranges, with commas between{names}",
            f"e.g. 0-{max(0, count - 1)}",
        ) from None
    beyond = [number for number in numbers if number >= count]
    if beyond and not count:
        raise AegisError(
            f"demos.only: {text} of '{path}', which has no episode",
            "recorded episodes to choose from",
            "record some, or give other demonstrations",
        )
    if beyond:
        raise AegisError(
            f"demos.only: episode {beyond[0]} of '{path}', which has {count}",
            f"numbers from 0 to {count - 1}",
            f"e.g. 0-{count - 1}",
        )
    return sorted(set(numbers))


def _named(text: str, splits: Mapping[str, str]) -> list[int]:
    """The numbers that a list or the name of a split stands for.

    Raises:
        ValueError: it is neither.
    """
    # Splits come first, since the name of a split may be a number.
    return _of_split(splits[text]) if text in splits else listed(text)


def _of_split(said: str) -> list[int]:
    """The numbers of `FIRST:END`, without END.

    Raises:
        ValueError: it is something else, which another tool may have written.
    """
    first, colon, end = said.partition(":")
    if not (colon and first.isdecimal() and end.isdecimal()):
        raise ValueError(said)
    if int(end) - int(first) > _MOST:
        raise ValueError(said)
    return list(range(int(first), int(end)))
