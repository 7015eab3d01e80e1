"""Conversations as questions: in lines, in lists, and in the rows of a data set."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import datasets
import numpy as np
import pytest
from samples.vqa_files import picture, write_jsonl

from aegis_cli.common.errors import AegisError
from aegis_cli.data.vqa import sets
from aegis_cli.data.vqa.images import decode

SAID = (("what color is the cube", "red"), ("how many balls are there", "two"))
_CHAT = [
    message
    for ask, answer in SAID
    for message in (
        {"role": "user", "content": [{"type": "image"}, {"type": "text", "text": ask}]},
        {"role": "assistant", "content": [{"type": "text", "text": answer}]},
    )
]
FORMS: dict[str, dict[str, Any]] = {
    "cauldron": {"texts": [{"user": ask, "assistant": answer} for ask, answer in SAID]},
    "llava": {
        "conversations": [
            turn
            for number, (ask, answer) in enumerate(SAID)
            for turn in (
                {"from": "human", "value": ask if number else f"<image>\n{ask}"},
                {"from": "gpt", "value": answer},
            )
        ]
    },
    "messages": {"messages": [{"role": "system", "content": "be brief"}, *_CHAT]},
}


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    write_jsonl(tmp_path, images=6)
    return tmp_path


def asked(path: Path, **options: Any) -> list[tuple[str, str, str, Any]]:
    source = sets.read(str(path), **options)
    assert isinstance(source, sets.Listed)
    questions = [(entry.picture.key, entry.question) for entry in source.entries]
    return [(key, one.text, one.answer, one.id) for key, one in questions]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", ["said.jsonl", "said.json"])
@pytest.mark.parametrize("shown", ["images/1.png", ["images/1.png"]], ids=["image", "images"])
def test_each_turn_is_a_question(form: str, name: str, shown: Any, pictures: Path) -> None:
    key = "image" if isinstance(shown, str) else "images"
    row = {key: shown, **FORMS[form]}
    text = json.dumps(row) + "\n" if name.endswith("l") else json.dumps([row])
    (pictures / name).write_text(text)
    place = "line 1" if name.endswith("l") else "item 1"
    assert asked(pictures / name) == [
        ("images/1.png", ask, answer, f"{place}.{number}")
        for number, (ask, answer) in enumerate(SAID, start=1)
    ]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("column", ["image", "images"])
@pytest.mark.parametrize("saved", [True, False], ids=["saved", "parquet"])
def test_rows_of_a_data_set_have_conversations(
    form: str, column: str, saved: bool, tmp_path: Path
) -> None:
    shown = [picture(i) for i in range(4)]
    several = column == "images"
    rows = {column: [[one] for one in shown] if several else shown, "id": [10, 11, 12, 13]}
    features = datasets.Features(
        {column: [datasets.Image()] if several else datasets.Image(), "id": datasets.Value("int64")}
    )
    made = datasets.Dataset.from_dict(rows, features=features)
    ((key, turns),) = FORMS[form].items()
    if form == "messages":  # a column has one form
        turns = [turn for turn in turns if turn["role"] != "system"]
    made = made.add_column(key, [turns] * 4)
    if saved:
        made.save_to_disk(tmp_path / "data")
    else:
        (tmp_path / "data").mkdir()
        made.to_parquet(tmp_path / "data" / "train-00000-of-00001.parquet")
    source = sets.read(str(tmp_path / "data"))
    assert isinstance(source, sets.Listed)
    assert [entry.question.id for entry in source.entries[:3]] == ["10.1", "10.2", "11.1"]
    assert [entry.question.text for entry in source.entries[:2]] == [ask for ask, _ in SAID]
    assert (decode(source.entries[-1].picture, None) == np.asarray(shown[-1])).all()


def test_columns_of_lists_are_conversations_too(tmp_path: Path) -> None:
    """The form in which `datasets` returns a column declared as a sequence of objects."""
    turns = FORMS["llava"]["conversations"]
    said = [{name: [turn[name] for turn in turns] for name in ("from", "value")}]
    features = datasets.Features(
        {
            "image": datasets.Image(),
            "conversations": datasets.Sequence(
                {name: datasets.Value("string") for name in ("from", "value")}
            ),
        }
    )
    rows = {"image": [picture(0)], "conversations": said}
    made = datasets.Dataset.from_dict(rows, features=features)
    made.save_to_disk(tmp_path / "data")
    assert [text for _, text, *_ in asked(tmp_path / "data")] == [ask for ask, _ in SAID]


def test_a_single_turn_keeps_the_id_and_its_source_is_its_family(pictures: Path) -> None:
    turn = {"user": "what color is it?", "assistant": "red", "source": "vqav2"}
    rows = [
        {"image": "images/0.png", "id": "a", "texts": [turn]},
        {"image": "images/1.png", "id": "b", "source": "row's", "texts": [turn | {"source": None}]},
        {"image": "images/2.png", "id": "c", "texts": [turn | {"source": None}]},
    ]
    (pictures / "said.json").write_text(json.dumps(rows))
    source = sets.read(str(pictures / "said.json"))
    assert isinstance(source, sets.Listed)
    told = [(entry.question.id, entry.question.family) for entry in source.entries]
    assert told == [("a", "vqav2"), ("b", "row's"), ("c", "all")]


def test_answers_go_before_a_conversation(pictures: Path) -> None:
    row = {"image": "images/0.png", "question": "is it red", "answer": "no", **FORMS["llava"]}
    (pictures / "said.jsonl").write_text(json.dumps(row) + "\n")
    assert [text for _, text, *_ in asked(pictures / "said.jsonl")] == ["is it red"]


def test_rows_of_several_images_are_left_out_where_bad_ones_are(tmp_path: Path) -> None:
    shown = [[picture(0)], [picture(1), picture(2)], [], [picture(3)]]
    rows = datasets.Dataset.from_dict(
        {"images": shown, "texts": [FORMS["cauldron"]["texts"]] * 4},
        features=datasets.Features(
            {
                "images": [datasets.Image()],
                "texts": [{name: datasets.Value("string") for name in ("user", "assistant")}],
            }
        ),
    )
    rows.save_to_disk(tmp_path / "data")
    with pytest.raises(AegisError, match="row 1 of .* a list of 2 images"):
        sets.read(str(tmp_path / "data"))
    source = sets.read(str(tmp_path / "data"), skip_bad=True)
    assert isinstance(source, sets.Listed)
    assert [entry.question.id for entry in source.entries] == ["0.1", "0.2", "3.1", "3.2"]
    assert [problem.found.split(": ")[1] for problem in source.problems] == [
        "a list of 2 images",
        "a list of 0 images",
    ]
    last = decode(source.entries[-1].picture, None)
    assert (last == np.asarray(picture(3))).all()


def test_a_list_of_questions_is_read_as_lines_are(pictures: Path) -> None:
    lines = [json.loads(line) for line in (pictures / "set.jsonl").read_text().splitlines()]
    (pictures / "set.json").write_text(json.dumps(lines, indent=1))
    by_line, by_item = asked(pictures / "set.jsonl"), asked(pictures / "set.json")
    assert [row[:3] for row in by_line] == [row[:3] for row in by_item]
    assert by_item[0][3] == "item 1"
