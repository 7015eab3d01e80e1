"""`--vqa …_questions.json`: VQAv2 and OK-VQA as their sites distribute them.

The annotations file, under its official name, has to be beside the questions file, and so do the
images, as COCO's archive unpacks them (`val2014/COCO_val2014_000000262148.jpg`) or without that
folder.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from aegis_cli.common import files, json_lists
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent
from aegis_cli.data.vqa.entries import (
    Entry,
    OnRead,
    Read,
    Reader,
    bad,
    in_mb,
    make_question,
)
from aegis_cli.data.vqa.images import Picture

SUFFIX = "questions.json"
_EVERY = 10_000  # questions between two reports of progress


def reader(path: Path) -> Reader:
    """The questions of one questions file and its annotations.

    Raises:
        AegisError: there is no annotations file of the matching name beside it.
    """
    common = path.name.replace("OpenEnded_", "").removesuffix(SUFFIX)
    annotations = path.with_name(common + "annotations.json")
    if not annotations.is_file():
        # If the file holds no questions, report that instead of the missing annotations.
        _rows(path, _load(path), "questions")
        raise AegisError(
            f"no file '{annotations}'",
            f"the annotations of '{path.name}' beside it, under their official name",
            "put both files into one folder",
        )
    return Reader(partial(_read, path, annotations), (path, annotations))


def misnamed(path: Path) -> AegisError:
    """The error for a .json file not named like a questions file: wrong content or name."""
    _rows(path, _load(path), "questions")
    return AegisError(
        f"'{path}' has questions, and a name that does not end in '{SUFFIX}'",
        f"the official name, which also says what its annotations are called: ..._{SUFFIX}",
        "give both files their official names",
    )


class _Annotation(NamedTuple):
    """What is read of an annotation."""

    image_id: Any
    answers: Any
    kind: Any


def _read(path: Path, annotations: Path, on_event: OnEvent, on_read: OnRead) -> Iterator[Read]:
    """Each question with its annotation, then an error for each annotation without a question."""
    about: dict[str, Any] = {}
    questions = list(_listed(path, "questions", on_event, about))
    images = _Images(path, about.get("data_subtype"))
    # A file that is no JSON is refused for that, which its end may tell.
    told, problems = _told(annotations, _listed(annotations, "annotations", on_event, {}))
    yield from problems
    for number, row in enumerate(questions, start=1):
        if number % _EVERY == 0:
            on_read(number, len(questions))
        try:
            yield _entry(f"question {number} of '{path}'", row, told, annotations, images)
        except AegisError as error:
            yield error
    for name in told:
        yield bad(
            f"question_id {name} of '{annotations}'",
            "an annotation without its question",
            f"a question of that id in '{path.name}'",
            "take both files of one release",
        )


def _listed(path: Path, key: str, on_event: OnEvent, about: dict[str, Any]) -> Iterator[Any]:
    """The rows that an official file has under a key; its other values go into `about`."""

    def of_whole() -> list[Any]:
        whole = _load(path)
        rows = _rows(path, whole, key)
        about.update(whole)
        return rows

    with files.reading(path, "check the path"):
        size = path.stat().st_size
    return json_lists.read_list(path, key, about, in_mb(f"read {key}", size, on_event), of_whole)


def _told(
    annotations: Path, rows: Iterable[Any]
) -> tuple[dict[str | int, _Annotation], list[AegisError]]:
    """The annotations by question, and an error for each that has no question or a known one."""
    told: dict[str | int, _Annotation] = {}
    problems = []
    for number, row in enumerate(rows, start=1):
        name = _id(row)
        if name is not None and name not in told:
            told[name] = _slim(row)
            continue
        found = _no_id(row) if name is None else f"a second annotation of question {name}"
        problems.append(
            bad(
                f"annotation {number} of '{annotations}'",
                found,
                "one annotation per question",
                "correct the file",
            )
        )
    return told, problems


def _slim(row: dict[str, Any]) -> _Annotation:
    """An annotation in little memory: its answers are a few words that occur a million times."""
    answers: Any = row.get("answers")
    if type(answers) is list:
        with contextlib.suppress(KeyError, TypeError):  # other forms stay as they are
            answers = [sys.intern(each["answer"]) for each in answers]
    return _Annotation(row.get("image_id"), answers, row.get("answer_type"))


def _entry(
    where: str,
    row: Any,
    told: dict[str | int, _Annotation],
    annotations: Path,
    images: _Images,
) -> Entry:
    """One question; its annotation is removed from `told`."""
    name = _id(row)
    if name is None:
        raise bad(
            where,
            _no_id(row),
            "an object with question_id, image_id and question",
            "correct the file",
        )
    # From here on errors name the id, which both files have.
    where = f"question_id {name} of {where.partition(' of ')[2]}"
    annotation = told.pop(name, None)
    if annotation is None:
        raise bad(
            where,
            f"no annotation in '{annotations.name}'",
            "one annotation per question",
            "take both files of one release",
        )
    image, other = row.get("image_id"), annotation.image_id
    if image != other:
        raise bad(
            where,
            f"image_id {image}, and {other} in its annotation",
            "the same image in both files",
            "take both files of one release",
        )
    kind = annotation.kind
    family = kind if isinstance(kind, str) and kind else "all"
    question = make_question(where, row.get("question"), annotation.answers, name, family)
    return Entry(where, question, images.picture(where, image))


def _id(row: Any) -> str | int | None:
    """The question id of a row of either file; None if it has none."""
    name = row.get("question_id") if isinstance(row, dict) else None
    return name if isinstance(name, (str, int)) else None


def _no_id(row: Any) -> str:
    """What a row has instead of a question id."""
    name = row.get("question_id") if isinstance(row, dict) else None
    return "no question_id" if name is None else f"question_id {name!r}"


class _Images:
    """COCO's images of one part, such as val2014."""

    def __init__(self, questions: Path, part: Any) -> None:
        if not isinstance(part, str) or not part.isalnum():
            raise AegisError(
                f"data_subtype {part!r} in '{questions}'",
                "a part of COCO such as val2014",
                "take the official file, or write a .jsonl file of your own",
            )
        self.part, self._folders = part, (questions.parent / part, questions.parent)
        self._found: dict[int, str] = {}

    def picture(self, where: str, number: Any) -> Picture:
        """The image of this number.

        Raises:
            AegisError: it is no whole number, or has no file.
        """
        if type(number) is not int or number < 0:
            raise bad(where, f"image_id {number!r}", "a whole number", "correct the file")
        name = f"COCO_{self.part}_{number:012d}.jpg"
        if number not in self._found:  # several questions share an image
            places = [os.path.join(folder, name) for folder in self._folders]
            path = next((place for place in places if os.path.isfile(place)), None)
            if path is None:
                raise bad(
                    where,
                    f"no image '{self._folders[0] / name}'",
                    "COCO's images beside the questions",
                    f"unpack {self.part}.zip of cocodataset.org in '{self._folders[1]}'",
                )
            self._found[number] = path
        return Picture(name, where, self._found[number])


def _load(path: Path) -> dict[str, Any]:
    with files.reading(path, "check the path"):
        data = path.read_bytes()
    try:
        whole = files.parse_json(data)
    except ValueError as error:
        raise AegisError(
            f"'{path}' is not JSON ({error})", "the official file", "download it again"
        ) from error
    return whole if isinstance(whole, dict) else {}


def _rows(path: Path, whole: dict[str, Any], key: str) -> list[Any]:
    rows = whole.get(key)
    if not isinstance(rows, list):
        raise AegisError(
            f"'{path}' has no list of {key} under the key '{key}'",
            f"an official file of VQAv2 or OK-VQA with the key '{key}', or a .jsonl file with a "
            "question per line",
            "download it again, or give another file",
        )
    return rows
