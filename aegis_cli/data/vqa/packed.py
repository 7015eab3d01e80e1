"""Questions in little memory: a set may have millions, whose objects would take gigabytes."""

from __future__ import annotations

import marshal
from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import overload

import numpy as np

from aegis_cli.common.errors import AegisError
from aegis_cli.data.vqa.entries import Entry, bad
from aegis_cli.data.vqa.images import Picture
from aegis_cli.data.vqa.questions import Question

Source = str | Path | Callable[[], bytes]

_DIGITS = 9  # most of a turn's number
_FILE = " of '"  # how a place goes on: line 7 of 'questions.jsonl'


class Entries(Sequence[Entry]):
    """The questions of a set in their order; an access makes its `Entry` anew.

    Attributes:
        images: the key of each image, in the order of their first questions.
    """

    def __init__(self, entries: Iterable[Entry] = ()) -> None:
        self._rows: list[bytes] = []
        self._image_of = array("I")  # of each row, by number
        self.images: list[str] = []
        self._numbers: dict[str, int] = {}  # of images, by key
        self._sources: list[Source] = []  # of each image's first question
        self._other: dict[int, Source] = {}  # of a row, if it is not that of the image's first
        self._ends: list[str] = []  # of places, which name the file
        self._end_numbers: dict[str, int] = {}
        self._place = "", "", -1  # the last one, and how it is packed
        for entry in entries:
            self.append(entry)

    def append(self, entry: Entry) -> None:
        """Add a question at the end. The images and groups of a set are used when it is whole."""
        question, picture = entry.question, entry.picture
        key, source = picture.key, picture.at
        image = self._numbers.get(key)
        if image is None:
            image = self._numbers[key] = len(self.images)
            self.images.append(key)
            self._sources.append(source)
        elif source is not (first := self._sources[image]) and source != first:
            self._other[len(self._rows)] = source
        if entry.where is not self._place[0]:  # the turns of a conversation have one place
            place, mark, file = entry.where.partition(_FILE)
            self._place = entry.where, place, self._end(mark + file)
        _, place, end = self._place
        answers, answer = question.answers, question.answer
        # The answer of a long text is kept once.
        said = answers.index(answer) if answer in answers else answer
        row = (place, end, question.family, question.text, said, answers, question.id)
        self._rows.append(marshal.dumps(row))
        self._image_of.append(image)

    def __len__(self) -> int:
        return len(self._rows)

    @overload
    def __getitem__(self, number: int) -> Entry: ...

    @overload
    def __getitem__(self, number: slice) -> list[Entry]: ...

    def __getitem__(self, number: int | slice) -> Entry | list[Entry]:
        numbers = range(len(self))[number]
        if isinstance(numbers, range):
            return [self._entry(each) for each in numbers]
        return self._entry(numbers)

    def __iter__(self) -> Iterator[Entry]:
        return map(self._entry, range(len(self)))

    def _entry(self, number: int) -> Entry:
        place, end, family, text, said, answers, name = marshal.loads(self._rows[number])
        answer = answers[said] if isinstance(said, int) else said
        where = place + self._ends[end]
        return Entry(
            where,
            Question(family, text, answer, answers, name),
            Picture(self.images[self._image_of[number]], where, self._source(number)),
        )

    def _end(self, text: str) -> int:
        """The number of the end of a place."""
        number = self._end_numbers.setdefault(text, len(self._ends))
        if number == len(self._ends):
            self._ends.append(text)
        return number

    def _source(self, number: int) -> Source:
        own = self._other.get(number)
        return self._sources[self._image_of[number]] if own is None else own

    # --- by image ---------------------------------------------------------------------------------

    def count(self, key: str) -> int:
        """How many questions are about an image."""
        return len(self._about(key))

    def about(self, key: str, most: int | None = None) -> list[Entry]:
        """The first questions about an image; all of them if `most` is None."""
        return [self._entry(number) for number in self._about(key)[:most].tolist()]

    def picture(self, key: str) -> Picture:
        """An image, as its last question has it."""
        return self._entry(int(self._about(key)[-1])).picture

    def _about(self, key: str) -> np.ndarray:
        """The numbers of the questions about an image."""
        order, starts = self._by_image
        image = self._numbers[key]
        return order[starts[image] : starts[image + 1]]

    @cached_property
    def _by_image(self) -> tuple[np.ndarray, np.ndarray]:
        """The numbers of all questions, those of an image together; where each image's begin."""
        image_of = np.array(self._image_of, dtype=np.uint32)
        order = np.argsort(image_of, kind="stable").astype(np.uint32)
        return order, np.searchsorted(image_of[order], np.arange(len(self.images) + 1))


class Ids:
    """The ids of packed questions.

    Those of a conversation, `x.1`, `x.2` and so on, take the room of one.
    """

    def __init__(self, entries: Entries) -> None:
        self._entries = entries
        self._single: dict[str, int] = {}  # the question that has an id
        self._turns: dict[str, int] = {}  # the one that has `x.1`, if the next one has `x.2`, ...

    def add(self, entry: Entry) -> AegisError | None:
        """Take the id of the question that is packed next, or return the error if it is taken."""
        name = str(entry.question.id)  # in predictions, 7 and "7" would be the same
        number = len(self._entries)
        first = self._single.get(name)
        base, dot, last = name.rpartition(".")
        if first is None and dot and (turn := _number(last)):
            begun = self._turns.setdefault(base, number) if turn == 1 else self._turns.get(base)
            if begun is not None:
                at = begun + turn - 1
                if at == number:
                    return None
                if at < number and str(self._entries[at].question.id) == name:
                    first = at
        if first is None:
            self._single[name] = number
            return None
        return bad(
            entry.where,
            f"the id '{name}' again, first in {self._entries[first].where}",
            "each id once",
            "rename one of them",
        )


def _number(text: str) -> int:
    """The number of a turn as it is written in an id; 0 if it is none."""
    if len(text) > _DIGITS or not (text.isascii() and text.isdigit()) or text[0] == "0":
        return 0
    return int(text)
