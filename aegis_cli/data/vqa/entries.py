"""Questions as readers of files yield them: checked, and with their place in the file."""

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

# Surrogates: JSON can contain them, but no tokenizer accepts them.
_HALVES = re.compile("[\ud800-\udfff]")
# The possible keys of a question's answers; the first one present is used.
ANSWERS = ("answers", "answer", "multiple_choice_answer")
OR_SKIP = ", or leave such questions out with --skip-bad (skip_bad: true in a recipe)"


@dataclass(frozen=True, slots=True)
class Entry:
    """A question, its image, and their place in the file."""

    where: str
    question: Question
    picture: Picture


# A reader continues after a bad question: its caller decides whether to stop.
Read = Entry | AegisError


@dataclass(frozen=True)
class Reader:
    """A set of one format.

    Attributes:
        read: yields every question, or the error in it; raises if the whole set is unusable.
        files: the files that hold the questions.
    """

    read: Callable[[], Iterator[Read]]
    files: tuple[Path, ...]


def bad(where: str, found: str, expected: str, fix: str) -> AegisError:
    """The error for one bad question."""
    return AegisError(f"{where}: {found}", expected, fix + OR_SKIP)


def make_question(where: str, text: Any, answers: Any, name: Any, family: str) -> Question:
    """A question that people answered.

    Args:
        answers: a list of each person's answer, or a single answer; each is a text, a whole number,
            or an object whose `answer` is one of these.

    Raises:
        AegisError: the question is no text, there are no answers, or the name is neither a text nor
            a whole number.
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
    said = tuple(map(sys.intern, answers))  # the same few words occur a million times
    return Question(family, text.strip(), reference(said).strip(), said, name)


def _texts(answers: Any) -> list[Any]:
    """The answers as a list, with whole numbers as texts."""
    if isinstance(answers, dict):  # older versions store lists of objects as columns
        answers = answers.get("answer")
    if answers is None:
        return []
    listed = answers if isinstance(answers, list) else [answers]
    said = [a.get("answer") if isinstance(a, dict) else a for a in listed]
    # In Python True is a number, but it is no person's answer.
    return [str(a) if isinstance(a, int) and not isinstance(a, bool) else a for a in said]


class Inside:
    """Image paths below a folder, with symbolic links followed; no path may lead out of it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        # With a final separator: `a/bc` is not below `a/b`.
        self._root = os.path.join(os.path.realpath(folder), "")
        self._found: dict[str, Path | None] = {}  # name -> file; None: outside of the folder

    def name(self, path: Path) -> str:
        """A found file's path relative to the folder: one name for all its spellings."""
        return os.path.relpath(path, self._root)

    def _inside(self, name: str) -> Path | None:
        try:
            real = os.path.realpath(self.folder / name)
        except ValueError:  # characters that are invalid in paths
            return None
        return Path(real) if real.startswith(self._root) else None

    def find(self, where: str, name: str) -> Path:
        """The file that `name` means.

        Raises:
            AegisError: it leads out of the folder, or there is no such file.
        """
        if name not in self._found:  # many questions share an image
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
    """The same entries, but with an error for each repeated id."""
    first: dict[str, str] = {}
    for entry in read:
        if isinstance(entry, Entry):
            name = str(entry.question.id)  # in predictions, 7 and "7" would be the same
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
