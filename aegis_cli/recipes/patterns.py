"""Patterns of dotted names: `vision`, `layers.0-11`, `*.layers.0-5`, `*.bias`.

`*` stands for any characters, including dots, and `?` for one character. A word of the form `0-11`
between dots stands for each of these whole numbers. A pattern must match the whole name. There are
no brackets, because `[0-11]` means 0 or 1 in a shell.
"""

from __future__ import annotations

import re

_RANGE = re.compile(r"(\d+)-(\d{1,3})")
EXPECTED = "a dotted name such as vision; `*` and `?` as in a shell, and ranges such as layers.0-11"


def is_pattern(text: str) -> bool:
    """Whether a text can be a pattern: words between dots, with rising ranges below 1,000."""
    words = text.split(".")
    return all(re.fullmatch(r"[\w*?-]+", word) and _rises(word) for word in words)


def compiled(pattern: str) -> re.Pattern[str]:
    """A regular expression that fully matches the names that the pattern stands for."""
    return re.compile(r"\.".join(map(_word, pattern.split("."))))


def at_its_ends(pattern: str) -> tuple[str, ...]:
    """The pattern with the first number of each of its ranges, and with the last number.

    They serve to find ranges that go beyond the existing names. Without ranges, the result is ().
    """
    words = pattern.split(".")
    if not any(map(_RANGE.fullmatch, words)):
        return ()
    first = ".".join(_end(word, 1) for word in words)
    last = ".".join(_end(word, 2) for word in words)
    return first, last


def _end(word: str, number: int) -> str:
    """The range's first number (1) or its last (2); any other word is returned unchanged."""
    found = _RANGE.fullmatch(word)
    return found[number] if found else word


def _rises(word: str) -> bool:
    found = re.fullmatch(r"(\d+)-(\d+)", word)
    return found is None or int(found[1]) <= int(found[2]) < 1000


def _word(word: str) -> str:
    """A word between dots as a regular expression."""
    found = _RANGE.fullmatch(word)
    if found:
        numbers = range(int(found[1]), int(found[2]) + 1)
        return f"(?:{'|'.join(map(str, numbers))})"
    wild = {"*": ".*", "?": "."}
    return "".join(wild.get(letter) or re.escape(letter) for letter in word)
