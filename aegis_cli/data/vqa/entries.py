"""Questions as the readers of files yield them: each is checked, and knows its place."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aegis_cli.common.errors import AegisError
from aegis_cli.data.vqa.answers import reference
from aegis_cli.data.vqa.images import Picture
from aegis_cli.data.vqa.questions import Question

# Halves of characters (surrogates): JSON can hold them, but no tokenizer takes them.
_HALVES = re.compile("[\ud800-\udfff]")
# What the answers of a question are called, the first that is there.
ANSWERS = ("answers", "answer", "multiple_choice_answer")
OR_SKIP = ", or leave such questions out with --skip-bad (skip_bad: true in a recipe)"


@dataclass(frozen=True, slots=True)
class Entry:
    """A question, its image, and where both stand in their file."""

    where: str
    question: Question
    picture: Picture


# A reader goes on after a bad question, because others decide whether that ends the work.
Read = Entry | AegisError


@dataclass(frozen=True)
class Reader:
    """A set of one format.

    Attributes:
        read: yields every question, or what is wrong with it; raises where the whole set is
            unusable.
        files: those that hold the questions.
    """

    read: Callable[[], Iterator[Read]]
    files: tuple[Path, ...]


def bad(where: str, found: str, expected: str, fix: str) -> AegisError:
    """What is wrong with one question."""
    return AegisError(f"{where}: {found}", expected, fix + OR_SKIP)


def make_question(where: str, text: Any, answers: Any, name: Any, family: str) -> Question:
    """A question that people answered.

    Args:
        answers: a list of what each person said, or one person's answer alone; each a text, a whole
            number, or an object whose `answer` is one.

    Raises:
        AegisError: a text that is none, no answers, or a name that is neither text nor a whole
            number.
    """
    if not _is_text(text):
        raise bad(where, f"question {_show(text)}", "a text", "write what is asked")
    answers = _texts(answers)
    if not answers or not all(_is_text(a) for a in answers):
        found = f"answers {_show(answers)}" if answers else "no answer"
        expected = "a list of one or more texts, what people answered"
        raise bad(where, found, expected, 'write e.g. ["red"]')
    if isinstance(name, bool) or not isinstance(name, (str, int)):
        raise bad(where, f"id {_show(name)}", "a text or a whole number", "correct the id")
    said = tuple(map(sys.intern, answers))  # the same few words, a million times
    return Question(family, text.strip(), reference(said).strip(), said, name)


def _texts(answers: Any) -> list[Any]:
    """The answers one by one, whole numbers as texts."""
    if isinstance(answers, dict):  # a column of lists, as older versions store lists of objects
        answers = answers.get("answer")
    if answers is None:
        return []
    listed = answers if isinstance(answers, list) else [answers]
    said = [a.get("answer") if isinstance(a, dict) else a for a in listed]
    # Python takes True for a number, but no person answers with it.
    return [str(a) if isinstance(a, int) and not isinstance(a, bool) else a for a in said]


class Inside:
    """Image paths below a folder, with links followed; no path may lead out of it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        # It ends with a separator: `a/bc` is not below `a/b`.
        self._root = os.path.join(os.path.realpath(folder), "")
        self._found: dict[str, Path | None] = {}  # a name -> its file; None leads out of the folder

    def name(self, path: Path) -> str:
        """What a file that was found is called below the folder: one name, however it was spelt."""
        return os.path.relpath(path, self._root)

    def _inside(self, name: str) -> Path | None:
        try:
            real = os.path.realpath(self.folder / name)
        except ValueError:  # characters that no path can have
            return None
        return Path(real) if real.startswith(self._root) else None

    def find(self, where: str, name: str) -> Path:
        """The file that `name` means.

        Raises:
            AegisError: it leads out of the folder, or there is no such file.
        """
        if name not in self._found:  # many questions are about one image
            self._found[name] = self._inside(name)
        path = self._found[name]
        if path is None:
            below = f"put the image below '{self.folder}'"
            fix = f"{below} (a link that leads elsewhere does not count)"
            raise bad(
                where,
                f"image {_show(name)} leaves the folder '{self.folder}'",
                "a path below that folder",
                fix,
            )
        if not os.path.isfile(path):
            raise bad(
                where,
                f"no image '{self.folder / name}'",
                "an existing image file",
                "correct the path, or add the file",
            )
        return path


def unique(read: Iterable[Read]) -> Iterator[Read]:
    """The same, but a name given a second time is a problem."""
    first: dict[str, str] = {}
    for entry in read:
        if isinstance(entry, Entry):
            name = str(entry.question.id)  # in predictions, 7 and "7" would be one
            if name in first:
                entry = bad(
                    entry.where,
                    f"the id '{name}' again, first in {first[name]}",
                    "each id once",
                    "rename one of them",
                )
            else:
                first[name] = entry.where
        yield entry


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and bool(value.strip()) and not _HALVES.search(value)


def _show(value: Any) -> str:
    """A wrong value, short enough for one line."""
    if value is None:
        return "missing"
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
