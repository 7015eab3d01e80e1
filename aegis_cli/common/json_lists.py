"""The items of a long list in a JSON file, one by one, without holding the whole file."""

from __future__ import annotations

import codecs
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError

CHUNK = 2**22  # bytes that are read at a time
_DECODE = json.JSONDecoder().raw_decode
_SPACE = re.compile(r"[ \t\n\r]*").match
# What follows a value or a key. Without it a value at the end of what was read may continue: a
# number has no end of its own.
_FOLLOWS = frozenset(",:]}")

Read = Callable[[int], None]  # called with the number of bytes read so far


class Unusual(ValueError):
    """The file is not JSON, or not in the form that is read in pieces: read it whole."""


def read_list(
    path: Path,
    key: str | None,
    rest: dict[str, Any],
    on_read: Read,
    of_whole: Callable[[], list[Any]],
) -> Iterator[Any]:
    """The items of the list that a file holds, in pieces or, in an unusual file, read whole.

    Args:
        key, rest: as in `items`.
        of_whole: reads the list of an unusual file, or raises the error in that file.

    Raises:
        AegisError: the file is unusable, which may show only after many items.
    """
    given = 0
    with files.reading(path, "check the path"), open(path, "rb") as file:
        try:
            for item in items(file, key, rest, on_read):
                yield item
                given += 1
            return
        except Unusual:
            pass
    yield from of_whole()[given:]


def items(file: BinaryIO, key: str | None, rest: dict[str, Any], on_read: Read) -> Iterator[Any]:
    """The items of the list that a file holds.

    Args:
        file: at its beginning.
        key: the list's key in the object that the file holds; None if the file is the list.
        rest: filled with the object's other values; complete when the last item was taken.

    Raises:
        Unusual: at any point of the file, maybe after many items.
        AegisError: the list occurs twice.
    """
    if json.detect_encoding(file.read(4)) not in ("utf-8", "utf-8-sig"):
        raise Unusual("another encoding")
    file.seek(0)
    try:
        text = _Text(file, on_read)
        if key is None:
            yield from text.listed()
        else:
            yield from _of_object(text, key, rest, file.name)
        text.end()
    except RecursionError:
        raise Unusual("nested too deep") from None
    except Unusual:
        raise
    except ValueError as error:
        raise Unusual(str(error)) from error


def _of_object(text: _Text, key: str, rest: dict[str, Any], path: str) -> Iterator[Any]:
    """The items of the list under a key; the object's other values go into `rest`."""
    seen = False
    text.take("{")
    while True:
        name = text.value()
        text.take(":")
        if not isinstance(name, str):
            raise Unusual("a key that is no text")
        if seen and name == key:
            # JSON readers take the last one, after these items were taken of the first.
            raise AegisError(f"'{path}' has the key '{key}' twice", "it once", "correct the file")
        if name == key and text.peek() == "[":
            seen = True
            yield from text.listed()
        else:
            rest[name] = text.value()
        if text.peek() == "}":
            break
        text.take(",")
    text.take("}")
    if not seen:
        raise Unusual("no such list")


class _Text:
    """The text of a file, of which only what is not yet taken is kept."""

    def __init__(self, file: BinaryIO, on_read: Read) -> None:
        self._file, self._on_read = file, on_read
        # It leaves out a byte-order mark, also one that is read in parts.
        self._decoder = codecs.getincrementaldecoder("utf-8-sig")("surrogatepass")
        self._text, self._at = "", 0
        self._bytes, self._is_whole = 0, False
        self._more()

    def _more(self) -> None:
        """Read on. An item longer than what is read at a time doubles that."""
        rest = self._text[self._at :]
        data = self._file.read(max(CHUNK, len(rest)))
        self._is_whole = not data
        self._bytes += len(data)
        self._text, self._at = rest + self._decoder.decode(data, final=self._is_whole), 0
        if data:
            self._on_read(self._bytes)

    def peek(self) -> str:
        """The next character that is no space; "" at the end."""
        while True:
            self._at = _SPACE(self._text, self._at).end()  # type: ignore[union-attr]
            if self._at < len(self._text) or self._is_whole:
                return self._text[self._at : self._at + 1]
            self._more()

    def take(self, mark: str) -> None:
        """Go past a mark."""
        if self.peek() != mark:
            raise Unusual(f"no {mark}")
        self._at += 1

    def value(self) -> Any:
        """Go past the next value and the spaces after it, to what follows."""
        while True:
            try:
                at = _SPACE(self._text, self._at).end()  # type: ignore[union-attr]
                found, end = _DECODE(self._text, at)
            except ValueError:
                if self._is_whole:
                    raise
            else:
                end = _SPACE(self._text, end).end()  # type: ignore[union-attr]
                if self._text[end : end + 1] in _FOLLOWS:
                    self._at = end
                    return found
                if self._is_whole:
                    raise Unusual("something after a value")
            self._more()

    def listed(self) -> Iterator[Any]:
        """Go past a list, whose items these are."""
        self.take("[")
        if self.peek() == "]":
            self._at += 1
            return
        mark = ","
        while mark == ",":
            yield self.value()
            mark = self._text[self._at]
            self._at += 1
        if mark != "]":
            raise Unusual(f"{mark} after an item")

    def end(self) -> None:
        """Make sure that nothing follows."""
        if self.peek():
            raise Unusual("something after the end")
