"""`--vqa FILE.jsonl`: a question or a conversation per line; `FILE.json`: a list of these.

A line is `{"image": "a/b.jpg", "question": "...", "answers": ["..."]}`, with an optional `"id"`.
The answers may also be called `answer` or `multiple_choice_answer`. In a conversation each turn is
a question (`conversations.py`).
"""

from __future__ import annotations

import codecs
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from aegis_cli.common import files, json_lists
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent
from aegis_cli.common.json_lists import CHUNK
from aegis_cli.data.vqa import conversations
from aegis_cli.data.vqa.entries import (
    ANSWERS,
    Entry,
    Inside,
    OnRead,
    Read,
    Reader,
    bad,
    in_mb,
    make_question,
)
from aegis_cli.data.vqa.images import Picture
from aegis_cli.data.vqa.questions import Question

_MARK = codecs.BOM_UTF8
_LINE = 'a line such as {"image": "a.jpg", "question": "...", "answers": ["..."]}'


def reader(path: Path) -> Reader:
    """The questions of one file.

    Image paths are relative to its folder; other keys are ignored.
    """
    if path.suffix == ".jsonl":
        return Reader(lambda _, on_read: _lines(path, on_read), (path,))
    return Reader(lambda _, on_read: _items(path, on_read), (path,), partial(_check, path))


def is_list(path: Path) -> bool:
    """Whether a JSON file begins with a list."""
    with files.reading(path, "check the path"), open(path, "rb") as file:
        return file.read(1024).removeprefix(_MARK).lstrip()[:1] == b"["


def _lines(path: Path, on_read: OnRead) -> Iterator[Read]:
    images = Inside(path.parent)
    with files.reading(path, "check the path"), open(path, "rb") as file:
        size = _size(path)
        done, told = 0, 0  # bytes
        for number, line in enumerate(file, start=1):
            done += len(line)
            if done - told >= CHUNK:
                on_read(done, size)
                told = done
            if line.isspace():
                continue
            where = f"line {number} of '{path}'"
            try:
                # Some editors write a byte-order mark at the start.
                raw = files.parse_json(line.removeprefix(_MARK).decode())
            except ValueError as error:
                yield bad(where, f"not JSON ({error})", _LINE, "correct that line")
            else:
                yield from _asked(where, f"line {number}", raw, images)


def _items(path: Path, on_read: OnRead) -> Iterator[Read]:
    images = Inside(path.parent)
    size = _size(path)
    listed = _listed(path, lambda done: on_read(done, size))
    for number, raw in enumerate(listed, start=1):
        yield from _asked(f"item {number} of '{path}'", f"item {number}", raw, images)


def _listed(path: Path, on_read: Callable[[int], None]) -> Iterator[Any]:
    """The items of a list.

    Raises:
        AegisError: the file is not JSON, which may be found out after many items.
    """
    return json_lists.read_list(path, None, {}, on_read, partial(_whole_list, path))


def _whole_list(path: Path) -> list[Any]:
    listed = files.load_json(path)
    if not isinstance(listed, list):
        raise AegisError(f"no list in '{path}'", "a list of questions", "check the path")
    return listed


def _check(path: Path, on_event: OnEvent) -> None:
    """Raise AegisError unless the whole file is JSON."""
    for _ in _listed(path, in_mb("check the file", _size(path), on_event)):
        pass


def _size(path: Path) -> int:
    with files.reading(path, "check the path"):
        return path.stat().st_size


def _asked(where: str, place: str, raw: Any, images: Inside) -> Iterator[Read]:
    """The questions of a line, or the error in it.

    Args:
        place: the id in predictions for a question without one.
    """
    try:
        if not isinstance(raw, dict):
            raise bad(
                where,
                f"a JSON {type(raw).__name__}",
                "an object with image, question and answers",
                "correct that line",
            )
        key = conversations.key_of(raw)
        _check_keys(where, raw, key)
        picture = _picture(where, raw, images)
        name = raw.get("id")
        for question in _questions(where, raw, key, place if name is None else name):
            yield Entry(where, question, picture)
    except AegisError as error:
        yield error


def _questions(where: str, raw: dict[str, Any], key: str | None, name: Any) -> list[Question]:
    """The line's single question, or those of the conversation under `key`."""
    if key is not None:
        return conversations.questions(where, raw[key], name, raw.get("source"))
    answers = next(key for key in ANSWERS if key in raw)
    return [make_question(where, raw["question"], raw[answers], name, "all")]


def _check_keys(where: str, raw: dict[str, Any], key: str | None) -> None:
    """Raise AegisError unless there are an image and a question with answers or a conversation."""
    needed = ["image"]
    if key is None:
        needed += ["question", next((key for key in ANSWERS if key in raw), ANSWERS[0])]
    present = {"image"} if "images" in raw else set()
    missing = [key for key in needed if key not in raw and key not in present]
    if missing:
        raise bad(
            where,
            f"no {' and no '.join(missing)}",
            "the keys image, question and answers, or image and a conversation",
            "add what is missing",
        )


def _picture(where: str, raw: dict[str, Any], images: Inside) -> Picture:
    """The one image that a line asks about."""
    shown = conversations.one_picture(where, raw.get("image", raw.get("images")))
    if not isinstance(shown, str):
        raise bad(
            where, f"image {shown!r}", "a path relative to the file's folder", "correct the path"
        )
    found = images.find(where, shown)
    # By its resolved name: two spellings of one image must not put it into two parts.
    return Picture(found.name, where, found.path)
