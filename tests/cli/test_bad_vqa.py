"""Question sets that go wrong, through the command line.

One error names the line and nothing is written, or the question is left out and counted.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import datasets
import pytest
from samples.command import refused
from samples.user_folder import snapshot
from samples.vqa_files import hub_rows, official_pair, picture, row, write_jsonl, write_official

from aegis_cli.data.vqa import sets

IMAGES = 24
LAST = 2 * IMAGES + 1  # the line after those that write_jsonl writes
PROBED = next(i for i in range(IMAGES) if sets.share(f"images/{i}.png") in sets.PARTS["probe"])


@pytest.fixture
def place(tmp_path: Path, tiny_folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with a model."""
    folder = tmp_path / "place"
    folder.mkdir()
    (folder / "model.safetensors").write_bytes((tiny_folder / "model.safetensors").read_bytes())
    monkeypatch.chdir(folder)
    monkeypatch.setattr(datasets.config, "HF_DATASETS_CACHE", str(tmp_path / "cache"))
    return folder


@pytest.fixture
def bad(aegis, place: Path) -> Callable[..., str]:
    """Measure an anchor and probe: both must give the same error and write nothing."""

    def call(vqa: object, *says: str, options: tuple[str, ...] = ()) -> str:
        before = snapshot(place)
        anchor = (
            "anchor",
            "--backbone",
            "model.safetensors",
            "--out",
            "a.safetensors",
            "--parts",
            "moments",
        )
        probe = ("probe", "model.safetensors", "--predictions", "said.jsonl")
        for command in (anchor, probe):
            error = refused(aegis(*command, "--vqa", vqa, *options))
            assert [word for word in says if word not in error] == [], error
        assert snapshot(place) == before
        return error

    return call


@pytest.fixture
def skipped(aegis, place: Path) -> Callable[[object], int]:
    """How many questions a probe with --skip-bad leaves out; no bad one is answered."""

    def call(vqa: object) -> int:
        code, out, err = aegis(
            "probe",
            "model.safetensors",
            "--vqa",
            vqa,
            "--skip-bad",
            "--json",
            "--predictions",
            "said.jsonl",
        )
        assert code == 0, err
        answered = [
            json.loads(line)["id"] for line in (place / "said.jsonl").read_text().splitlines()
        ]
        assert (
            json.loads(out)["questions"] == len(answered) == len(set(answered)) > 0
            and "bad" not in answered
        )
        return json.loads(out)["skipped"]

    return call


def line(**changes: Any) -> str:
    return json.dumps(row(**{"image": f"images/{PROBED}.png", "id": "bad", **changes}))


NESTED = "[" * 100_000
LINES = {
    "no JSON": ('{"image": "images/0.png", "question"', ("not JSON",)),
    "deep JSON": (NESTED, ("not JSON",)),
    "no object": ('["images/0.png"]', ("a JSON list",)),
    "no image": (line(image=None), ("no image",)),
    "no question": (line(question=None), ("no question",)),
    "no answers": (line(answers=None), ("no answers",)),
    "an empty question": (line(question=" "), ("question ' '",)),
    "half a character": (line(question="is \ud800"), (r"question 'is \ud800'", "a text")),
    "half a character in an answer": (
        line(answers=["red", "\ud800"]),
        (r"answers ['red', '\ud800']",),
    ),
    "a question of numbers": (line(question=3), ("question 3", "a text")),
    "an empty list of answers": (line(answers=[]), ("no answer",)),
    "an empty answer": (line(answers=["red", ""]), ("answers ['red', '']",)),
    "answers that are no list": (line(answers=True), ("answers [True]", "a list")),
    "answers of fractions": (line(answers=[2.5]), ("answers [2.5]",)),
    "answers of truth": (line(answers=[False]), ("answers [False]",)),
    "several images": (
        line(image=["images/0.png", "images/1.png"]),
        ("a list of 2 images", "one image of"),
    ),
    "several images by another key": (
        json.dumps({"images": ["a.png", "b.png", "c.png"], "question": "?", "answers": ["a"]}),
        ("a list of 3 images", "one image of each"),
    ),
    "an image that is no path": (line(image=7), ("image 7", "relative")),
    "an id that is no name": (line(id=[1]), ("id [1]",)),
    "an id of truth": (line(id=True), ("id True",)),
    "an id given before": (line(id="line 3"), ("the id 'line 3' again", "line 3 of 'set.jsonl'")),
    "a missing image": (line(image="images/none.png"), ("no image 'images/none.png'",)),
    "a folder as image": (line(image="images"), ("no image 'images'",)),
    "an image above": (line(image="../other.png"), ("'../other.png' leaves the folder",)),
    "an absolute image": (line(image="/etc/hostname"), ("'/etc/hostname' leaves the folder",)),
    "a link that leads out": (
        line(image="images/link.png"),
        ("'images/link.png' leaves the folder",),
    ),
    "a folder link that leads out": (line(image="elsewhere/other.png"), ("leaves the folder",)),
    "a loop of links": (line(image="images/loop.png"), ("no image",)),
    "a path with a zero": (line(image="a\0b.png"), ("leaves the folder",)),
    "a path of no characters": (line(image="\ud800.png"), ("leaves the folder",)),
    "a path too long": (line(image="a" * 5000), ("no image",)),
}


def write_links(place: Path) -> None:
    picture(1).save(place.parent / "other.png")
    (place / "images/link.png").symlink_to(place.parent / "other.png")
    (place / "images/loop.png").symlink_to("loop.png")
    (place / "elsewhere").symlink_to(place.parent)


@pytest.mark.parametrize("case", LINES)
def test_a_bad_line(
    case: str, bad: Callable[..., str], skipped: Callable[[object], int], place: Path
) -> None:
    text, says = LINES[case]
    write_jsonl(place, IMAGES, extra=[text])
    write_links(place)
    bad("set.jsonl", f"line {LAST} of 'set.jsonl'", "--skip-bad", *says)
    assert skipped("set.jsonl") == 1


def test_bytes_that_are_no_text(
    bad: Callable[..., str], skipped: Callable[[object], int], place: Path
) -> None:
    path = write_jsonl(place, IMAGES)
    path.write_bytes(path.read_bytes() + line().encode().replace(b"cube", b"c\xffbe"))
    bad("set.jsonl", f"line {LAST}", "not JSON")
    assert skipped("set.jsonl") == 1


@pytest.mark.parametrize("content", ["", "\n \n"])
def test_an_empty_file(content: str, bad: Callable[..., str], place: Path) -> None:
    (place / "set.jsonl").write_text(content)
    for options in ((), ("--skip-bad",)):
        bad("set.jsonl", "no usable question in 'set.jsonl'", options=options)


def test_nothing_but_bad_lines(bad: Callable[..., str], place: Path) -> None:
    (place / "set.jsonl").write_text("{\n[]\n" + line(image="none.png"))
    bad(
        "set.jsonl",
        "3 are bad, the first: line 1 of 'set.jsonl': not JSON",
        options=("--skip-bad",),
    )


@pytest.mark.parametrize("keep", [0, 4, 40, 0.5, 0.95])
@pytest.mark.parametrize("form", ["png", "jpg", "gif", "bmp", "webp"])
def test_a_corrupt_image(
    form: str, keep: float, aegis, skipped: Callable[[object], int], place: Path
) -> None:
    """Cut anywhere, the error names the first line about it; without it the others are asked."""
    write_jsonl(place, IMAGES)
    for i in range(200):  # until one belongs to the probe's part
        if sets.share(f"images/bad{i}.{form}") in sets.PARTS["probe"]:
            name = f"images/bad{i}.{form}"
            break
    picture(0, 64, 48).save(place / name)
    data = (place / name).read_bytes()
    (place / name).write_bytes(data[: int(keep * len(data)) if 0 < keep < 1 else int(keep)])
    with open(place / "set.jsonl", "a", encoding="utf-8") as file:
        file.write(json.dumps(row(name, id="bad")) + "\n" + json.dumps(row(name, 1, id="bad too")))
    before = snapshot(place)
    error = refused(
        aegis("probe", "model.safetensors", "--vqa", "set.jsonl", "--predictions", "said.jsonl")
    )
    assert (
        f"line {LAST} of 'set.jsonl'" in error
        and name in error
        and "--skip-bad" in error
        and snapshot(place) == before
    )
    assert skipped("set.jsonl") == 2


def test_an_image_of_too_many_pixels(
    aegis, place: Path, skipped: Callable[[object], int], monkeypatch
) -> None:
    from PIL import Image

    write_jsonl(place, IMAGES)
    picture(0, 400, 300).save(place / f"images/{PROBED}.png")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100_000)
    assert "images/" in refused(aegis("probe", "model.safetensors", "--vqa", "set.jsonl"))
    assert skipped("set.jsonl") == 2


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"question": "What color is the cube?"}, ("'cube?'", "did you mean 'cube'?")),
        ({"question": "what breed is the dog"}, ("'breed'",)),
        ({"answers": ["mauve"]}, ("'mauve'",)),
        ({"question": "is there a " + "red " * 17}, ("tokens", "at most 20", "fewer words")),
        ({"answers": ["red " * 20]}, ("tokens",)),
    ],
)
def test_what_the_embedded_vlm_cannot_read(
    changes: dict[str, Any],
    says: tuple[str, ...],
    aegis,
    skipped: Callable[[object], int],
    place: Path,
) -> None:
    write_jsonl(place, IMAGES, extra=[line(**changes)])
    before = snapshot(place)
    error = refused(
        aegis("probe", "model.safetensors", "--vqa", "set.jsonl", "--predictions", "said.jsonl")
    )
    assert [
        word for word in (f"line {LAST} of 'set.jsonl'", "--skip-bad", *says) if word not in error
    ] == []
    assert snapshot(place) == before and skipped("set.jsonl") == 1


def test_an_anchor_counts_what_it_leaves_out(aegis, place: Path) -> None:
    write_jsonl(place, IMAGES, extra=["{", line(answers=[])])
    code, out, _ = aegis(
        "anchor",
        "--backbone",
        "model.safetensors",
        "--vqa",
        "set.jsonl",
        "--skip-bad",
        "--parts",
        "moments",
        "--out",
        "a",
        "--json",
    )
    assert code == 0 and json.loads(out)["skipped"] == 2


# --- names ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "vqa", ["vqav2", "scene", "nothing.jsonl", ".", "model.safetensors", "folder", "a" * 5000]
)
def test_what_is_no_question_set(vqa: str, bad: Callable[..., str], place: Path) -> None:
    (place / "folder").mkdir()
    bad(vqa, f"question set '{vqa}'"[:60], "'scenes'", "--vqa scenes")


# --- the official pair ----------------------------------------------------------------------------


def changed(change: Callable[[list[Any], list[Any]], object]) -> dict[str, Any]:
    """The pair with a change to its lists."""
    questions, annotations = copy.deepcopy(official_pair(IMAGES))
    change(questions["questions"], annotations["annotations"])
    return {"questions": questions, "annotations": annotations}


PAIRS: dict[str, tuple[Callable[[list[Any], list[Any]], object], tuple[str, ...], int]] = {
    "a question without its annotation": (
        lambda q, a: a.pop(3),
        ("question_id 262149001", "no annotation"),
        1,
    ),
    "an annotation without its question": (
        lambda q, a: q.pop(3),
        ("question_id 262149001", "without its question"),
        1,
    ),
    "a question twice": (lambda q, a: q.append(q[3]), ("question_id 262149001",), 1),
    "an annotation twice": (
        lambda q, a: a.append(a[3]),
        ("a second annotation of question 262149001",),
        1,
    ),
    "another image in the annotation": (
        lambda q, a: a[3].update(image_id=1),
        ("question_id 262149001", "the same image"),
        1,
    ),
    "no answers": (lambda q, a: a[3].update(answers=[]), ("question_id 262149001", "no answer"), 1),
    "answers without their text": (
        lambda q, a: a[3].update(answers=[{"answer_id": 1}]),
        ("question_id 262149001", "answers [None]"),
        1,
    ),
    "a question that is no text": (
        lambda q, a: q[3].update(question=None),
        ("question_id 262149001", "question missing"),
        1,
    ),
    "no question_id": (
        lambda q, a: q[3].pop("question_id"),
        ("question 4 of", "no question_id"),
        2,
    ),
    "no object": (lambda q, a: a.__setitem__(3, 5), ("annotation 4 of", "no question_id"), 2),
    "a question_id that is no name": (
        lambda q, a: q[3].update(question_id=1.5),
        ("question 4 of", "question_id 1.5"),
        2,
    ),
    "an annotation's question_id that is no name": (
        lambda q, a: a[3].update(question_id=[1]),
        ("annotation 4 of", "question_id [1]"),
        2,
    ),
    "an image that is not there": (
        lambda q, a: [x[3].update(image_id=77) for x in (q, a)],
        ("COCO_val2014_000000000077.jpg", "val2014.zip"),
        1,
    ),
    "an image that is no number": (
        lambda q, a: [x[3].update(image_id="../1") for x in (q, a)],
        ("image_id '../1'",),
        1,
    ),
}


@pytest.mark.parametrize("case", PAIRS)
def test_a_bad_official_pair(
    case: str, bad: Callable[..., str], skipped: Callable[[object], int], place: Path
) -> None:
    change, says, count = PAIRS[case]
    path = write_official(place, images=IMAGES, **changed(change))
    bad(path.name, *says)
    assert skipped(path.name) == count


@pytest.mark.parametrize("name", ["x.json", "x_questions.json"])
def test_a_json_file_without_questions_says_which_key_is_missing(
    name: str, bad: Callable[..., str], place: Path
) -> None:
    (place / name).write_text(json.dumps({"answers": []}))
    bad(name, f"'{name}' has no list of questions under the key 'questions'")


def test_questions_under_another_name_say_so(bad: Callable[..., str], place: Path) -> None:
    (place / "x.json").write_text(json.dumps({"questions": []}))
    bad("x.json", "a name that does not end in 'questions.json'")


def test_an_official_file_that_is_none(bad: Callable[..., str], place: Path) -> None:
    path = write_official(place, images=3)
    annotations = place / "v2_mscoco_val2014_annotations.json"
    whole, told = path.read_text(), annotations.read_text()
    for content, says in (
        (whole[:-5], "not JSON"),
        ("[]", "no usable question"),  # a list of questions, with another file's name
        (json.dumps({"questions": 5}), "no list of questions"),
    ):
        path.write_text(content)
        bad(path.name, path.name, says)
    path.write_text(json.dumps({**json.loads(whole), "data_subtype": "../x"}))
    bad(path.name, "data_subtype '../x'")
    path.write_text(whole)
    annotations.write_text(told[:-5])
    bad(path.name, annotations.name, "not JSON")
    annotations.unlink()
    bad(path.name, f"no file '{annotations.name}'", "under their official name")
    (place / "v2_OpenEnded_mscoco_train2014_questions.json").write_text(whole)
    bad(".", "2 questions files in '.'", "--vqa")


# --- data sets of Hugging Face --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("columns", "says", "count"),
    [
        (
            {"question": ["what color is the cube"] * 47 + [None]},
            ("row 47 of 'data'", "question missing"),
            1,
        ),
        ({"answers": [["red"]] * 47 + [[]]}, ("row 47 of 'data'", "no answer"), 1),
        ({"answers": [["red"]] * 47 + [None]}, ("row 47 of 'data'", "no answer"), 1),
        (
            {"image": [picture(i // 2) for i in range(47)] + [None]},
            ("row 47 of 'data'", "no image"),
            1,
        ),
        ({"question_id": [*range(47), 3]}, ("row 47 of 'data'", "the id '3' again", "row 3"), 1),
    ],
)
def test_a_bad_row(
    columns: dict[str, Any],
    says: tuple[str, ...],
    count: int,
    bad: Callable[..., str],
    skipped: Callable[[object], int],
    place: Path,
) -> None:
    datasets.Dataset.from_dict(hub_rows(IMAGES, **columns)).save_to_disk("data")
    bad("data", *says)
    assert skipped("data") == count


def test_rows_of_several_images(bad: Callable[..., str], place: Path) -> None:
    several = [[picture(i), picture(i + 1)] for i in range(48)]
    datasets.Dataset.from_dict(hub_rows(IMAGES, image=several)).save_to_disk("data")
    bad("data", "row 0 of 'data': a list of 2 images", "one image of each question")


@pytest.mark.parametrize(
    ("turns", "says"),
    [
        ("red", "a conversation that is a str"),
        ([], "an empty conversation"),
        (["red"], "a conversation that is a list of str"),
        (None, "a conversation that is nothing"),
        ({"from": "human"}, "a conversation that is a dict"),
        ([{"user": "what color is it"}], "a turn with user"),
        ([{"from": "human", "value": "what color is it"}], "a conversation of human"),
        ([{"from": "gpt", "value": "red"}], "a conversation of gpt"),
        ([{"role": "system", "content": "be brief"}], "a conversation of no turn"),
        (
            [{"role": name, "content": "red"} for name in ("user", "user", "assistant")],
            "a conversation of user, user, assistant",
        ),
        ([{"user": " <image> ", "assistant": "red"}], "question ''"),
        ([{"user": "what color is it", "assistant": " "}], "answers ['']"),
    ],
)
def test_a_conversation_that_is_none(
    turns: object, says: str, bad: Callable[..., str], place: Path
) -> None:
    bad(
        write_jsonl(place, 3, extra=[json.dumps({"image": "images/0.png", "messages": turns})]),
        "line 7",
        says,
    )


@pytest.mark.parametrize("missing", ["image", "question", "answers"])
def test_a_data_set_without_a_column(missing: str, bad: Callable[..., str], place: Path) -> None:
    datasets.Dataset.from_dict(hub_rows(3, **{missing: None})).save_to_disk("data")
    bad("data", "the columns", missing, "rename")


def test_image_paths_of_a_data_set_stay_in_its_folder(bad: Callable[..., str], place: Path) -> None:
    picture(1).save(place / "other.png")
    rows = datasets.Dataset.from_dict(hub_rows(3, image=[str(place / "other.png")] * 6))
    rows.save_to_disk("data")
    bad("data", "row 0 of 'data'", "leaves the folder")


@pytest.mark.parametrize("keep", [0.0, 0.3, 0.9])
@pytest.mark.parametrize("form", ["saved", "parquet"])
def test_a_truncated_data_set(form: str, keep: float, bad: Callable[..., str], place: Path) -> None:
    rows = datasets.Dataset.from_dict(hub_rows(3))
    rows.save_to_disk("data") if form == "saved" else (place / "data").mkdir()
    if form == "parquet":
        rows.to_parquet("data/train-00000-of-00001.parquet")
    path = next(p for p in (place / "data").iterdir() if p.suffix in (".arrow", ".parquet"))
    path.write_bytes(path.read_bytes()[: int(keep * path.stat().st_size)])
    bad("data", "'data'", "download it again")


def test_a_missing_package(bad: Callable[..., str], place: Path, monkeypatch) -> None:
    datasets.Dataset.from_dict(hub_rows(3)).save_to_disk("data")
    monkeypatch.setitem(__import__("sys").modules, "datasets", None)
    bad("data", "no package 'datasets'", "pip install 'aegis-vla[hf]'")
