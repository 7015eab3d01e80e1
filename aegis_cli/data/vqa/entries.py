"""Questions as readers of files yield them: checked, and with their place in the file."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Progress
from aegis_cli.common.json_lists import CHUNK
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


_MB = 10**6
# A reader continues after a bad question: its caller decides whether to stop.
Read = Entry | AegisError
# Called while a set is read: how much of how much is done, in bytes or rows.
OnRead = Callable[[int, int], None]


def in_mb(stage: str, size: int, on_event: OnEvent) -> Callable[[int], None]:
    """A listener to the bytes that are read of a large file; a small one is read in no time."""
    total = size // _MB

    def on_read(done: int) -> None:
        if size > CHUNK:
            on_event(Progress(stage, done // _MB, total, "MB"))

    return on_read


def _no_check(_: OnEvent) -> None:
    """Find nothing wrong."""


@dataclass(frozen=True)
class Reader:
    """A set of one format.

    Attributes:
        read: yields every question, or the error in it; raises if the whole set is unusable. Its
            listener is for what happens before the first question.
        files: the files that hold the questions.
        check: raises if the whole set is unusable, as `read` may only find out at its end.
    """

    read: Callable[[OnEvent, OnRead], Iterator[Read]]
    files: tuple[Path, ...]
    check: Callable[[OnEvent], None] = _no_check


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
    answers = [answers] if type(answers) is str else answers
    distinct: Collection[Any]
    if type(answers) is list and set(map(type, answers)) == {str}:
        distinct = set(answers)  # most people answer alike
    else:
        distinct = answers = _texts(answers)
    if not distinct or not all(map(_is_text, distinct)):
        found = f"answers {_show(answers)}" if answers else "no answer"
        expected = "a list of one or more texts, what people answered"
        raise bad(where, found, expected, 'write e.g. ["red"]')
    if isinstance(name, bool) or not isinstance(name, (str, int)):
        raise bad(where, f"id {_show(name)}", "a text or a whole number", "correct the id")
    said = tuple(answers)
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


class Found(NamedTuple):
    """An image file, and its path relative to the folder: one name for all its spellings."""

    path: str
    name: str


class Inside:
    """Image paths below a folder, with symbolic links followed; no path may lead out of it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        # With a final separator: `a/bc` is not below `a/b`.
        self._root = os.path.join(os.path.realpath(folder), "")
        # By name. None: outside of the folder; False: no file.
        self._found: dict[str, Found | Literal[False] | None] = {}
        self._folders: dict[str, str] = {}  # with links followed, and a final separator

    def find(self, where: str, name: str) -> Found:
        """The file that `name` means.

        Raises:
            AegisError: it leads out of the folder, or there is no such file.
        """
        if name not in self._found:  # many questions share an image
            self._found[name] = self._plain(name) or self._resolved(name)
        found = self._found[name]
        if found is None:
            below = f"put the image below '{self.folder}'"
            fix = f"{below} (a link that leads elsewhere does not count)"
            raise bad(
                where,
                f"image {_show(name)} leaves the folder '{self.folder}'",
                "a path below that folder",
                fix,
            )
        if not found:
            raise bad(
                where,
                f"no image '{self.folder / name}'",
                "an existing image file",
                "correct the path, or add the file",
            )
        return found

    def _plain(self, name: str) -> Found | None:
        """The file if the path's last part is one and no link; else None.

        The folders of a set are few: that their links are followed once makes this the only access
        to the disk for an image.
        """
        above, slash, last = name.rpartition("/")
        if last in ("", ".", ".."):
            return None
        above += slash  # "/" and "" are two folders
        try:
            if (folder := self._folders.get(above)) is None:
                real = os.path.realpath(self.folder / above)
                folder = self._folders[above] = os.path.join(real, "")
            if not folder.startswith(self._root):
                return None
            path = folder + last
            if not stat.S_ISREG(os.lstat(path).st_mode):
                return None
        except (OSError, ValueError):  # missing, or characters that are invalid in paths
            return None
        return self._of(path)

    def _resolved(self, name: str) -> Found | Literal[False] | None:
        """The file with all links followed."""
        try:
            real = os.path.realpath(self.folder / name)
        except ValueError:
            return None
        if not real.startswith(self._root):
            return None
        return self._of(real) if os.path.isfile(real) else False

    def _of(self, path: str) -> Found:
        return Found(path, path[len(self._root) :])


def _is_text(value: Any) -> bool:
    if not isinstance(value, str) or not value or value.isspace():
        return False
    return value.isascii() or not _HALVES.search(value)


def _show(value: Any) -> str:
    """A wrong value, short enough for one line."""
    if value is None:
        return "missing"
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
