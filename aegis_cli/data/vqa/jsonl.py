"""`--vqa FILE.jsonl`: a question per line.

A line is `{"image": "a/b.jpg", "question": "...", "answers": ["..."]}`, with an optional `"id"`.
The answers may be called `answer` or `multiple_choice_answer`, too.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError
from aegis_cli.data.vqa.entries import ANSWERS, Entry, Inside, Read, Reader, bad, make_question
from aegis_cli.data.vqa.images import Picture


def reader(path: Path) -> Reader:
    """The questions of one file.

    Image paths are relative to its folder; other keys are ignored.
    """
    return Reader(lambda: _read(path), (path,))


def _read(path: Path) -> Iterator[Read]:
    images = Inside(path.parent)
    with files.reading(path, "check the path"), open(path, "rb") as file:
        for number, line in enumerate(file, start=1):
            if line.strip():
                try:
                    yield _entry(f"line {number} of '{path}'", number, line, images)
                except AegisError as error:
                    yield error


def _entry(where: str, number: int, line: bytes, images: Inside) -> Entry:
    try:
        raw = files.parse_json(line.decode("utf-8-sig"))  # some editors put a mark at the start
    except ValueError as error:
        raise bad(
            where,
            f"not JSON ({error})",
            'a line such as {"image": "a.jpg", "question": "...", "answers": ["..."]}',
            "correct that line",
        ) from error
    if not isinstance(raw, dict):
        raise bad(
            where,
            f"a JSON {type(raw).__name__}",
            "an object with image, question and answers",
            "correct that line",
        )
    several = raw.get("image", raw.get("images"))
    if isinstance(several, list):
        raise bad(
            where,
            f"a list of {len(several)} images",
            "one image of each question, as a path",
            "name the one that is asked about, or join them into one picture",
        )
    answers = next((key for key in ANSWERS if key in raw), ANSWERS[0])
    missing = [key for key in ("image", "question", answers) if key not in raw]
    if missing:
        raise bad(
            where,
            f"no {' and no '.join(missing)}",
            "the keys image, question and answers",
            "add what is missing",
        )
    if not isinstance(raw["image"], str):
        raise bad(
            where,
            f"image {raw['image']!r}",
            "a path relative to the file's folder",
            "correct the path",
        )
    name = raw.get("id")
    # Without an id the line is the name by which predictions tell the question.
    own = f"line {number}" if name is None else name
    question = make_question(where, raw["question"], raw[answers], own, "all")
    path = images.find(where, raw["image"])
    # Not as it is spelt: two spellings of one image would put it into two parts.
    return Entry(where, question, Picture(images.name(path), where, path))
