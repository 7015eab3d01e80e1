"""Question sets of every form, with all that may be wrong with a question; always the same."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

from samples.vqa_files import picture

_FOLDERS = ("a", "b/c", "b/d e")
_WORDS = ("what", "color", "is", "it", "red", "Blue ", "two", "a", "cafés", "日本", "the", "on 🙂")
_MOST = 5  # answers of people
# Images that are refused, and other spellings of one that is not.
_IMAGES: tuple[Any, ...] = (
    *(
        "none.png",
        "a",
        "../other.png",
        "/etc/hostname",
        "a\0b.png",
        "\ud800.png",
        "",
        ".",
        "x" * 300,
    ),
    *("link.png", "out.png", "loop.png", "back/0.png", "a/../a/0.png", ".//a//0.png", "a/./0.png"),
    *(7, None, ["a/0.png"], ["a/0.png", "a/3.png"], []),
)
_ANSWERS: tuple[Any, ...] = (
    *("red", " red ", "", 3, True, 2.5, None, [], ["red", ""], ["red", "Red.", "two", "2", "two"]),
    *({"answer": ["red", "blue"]}, {"answer": "two"}, [{"answer": "red", "id": 1}, {"answer": 2}]),
    *([{"no": 1}], ["\ud800"], "\udfff", ["a", "the", "a"], [[1]]),
)
_IDS: tuple[Any, ...] = (
    0,
    "0",
    "line 5",
    "item 4.2",
    "7.1",
    "7.2",
    "7.02",
    "x.",
    ".1",
    True,
    [1],
    1.5,
)


class Forms:
    """Writes sets of each form into a folder that has their images."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.draw = folder, random.Random(3)
        self.images: list[str] = []
        for number in range(40):
            name = f"{_FOLDERS[number % 3]}/{number}.png"
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            picture(number, 8, 8).save(folder / name)
            self.images.append(name)
        picture(0).save(folder.parent / "other.png")
        (folder / "link.png").symlink_to("a/0.png")
        (folder / "out.png").symlink_to(folder.parent / "other.png")
        (folder / "loop.png").symlink_to("loop.png")
        (folder / "back").symlink_to("a")

    def lines(self, bad: bool) -> Path:
        """A question or a conversation per line."""
        rows = [self._row(bad) for _ in range(300)]
        texts = [json.dumps(row, ensure_ascii=number % 2 == 0) for number, row in enumerate(rows)]
        if bad:
            texts[20:20] = ["", "{", "[]", "[" * 100_000, " \t", "3", '{"image": "a/0.png"}']
        path = self.folder / "set.jsonl"
        data = "\n".join(texts).encode("utf-8", "surrogatepass")
        path.write_bytes(b"\xef\xbb\xbf" + data + (b"\n\xff{}" if bad else b""))
        return path

    def items(self, bad: bool) -> Path:
        """The same as a list in JSON."""
        rows = [self._row(bad) for _ in range(300)]
        extra = [[], 3, "text", None] if bad else []
        path = self.folder / "set.json"
        text = json.dumps([*rows, *extra], indent=self.draw.choice([None, 1]), ensure_ascii=False)
        path.write_bytes(text.encode("utf-8", "surrogatepass"))
        return path

    def official(self, bad: bool) -> Path:
        """The files of VQAv2."""
        numbers = [9 * number for number in range(30)]
        (self.folder / "val2014").mkdir(exist_ok=True)
        for number in numbers:
            place = self.folder / "val2014" if number % 2 else self.folder
            picture(number, 8, 8).save(place / f"COCO_val2014_{number:012d}.jpg")
        questions, annotations = [], []
        for number in range(200):
            ids = {"image_id": self.draw.choice(numbers), "question_id": number}
            questions.append({**ids, "question": self._text()})
            said = [{"answer": self._text(2), "answer_id": i} for i in range(10)]
            kind = self.draw.choice(["other", "number", "", None])
            annotations.append({**ids, "answers": said, "answer_type": kind})
        if bad:
            questions[5], questions[9] = {"question_id": 5.5}, "no row"
            questions[20]["image_id"], questions[21]["image_id"] = 10**6, "9"
            annotations[20]["image_id"], annotations[21]["image_id"] = 10**6, "9"
            annotations[30]["image_id"] = -1
            annotations[40:40] = [annotations[3], {"question_id": None}, [], {"question_id": 999}]
            for number, answers in enumerate(_ANSWERS, start=60):
                annotations[number]["answers"] = answers
        self.draw.shuffle(annotations)
        about = {"data_subtype": "val2014", "info": {"questions": [1]}}
        path = self.folder / "v2_OpenEnded_mscoco_val2014_questions.json"
        path.write_text(json.dumps({"questions": questions, **about}))
        beside = self.folder / "v2_mscoco_val2014_annotations.json"
        beside.write_text(json.dumps({**about, "annotations": annotations}, indent=1))
        return path

    def saved(self, bad: bool) -> Path:
        """A data set of Hugging Face, some of whose images are beside it."""
        return self._hub(bad, self._asked_rows(bad), "saved")

    def chats(self, bad: bool) -> Path:
        """One of conversations about lists of images."""
        rows = []
        for number in range(120):
            shown = [self._stored(number % 37)]
            if bad and number % 10 == 3:
                shown = shown * (number % 3)
            turns = [
                {"user": self._text(), "assistant": self._text(2), "source": "s"}
                for _ in range(self.draw.randint(0 if bad else 1, 4))
            ]
            rows.append({"images": shown, "texts": turns, "id": f"r{number // (2 if bad else 1)}"})
        return self._hub(bad, rows, "chats")

    def _asked_rows(self, bad: bool) -> list[dict[str, Any]]:
        rows = []
        for number in range(250):
            name = self.draw.choice(self.images)
            shown = {"bytes": None, "path": name} if number % 3 else self._stored(number % 23)
            if bad and number % 20 == 7:
                shown = self.draw.choice([{"bytes": b"", "path": "none.png"}, {"path": "../o.png"}])
            if bad and number % 20 == 8:
                shown = {"bytes": None, "path": None}
            answers = [self._text(1) for _ in range(self.draw.randint(0 if bad else 1, 3))]
            image_id = None if number % 5 else number % 11
            row = {"image": shown, "question": self._text(), "answers": answers}
            rows.append(row | {"image_id": image_id, "answer_type": "kind", "unused": [number]})
        return rows

    def _hub(self, bad: bool, rows: list[dict[str, Any]], name: str) -> Path:
        import pyarrow
        from pyarrow import parquet

        shown = pyarrow.struct([("bytes", pyarrow.binary()), ("path", pyarrow.string())])
        types = {"image": shown, "images": pyarrow.list_(shown)}
        columns = {
            key: pyarrow.array([row[key] for row in rows], type=types.get(key)) for key in rows[0]
        }
        path = self.folder / f"{name}.parquet"
        parquet.write_table(pyarrow.table(columns), path, row_group_size=70)
        return path

    def _stored(self, number: int) -> dict[str, Any]:
        return {"bytes": b"image %d" % number, "path": "gone.png"}

    def _text(self, most: int = 6) -> str:
        return " ".join(self.draw.choices(_WORDS, k=self.draw.randint(1, most)))

    def _row(self, bad: bool) -> dict[str, Any]:
        """A line's content; of `bad` ones every third has something odd."""
        odd = bad and self.draw.random() < 0.4
        row: dict[str, Any] = {"image": self.draw.choice(self.images)}
        if self.draw.random() < 0.5:
            row |= self._conversation(odd)
        else:
            row["question"] = self._text()
            answers = [self._text(2) for _ in range(self.draw.randint(1, _MOST))]
            row["answers"] = self.draw.choice(_ANSWERS) if odd else answers
        if odd and self.draw.random() < 0.5:
            shown = self.draw.choice(_IMAGES)
            row |= {"images": shown} if isinstance(shown, list) else {"image": shown}
        if odd and self.draw.random() < 0.5:
            row["id"] = self.draw.choice(_IDS)
        if odd and self.draw.random() < 0.2:
            del row[self.draw.choice(list(row))]
        return row

    def _conversation(self, odd: bool) -> dict[str, Any]:
        form: Callable[[str, str], list[dict[str, Any]]] = self.draw.choice([_llava, _chat, _users])
        turns = []
        for number in range(self.draw.randint(1, 4)):
            ask = self._text() + ("" if number else " \n<image> \n" + self._text())
            turns += form(ask, self._text(3))
        if odd:
            turns = self.draw.choice(
                [
                    [],
                    turns[:-1],
                    [{"from": "system", "value": "be brief"}, *turns],
                    [*turns, *_llava("x", " ")],
                    [{"from": "human"}, {"from": "gpt", "value": 3}],
                    [3],
                    {"from": ["human", "gpt"], "value": ["what", "red"]},
                    [{**turn, "extra": 1} for turn in turns],
                ]
            )
        key = self.draw.choice(["conversations", "messages", "texts"])
        return {key: turns, "source": self.draw.choice(["s", None, 3])}


def _llava(ask: str, answer: str) -> list[dict[str, Any]]:
    return [{"from": "human", "value": ask}, {"from": "gpt", "value": answer}]


def _chat(ask: str, answer: str) -> list[dict[str, Any]]:
    pieces = [{"type": "image"}, {"type": "text", "text": ask}]
    return [{"role": "user", "content": pieces}, {"role": "assistant", "content": answer}]


def _users(ask: str, answer: str) -> list[dict[str, Any]]:
    return [{"user": ask, "assistant": answer, "source": "t"}]
