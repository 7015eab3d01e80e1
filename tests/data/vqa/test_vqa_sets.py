"""Question sets in files: what is read, each image's part, and what is decoded when."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import pickle
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import datasets
import numpy as np
import pyarrow
import pytest
import torch
from PIL import Image
from pyarrow import parquet
from samples.small_run import recipe
from samples.tiny import make_tiny
from samples.vqa_files import (
    ASKED,
    hub_rows,
    official_pair,
    picture,
    row,
    write_jsonl,
    write_official,
)

from aegis_cli.common import devices
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, Warned, ignore
from aegis_cli.common.files import sha256_file
from aegis_cli.data.batch import Asked, Share
from aegis_cli.data.vqa import equal_files, images, sets
from aegis_cli.data.vqa.dataset import VQASet, load_scenes
from aegis_cli.data.vqa.images import Picture, Pictures, decode
from aegis_cli.data.vqa.metrics import grade
from aegis_cli.methods.base import Pass
from aegis_cli.models.backbones.embedded import MAX_TEXT
from aegis_cli.recipes import Cotrain
from aegis_cli.training import assemble

IMAGES = 24
PARTS = ("anchor", "validation", "probe")
NAMES = [f"images/{i}.png" for i in range(IMAGES)]


@pytest.fixture(scope="module")
def lines(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_jsonl(tmp_path_factory.mktemp("lines"), IMAGES)


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of the images that were decoded, in order."""
    seen: list[str] = []

    def counted(one: Picture, size: int | None) -> np.ndarray:
        seen.append(one.key)
        return decode(one, size)

    monkeypatch.setattr(images, "decode", counted)
    return seen


def asked_about(made: VQASet) -> list[tuple[str, str]]:
    """Image and text of each question, in order."""
    return [
        (made.images.pictures[i].key, q.text)
        for i, q in zip(made.image_of, made.questions, strict=True)
    ]


# --- formats --------------------------------------------------------------------------------------


def test_lines_of_json(lines: Path) -> None:
    source = sets.read(str(lines))
    assert [(e.picture.key, e.question.text, list(e.question.answers)) for e in source.entries] == [
        (name, text, answers) for name in NAMES for text, answers in ASKED
    ]
    assert [e.question.id for e in source.entries[:2]] == ["line 1", "line 2"]
    assert {(e.question.answer, e.question.family) for e in source.entries} == {
        ("red", "all"),
        ("two", "all"),
    }
    assert (
        source.skipped == 0
        and source.name == "set.jsonl"
        and list(source.sha256) == ["vqa/set.jsonl"]
    )


def test_a_set_has_one_name_also_from_within_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "asked").mkdir()
    datasets.Dataset.from_dict(hub_rows(6)).save_to_disk(tmp_path / "asked")
    known = sets.read(str(tmp_path / "asked")).name
    assert known == "asked"
    monkeypatch.chdir(tmp_path / "asked")
    assert sets.read(".").name == sets.read("../asked").name == known


def test_an_image_has_one_name_however_it_is_spelt(tmp_path: Path) -> None:
    """Another spelling of a path is not another image, and must not get another part."""
    write_jsonl(tmp_path, 2)
    (tmp_path / "images/link.png").symlink_to("0.png")
    spellings = [
        "images/0.png",
        "./images/0.png",
        "images//0.png",
        "images/../images/0.png",
        "images/link.png",
    ]
    path = tmp_path / "spelt.jsonl"
    path.write_text(
        "\ufeff" + "\n\n".join(json.dumps(row(name, id=i)) for i, name in enumerate(spellings))
    )
    source = sets.read(str(path))
    assert [e.question.id for e in source.entries] == [0, 1, 2, 3, 4] and {
        e.picture.key for e in source.entries
    } == {"images/0.png"}


@pytest.mark.parametrize("key", ["answers", "answer", "multiple_choice_answer"])
def test_lines_may_call_answers_as_a_hugging_face_data_set_does(key: str, tmp_path: Path) -> None:
    write_jsonl(tmp_path, 1)
    line = json.dumps(row("images/0.png", answers=None) | {key: "red"})
    (tmp_path / "own.jsonl").write_text(line)
    (entry,) = sets.read(str(tmp_path / "own.jsonl")).entries
    assert entry.question.answers == ("red",)


@pytest.mark.parametrize(("release", "own_folder"), [("v2_", True), ("", False)])
def test_the_official_pair_as_it_is_distributed(
    release: str, own_folder: bool, tmp_path: Path
) -> None:
    path = write_official(tmp_path, release, own_folder, images=3)
    for given in (path, tmp_path):
        source = sets.read(str(given))
        assert [e.question.id for e in source.entries] == [
            q["question_id"] for q in official_pair(3)[0]["questions"]
        ]
        assert {
            (e.question.family, len(e.question.answers), e.question.answer) for e in source.entries
        } == {
            ("other", 10, "red"),
            ("number", 10, "two"),
        }
        assert (
            source.entries[0].picture.key == "COCO_val2014_000000262148.jpg"
            and len(source.sha256) == 2
        )
        assert decode(source.entries[0].picture, None).shape == (30, 40, 3)


_LISTS = [
    [{"answer": a, "answer_id": i} for i, a in enumerate(ASKED[n % 2][1])]
    for n in range(2 * IMAGES)
]
_KEYS = {
    "image_id": [i // 2 for i in range(2 * IMAGES)],
    "question_id": range(100, 100 + 2 * IMAGES),
    "answer_type": ["other"] * 2 * IMAGES,
}


@pytest.mark.parametrize("form", ["saved", "parquet"])
@pytest.mark.parametrize(
    ("columns", "answers"),
    [
        ({}, [("red", "red", "blue"), ("two",)]),
        ({"answers": _LISTS, **_KEYS}, [("red", "red", "blue"), ("two",)]),
        ({"answers": None, "answer": ["red", "two"] * IMAGES}, [("red",), ("two",)]),
        (
            {"answers": None, "multiple_choice_answer": ["red", "two"] * IMAGES},
            [("red",), ("two",)],
        ),
    ],
)
def test_a_data_set_of_hugging_face(
    form: str,
    columns: dict,
    answers: list[tuple[str, ...]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(datasets.config, "HF_DATASETS_CACHE", str(tmp_path / "cache"))
    rows, folder = datasets.Dataset.from_dict(hub_rows(IMAGES, **columns)), tmp_path / "data"
    if form == "saved":
        rows.save_to_disk(str(folder))
    else:
        (folder / "data").mkdir(parents=True)
        rows.to_parquet(str(folder / "data" / "validation-00000-of-00001.parquet"))
    source = sets.read(str(folder))
    assert [e.question.answers for e in source.entries] == answers * IMAGES
    assert [e.question.id for e in source.entries] == list(
        columns.get("question_id", range(2 * IMAGES))
    )
    keys = [e.picture.key for e in source.entries]
    assert (
        keys[::2] == keys[1::2] and len(set(keys)) == IMAGES
    )  # questions about one image are known as such
    assert np.array_equal(decode(source.entries[5].picture, None), np.asarray(picture(2, 32)))
    # Chosen questions are sent to other processes, which read the images themselves.
    asked = source.choose("probe", 4, 0)
    travelled = pickle.loads(pickle.dumps(asked))
    for one, other in zip(travelled.images[:], asked.images[:], strict=True):
        assert np.array_equal(one, other)


def test_several_splits_are_refused_with_the_way_to_one(tmp_path: Path) -> None:
    rows = datasets.Dataset.from_dict(hub_rows(3))
    datasets.DatasetDict({"train": rows, "validation": rows}).save_to_disk(str(tmp_path / "saved"))
    with pytest.raises(AegisError, match="2 splits.*train, validation") as caught:
        sets.read(str(tmp_path / "saved"))
    one = f"{tmp_path / 'saved'}#validation"
    assert caught.value.fix == f"name it after a #: --vqa '{one}'"
    assert len(sets.read(one).entries) == 6 and sets.read(one).name == "saved-validation"
    datasets.DatasetDict({"train": rows}).save_to_disk(str(tmp_path / "alone"))
    assert len(sets.read(str(tmp_path / "alone")).entries) == 6


@pytest.mark.parametrize(
    ("names", "splits"),
    [
        (("train-00000-of-00001", "test-00000-of-00001"), ("test", "train")),
        (
            ("train-00000-of-00001-2a1df75c6bce91ab", "test-00000-of-00001-6cbff2a3b3c5c0d1"),
            ("test", "train"),
        ),
        (("train", "test"), ("test", "train")),
        (("train2014", "val2014"), ("train2014", "val2014")),
        (("0000", "test"), ("numbered files", "test")),
        (("train-00000-of-00002", "train-00001-of-00002"), ()),
        (("train-00000-of-00002-2a1df75c6bce91ab", "train-00001-of-00002-6cbff2a3b3c5c0d1"), ()),
        (("0000", "0001"), ()),
        (("part_0", "part_1"), ()),
    ],
)
def test_parquet_files_tell_their_split_by_their_names(
    names: tuple[str, str], splits: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(datasets.config, "HF_DATASETS_CACHE", str(tmp_path / "cache"))
    for name in names:
        datasets.Dataset.from_dict(hub_rows(3)).to_parquet(str(tmp_path / f"{name}.parquet"))
    if not splits:
        assert len(sets.read(str(tmp_path)).entries) == 12
        return
    with pytest.raises(AegisError, match=f"2 splits in .*: {', '.join(splits)}"):
        sets.read(str(tmp_path))
    for split in splits:
        assert len(sets.read(f"{tmp_path}#{split}").entries) == 6


@pytest.mark.parametrize(
    ("form", "split", "says"),
    [
        ("saved", "none", "no split 'none' in '.*set'"),
        ("alone", "train", "no split 'train' in '.*set', which is a single split without a name"),
        ("parquet", "val", "no split 'val' in '.*set'"),
        (
            "jsonl",
            "train",
            "the split 'train' of '.*set.jsonl', which is not a Hugging Face data set",
        ),
    ],
)
def test_a_split_that_is_not_there(
    form: str, split: str, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(datasets.config, "HF_DATASETS_CACHE", str(tmp_path / "cache"))
    rows, path = datasets.Dataset.from_dict(hub_rows(3)), tmp_path / "set"
    if form == "saved":
        datasets.DatasetDict({"train": rows, "validation": rows}).save_to_disk(str(path))
    elif form == "alone":
        rows.save_to_disk(str(path))
    elif form == "parquet":
        path.mkdir()
        rows.to_parquet(str(path / "validation-00000-of-00001.parquet"))
    else:
        path = write_jsonl(tmp_path, name="set.jsonl")
    with pytest.raises(AegisError, match=says):
        sets.read(f"{path}#{split}")


def test_a_path_may_have_a_number_sign(tmp_path: Path) -> None:
    path, rows = tmp_path / "set#1", datasets.Dataset.from_dict(hub_rows(3))
    rows.save_to_disk(str(path))
    assert len(sets.read(str(path)).entries) == 6
    datasets.DatasetDict({"train": rows, "test": rows}).save_to_disk(str(tmp_path / "set#2"))
    assert len(sets.read(f"{tmp_path / 'set#2'}#test").entries) == 6


@pytest.mark.parametrize("name", ["scenes", "easy-vqa"])
def test_the_sets_that_ship_have_no_splits(name: str) -> None:
    with pytest.raises(AegisError, match=f"the split 'train' of '{name}'"):
        sets.read(f"{name}#train")


@pytest.mark.parametrize("name", ["data-00000-of-00001.arrow", "dataset_info.json"])
def test_a_pipe_in_a_saved_data_set_is_refused_at_once(name: str, tmp_path: Path) -> None:
    import datasets

    rows = datasets.Dataset.from_dict({"question": ["a"], "answer": ["b"], "image": ["c"]})
    rows.save_to_disk(str(tmp_path / "saved"))
    (tmp_path / "saved" / name).unlink()
    os.mkfifo(tmp_path / "saved" / name)
    with pytest.raises(AegisError, match="is a pipe"):
        sets.read(str(tmp_path / "saved"))


def test_a_saved_data_set_without_its_splits(tmp_path: Path) -> None:
    """What is beside it is another set."""
    datasets.Dataset.from_dict(hub_rows(3)).to_parquet(str(tmp_path / "train.parquet"))
    (tmp_path / "saved").mkdir()
    (tmp_path / "saved" / "dataset_dict.json").write_text('{"splits": ["train"]}')
    with pytest.raises(AegisError, match="no split in '.*saved'"):
        sets.read(str(tmp_path / "saved"))


# --- parts ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["lines", "scenes"])
def test_questions_are_asked_as_is_said(name: str, lines: Path) -> None:
    vqa = str(lines) if name == "lines" else name
    plain = sets.read(vqa).choose("probe", 7, 0)
    asked = sets.read(vqa, ask="{} Answer briefly.").choose("probe", 7, 0)
    assert [q.text for q in asked.questions] == [
        f"{q.text} Answer briefly." for q in plain.questions
    ]
    assert [q.answer for q in asked.questions] == [q.answer for q in plain.questions]
    assert sets.read(vqa, ask="{}").choose("probe", 7, 0).questions == plain.questions


def test_no_image_serves_two_purposes(lines: Path) -> None:
    source = sets.read(str(lines))
    chosen = [
        {name for seed in range(4) for name, _ in asked_about(source.choose(part, 1000, seed))}
        for part in PARTS
    ]
    assert sum(map(len, chosen)) == len(set().union(*chosen)) == IMAGES
    assert {name for name, _ in asked_about(source.choose("train", 1000, 3))} == chosen[
        0
    ]  # what co-training may see


def copied_across(folder: Path, part: str, of: str) -> tuple[Path, str, str]:
    """Questions whose last image is a copy, in `part`, of an image of another part, `of`."""
    path = write_jsonl(folder, IMAGES)
    source = next(name for name in NAMES if sets.share(name) in sets.PARTS[of])
    copy = next(
        name
        for name in (f"images/copy{i}.png" for i in range(100))
        if sets.share(name) in sets.PARTS[part]
    )
    (folder / copy).write_bytes((folder / source).read_bytes())
    with path.open("a") as lines:
        lines.write(json.dumps(row(copy)) + "\n")
    return path, source, copy


@pytest.mark.parametrize(
    ("part", "of"), [("probe", "anchor"), ("probe", "validation"), ("validation", "anchor")]
)
def test_a_held_out_picture_under_another_name_among_those_to_learn_from_is_told(
    part: str, of: str, tmp_path: Path
) -> None:
    path, source, copy = copied_across(tmp_path, part, of)
    heard: list[Event] = []
    asked = sets.read(str(path)).choose(part, 1000, 0, on_event=heard.append)
    (told,) = [event.text for event in heard if isinstance(event, Warned)]
    assert told.startswith(f"1 of the {len(asked.images)} images of 'set.jsonl'")
    assert f"'{copy}' is '{source}'" in told


@pytest.mark.parametrize(("part", "of"), [("anchor", "probe"), ("probe", "probe")])
def test_pictures_under_two_names_that_no_figure_relies_on_are_not_told(
    part: str, of: str, tmp_path: Path
) -> None:
    """The probe warns about data used for training; a part may hold a picture twice."""
    path, *_ = copied_across(tmp_path, part, of)
    heard: list[Event] = []
    sets.read(str(path)).choose(part, 1000, 0, on_event=heard.append)
    assert not [event for event in heard if isinstance(event, Warned)]


def test_only_files_of_one_size_and_one_end_are_read_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    contents = {
        "a": b"x" * 9000,
        "b": b"y" + b"x" * 8999,  # another beginning
        "c": b"x" * 8999 + b"y",  # another end
        "d": b"x" * 9001,  # another size
        "e": b"x" * 9000,
    }
    shown = {}
    for name, data in contents.items():
        (tmp_path / name).write_bytes(data)
        shown[name] = Picture(name, name, tmp_path / name)
    shown["gone"] = Picture("gone", "gone", tmp_path / "gone")
    shown["row"] = Picture("row", "row", lambda: b"x" * 9000)
    read: list[str] = []

    def sha256(path: Path) -> str:
        read.append(path.name)
        return sha256_file(path)

    monkeypatch.setattr(equal_files, "sha256_file", sha256)
    held_out, others = [shown["a"], shown["c"]], [shown[n] for n in ("gone", "row", "b", "d", "e")]
    assert equal_files.shared(held_out, others, ignore) == [(shown["a"], shown["e"])]
    assert read == ["a", "b", "e"]


def test_parts_have_the_shares_that_are_told() -> None:
    tenths = np.bincount(
        [sets.share(f"COCO_val2014_{i:012d}.jpg") for i in range(20_000)], minlength=10
    )
    assert tenths.sum() == 20_000 and abs(tenths / 20_000 - 0.1).max() < 0.01
    assert [len(sets.PARTS[part]) for part in (*PARTS, "train")] == [4, 1, 5, 4]


@pytest.mark.parametrize("part", ["anchor", "probe"])
def test_a_longer_set_begins_with_the_shorter_one(lines: Path, part: str) -> None:
    source = sets.read(str(lines))
    whole = asked_about(source.choose(part, 1000, 5))
    for count in range(1, len(whole) + 1):
        assert asked_about(source.choose(part, count, 5)) == whole[:count]
    assert whole != asked_about(source.choose(part, 1000, 6)) and sorted(whole) == sorted(
        asked_about(source.choose(part, 1000, 6))
    )
    names = [name for name, _ in whole]
    assert names[::2] == names[1::2]  # side by side


def test_what_a_model_refuses_beside_its_image_is_left_out_where_bad_questions_are(
    lines: Path,
) -> None:
    seen: list[str] = []

    def check(question: str, answer: str, image: torch.Tensor | None = None) -> None:
        seen.append(question)
        if image is not None and image.shape[1] > 40:
            raise AegisError("a wide image", "a narrow one", "leave it out")

    whole = sets.read(str(lines), ask="{} say").choose("probe", 1000, 0, [check])
    assert all(question.endswith(" say") for question in seen)  # as the model will read it
    wide = [image.shape[1] > 40 for image in whole.images[whole.image_of]]
    assert any(wide) and not all(wide)
    rest = sets.read(str(lines), skip_bad=True).choose("probe", 1000, 0, [check])
    assert rest.skipped == sum(wide) and len(rest.questions) == len(wide) - sum(wide)


@pytest.mark.parametrize("skip_bad", [False, True])
def test_a_part_without_an_image_is_an_error(skip_bad: bool, tmp_path: Path) -> None:
    source = sets.read(str(write_jsonl(tmp_path, 1)), skip_bad)
    part = next(part for part in PARTS if sets.share("images/0.png") not in sets.PARTS[part])
    with pytest.raises(
        AegisError, match=f"no usable question for the {part} among those of 1 images"
    ) as caught:
        source.choose(part, 10, 0)
    assert (
        ("without --skip-bad" in caught.value.fix) == ("left out" in caught.value.found) == skip_bad
    )


def test_cotraining_reads_the_anchors_images(lines: Path, decoded: list[str]) -> None:
    settings = recipe("unused", methods=("cotrain",))
    settings = dataclasses.replace(
        settings,
        train=dataclasses.replace(settings.train, method="cotrain"),
        cotrain=Cotrain(vqa=str(lines), questions=100, batch_size=50),
    )
    model = make_tiny()
    loss_of = assemble._vqa_loss(model, settings, sets.read(str(lines)), lambda _: None)
    loss = loss_of(Pass(0, None, (), torch.empty(0), torch.empty(0)))
    assert torch.isfinite(loss) and loss.requires_grad
    assert set(decoded) == {name for name in NAMES if sets.share(name) in sets.PARTS["anchor"]}


@pytest.mark.parametrize("shares", [1, 2])
def test_cotraining_for_a_gpu_has_its_next_questions_ready_and_they_are_the_same(
    shares: int, lines: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = recipe("unused", methods=("cotrain",))
    settings = dataclasses.replace(
        settings,
        train=dataclasses.replace(settings.train, method="cotrain"),
        cotrain=Cotrain(vqa=str(lines), questions=100, batch_size=2),
    )
    model, found = make_tiny(), []
    prepared: list[str] = []
    monkeypatch.setattr(
        model, "prepare_answers", lambda *_: prepared.append(threading.current_thread().name)
    )
    for waits in (False, True):
        monkeypatch.setattr(devices, "reading_stalls", lambda _, waits=waits: waits)
        loss_of = assemble._vqa_loss(model, settings, sets.read(str(lines)), lambda _: None)
        # A resumed run starts anywhere.
        places = [(step, Share(i, shares)) for step in (5, 6, 7, 0, 1) for i in range(shares)]
        each = [Pass(n, None, (), torch.empty(0), torch.empty(0), None, own) for n, own in places]
        found.append([loss_of(seen).item() for seen in each])
    assert found[0] == found[1] and len(set(found[0])) > 1
    # Steps 5 to 8 and 0 to 2; the last of each sequence is not used. The training prepares none.
    deadline = time.monotonic() + 20
    while len(prepared) < 7 * shares and time.monotonic() < deadline:
        time.sleep(0.01)
    assert len(prepared) == 7 * shares
    assert all(name.startswith("prefetch") for name in prepared)


def test_a_picture_beside_a_data_set_that_changes_is_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As for a file of lines; a set that holds its pictures itself changes with its own file."""
    monkeypatch.setattr(datasets.config, "HF_DATASETS_CACHE", str(tmp_path / "cache"))
    picture(0).save(tmp_path / "0.png")
    stored = io.BytesIO()
    picture(1).save(stored, "PNG")
    images = [{"bytes": None, "path": "0.png"}, {"bytes": stored.getvalue(), "path": "gone.png"}]
    rows = {
        "image": images,
        "question": [text for text, _ in ASKED],
        "answers": [answers for _, answers in ASKED],
    }
    parquet.write_table(pyarrow.table(rows), tmp_path / "set.parquet")
    before = sets.read(str(tmp_path / "set.parquet"))
    assert [decode(e.picture, None).shape for e in before.entries] == [(30, 40, 3)] * 2
    picture(2, 41).save(tmp_path / "0.png")
    assert sets.read(str(tmp_path / "set.parquet")).state != before.state
    picture(0).save(tmp_path / "0.png")
    (tmp_path / "gone.png").write_bytes(b"")  # which is never read
    times = [e.picture.source.stat() for e in before.entries if isinstance(e.picture.source, Path)]
    assert len(times) == 1


# --- images ---------------------------------------------------------------------------------------


def test_an_image_is_decoded_once_a_pass_and_not_before(lines: Path, decoded: list[str]) -> None:
    source = sets.read(str(lines))
    for size in (3, 1, 1000):  # a batch may end between an image's questions
        decoded.clear()
        made = source.choose("probe", 1000, 0).sized(64)
        assert decoded == []
        shown = np.concatenate([batch for batch, _ in made.batches(size)])
        assert len(decoded) == len(set(decoded)) == len(made.images)
        assert np.array_equal(
            shown, np.stack([decode(made.images.pictures[i], 64) for i in made.image_of])
        )


def test_images_keep_their_sizes_for_a_backbone_that_takes_any(lines: Path) -> None:
    made = sets.read(str(lines)).choose("probe", 8, 0)
    shapes: list[tuple[int, ...]] = []

    def answers(batches: Iterator[Asked]) -> Iterator[tuple[list[str], torch.Tensor]]:
        for pictures, texts, _ in batches:
            shapes.extend(tuple(p.shape) for p in pictures)
            yield ["The red"] * len(texts), -torch.ones(len(texts))

    rows = grade(answers, made, 3)
    assert shapes == [
        (30, 30 + int(Path(made.images.pictures[i].key).stem), 3) for i in made.image_of
    ]
    assert len(set(shapes)) > 1 and [g.image for g in rows] == made.image_of.tolist()
    assert [(g.correct, g.soft) for g in rows] == [
        (True, pytest.approx(1 / 3 * 2 / 3 + 2 / 3 / 3)) if q.answer == "red" else (False, 0.0)
        for q in made.questions
    ]


def stored(image: Image.Image, format: str = "PNG", **options: object) -> Picture:
    file = io.BytesIO()
    image.save(file, format=format, **options)
    return Picture("x", "here", file.getvalue)


@pytest.mark.parametrize(
    ("width", "height"), [(64, 64), (200, 100), (30, 90), (640, 480), (1, 500)]
)
def test_resizing_distorts_and_cuts_off_nothing(width: int, height: int) -> None:
    """A white image: its white part keeps the proportions, in the middle of grey."""
    pixels = decode(stored(Image.new("RGB", (width, height), "white")), 64)
    white = (pixels == 255).all(-1)
    rows, columns = np.flatnonzero(white.any(1)), np.flatnonzero(white.any(0))
    assert (
        pixels.shape == (64, 64, 3)
        and white[np.ix_(rows, columns)].all()
        and (pixels[~white] == 128).all()
    )
    scale = 64 / max(width, height)
    assert (len(columns), len(rows)) == (
        max(1, round(width * scale)),
        max(1, round(height * scale)),
    )
    for found in (rows, columns):
        assert abs(found[0] - (63 - found[-1])) <= 1


def test_an_image_of_the_right_size_is_untouched() -> None:
    image = picture(3, 64, 64)
    assert np.array_equal(decode(stored(image), 64), np.asarray(image))


def test_colour_modes_and_orientation() -> None:
    grey = np.asarray(picture(1).convert("L"))
    assert np.array_equal(
        decode(stored(picture(1).convert("L")), None), np.repeat(grey[..., None], 3, axis=-1)
    )
    assert decode(stored(picture(1).convert("RGBA")), None).shape == (30, 40, 3)
    turned = Image.Exif()
    turned[0x0112] = 6  # to be shown rotated by 90 degrees clockwise
    upright = decode(stored(picture(1), exif=turned), None)
    assert np.array_equal(upright, np.rot90(np.asarray(picture(1)), -1))


def test_sizes_do_not_mix() -> None:
    pictures = Pictures([stored(picture(1))])
    assert pictures.sized(32)[np.array([0, 0])].shape == (2, 32, 32, 3)
    assert pictures.sized(32).sized(16)[:1].shape == (1, 16, 16, 3)
    assert [image.shape for image in pictures[np.array([0])]] == [(30, 40, 3)]


def test_scenes_saved_as_files_are_answered_alike(tmp_path: Path) -> None:
    """The shipped model reads files: they show exactly what was rendered."""
    from aegis_cli.models import backbones

    model, scenes = backbones.load("embedded"), load_scenes("probe", 70)
    lines = []
    for i, (image, question) in enumerate(zip(scenes.image_of, scenes.questions, strict=True)):
        Image.fromarray(scenes.images[image]).resize((192, 192), Image.Resampling.NEAREST).save(
            tmp_path / f"{image}.png"
        )
        lines.append(
            json.dumps(row(f"{image}.png", question=question.text, answers=[question.answer], id=i))
        )
    (tmp_path / "scenes.jsonl").write_text("\n".join(lines))
    made = sets.read(str(tmp_path / "scenes.jsonl")).choose("probe", 70, 0).sized(model.image_size)
    rows = grade(model.answers, made, 16)
    assert len(rows) > 15 and np.mean([g.correct for g in rows]) > 0.85
    assert [g.soft for g in rows] == [float(g.correct) for g in rows]


# --- what the embedded VLM can read ---------------------------------------------------------------


@pytest.mark.parametrize("answer", ["red", "red red red", "red red red red"])
@pytest.mark.parametrize("words", range(12, 21))
def test_a_text_is_refused_exactly_where_the_model_would_fail(words: int, answer: str) -> None:
    model, shown, text = (
        make_tiny(),
        torch.zeros(1, 64, 64, 3, dtype=torch.uint8),
        " ".join(["red"] * words),
    )

    def works(call: object, *args: object) -> bool:
        try:
            call(*args)
        except AegisError as error:
            assert f"at most {MAX_TEXT}" in error.expected
            return False
        return True

    asked = works(model.answer, shown, [text]) and works(
        model.answer_log_likelihood, shown, [text], [answer]
    )
    assert works(model.check_text, text, answer) == asked


def test_a_word_that_the_model_does_not_know_is_refused() -> None:
    for question, answer in (
        ("what color is the zebra", "red"),
        ("what color is the cube", "mauve"),
    ):
        with pytest.raises(AegisError, match="zebra|mauve"):
            make_tiny().check_text(question, answer)


def test_images_that_are_copied_without_their_times_are_the_same_and_changed_ones_are_not(
    tmp_path: Path,
) -> None:
    path = write_jsonl(tmp_path, images=2)
    before = sets.read(str(path)).state
    image = tmp_path / "images" / "0.png"
    for time_ns in (12345, 2**62):  # the clock may have been set back since
        os.utime(image, ns=(time_ns, time_ns))
        assert sets.read(str(path)).state == before
    changed = bytearray(image.read_bytes())
    changed[-1] ^= 1
    image.write_bytes(changed)
    os.utime(image, ns=(2**62, 2**62))
    assert sets.read(str(path)).state != before  # though size and time are unchanged
