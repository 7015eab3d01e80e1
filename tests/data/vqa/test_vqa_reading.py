"""Question sets are read in pieces and packed: what is read, and what is told while reading."""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import datasets
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from samples.vqa_files import official_pair, row, write_jsonl, write_official
from samples.vqa_forms import Forms

from aegis_cli.common import json_lists
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, Progress
from aegis_cli.data.vqa import entries, jsonl, official, packed, saved, sets, summary

FORMS = ("lines", "items", "official", "saved", "chats")


@pytest.fixture
def forms(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Forms:
    monkeypatch.setattr(datasets.config, "HF_DATASETS_CACHE", str(tmp_path / "cache"))
    (tmp_path / "set").mkdir()
    return Forms(tmp_path / "set")


def read_in_pieces(size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Read so many bytes or, if they are few, rows at a time, and count in bytes."""
    for module in (json_lists, jsonl, entries, saved):
        monkeypatch.setattr(module, "CHUNK", size)
    monkeypatch.setattr(entries, "_MB", 1)
    if size < 1000:
        monkeypatch.setattr(saved, "_BATCH", 30)
        monkeypatch.setattr(official, "_EVERY", size)


def told_of(path: Path, skip_bad: bool) -> list[Any]:
    """All that a set of questions holds and chooses."""
    try:
        source = sets.read(str(path), skip_bad)
    except AegisError as error:
        return [str(error)]
    assert isinstance(source, sets.Listed)
    told: list[Any] = [len(source.entries)]
    for entry in source.entries:
        shown, asked = entry.picture, entry.question
        at = str(shown.source) if isinstance(shown.source, Path) else shown.source.where
        told += [entry.where, shown.key, shown.where, at, asked.family, asked.text, asked.answer]
        told += [asked.answers, asked.id]
    told += [str(problem) for problem in source.problems]
    for part, seed, count in [(part, seed, n) for part in sets.PARTS for seed, n in CHOSEN]:
        try:
            chosen = source.choose(part, count, seed)
        except AegisError as error:
            told.append(str(error))
            continue
        told += [chosen.image_of.tolist(), chosen.skipped, chosen.names]
        told += [[picture.where, picture.key] for picture in chosen.images.pictures]
        told += [[q.family, q.text, q.answer, q.answers, q.id] for q in chosen.questions]
    return told


CHOSEN = ((0, 5), (0, 30), (3, 10**9))
# What the code gave before it read in pieces: a set without mistakes, one with some that are left
# out, and the error of the latter if they are not.
BEFORE: dict[str, tuple[str, str, str]] = {
    "lines": ("dc0ca19900a2", "9efc902f6ddf", "8b8ac5b22046"),
    "items": ("6107cedcc993", "c1a376883211", "e45cf66f1c91"),
    "official": ("7d7d792116d6", "21f04eb84e29", "8cb8a5603982"),
    "saved": ("c656a8bc22c5", "5d6c2b151568", "d42657512dec"),
    "chats": ("286bf84cdaa9", "766329b43f0c", "ea3387b639aa"),
}


def digest(told: list[Any], folder: Path) -> str:
    text = json.dumps(told).replace(str(folder), "HERE")
    return hashlib.sha256(text.encode()).hexdigest()[:12]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("chunk", [7, 200, json_lists.CHUNK])
def test_what_is_read_and_chosen_is_what_it_always_was(
    form: str, chunk: int, forms: Forms, monkeypatch: pytest.MonkeyPatch
) -> None:
    read_in_pieces(chunk, monkeypatch)
    write: Callable[[bool], Path] = getattr(forms, form)
    good = digest(told_of(write(False), False), forms.folder)
    path = write(True)
    left_out = digest(told_of(path, True), forms.folder)
    assert (good, left_out, digest(told_of(path, False), forms.folder)) == BEFORE[form]


# --- JSON in pieces -------------------------------------------------------------------------------

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=8,
)
COUNTED = settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])


def taken(text: bytes, key: str | None, folder: Path) -> tuple[list[Any], dict[str, Any]]:
    (folder / "it.json").write_bytes(text)
    rest: dict[str, Any] = {}
    with (folder / "it.json").open("rb") as file:
        return list(json_lists.items(file, key, rest, lambda _: None)), rest


@COUNTED
@given(
    items=st.lists(VALUES),
    rest=st.dictionaries(st.text(), VALUES, max_size=3),
    last=st.booleans(),
    indent=st.sampled_from([None, 0, 2]),
    plain=st.booleans(),
    chunk=st.integers(1, 30),
)
def test_a_list_is_the_same_in_pieces_of_any_size(
    items: list[Any],
    rest: dict[str, Any],
    last: bool,
    indent: int | None,
    plain: bool,
    chunk: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(json_lists, "CHUNK", chunk)
    rest.pop("rows", None)
    whole = rest | {"rows": items} if last else {"rows": items} | rest
    for content, key in ((items, None), (whole, "rows")):
        text = json.dumps(content, indent=indent, ensure_ascii=plain)
        found, others = taken(text.encode("utf-8", "surrogatepass"), key, tmp_path)
        assert found == items and others == ({} if key is None else rest)


@COUNTED
@given(
    items=st.lists(VALUES, min_size=1),
    at=st.floats(0, 1),
    mark=st.sampled_from(["", *'[]{},:"1e-. \\n\x00\ufeff']),
    cut=st.integers(0, 3),
    chunk=st.integers(1, 30),
)
@example(items=[None], at=0.0, mark="\ufeff", cut=0, chunk=1)
def test_what_is_not_json_is_never_taken_for_it(
    items: list[Any],
    at: float,
    mark: str,
    cut: int,
    chunk: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(json_lists, "CHUNK", chunk)
    text = json.dumps(items)
    place = int(at * len(text))
    text = text[:place] + mark + text[place + cut :]
    try:
        expected = json.loads(text.encode())  # a mark of its encoding at the start is no error
    except ValueError:
        expected = None
    try:
        found, _ = taken(text.encode(), None, tmp_path)
    except json_lists.Unusual:
        found = None
    assert found == (expected if isinstance(expected, list) else None)


def test_a_list_in_another_encoding_is_read_too(tmp_path: Path) -> None:
    write_jsonl(tmp_path, 3)
    text = json.dumps([row(f"images/{i}.png") for i in range(3)])
    (tmp_path / "set.json").write_bytes(text.encode("utf-16-le"))
    assert len(sets.read(str(tmp_path / "set.json")).entries) == 3


@pytest.mark.parametrize("place", ["begin", "end"])
@pytest.mark.parametrize("form", ["items", "official"])
@pytest.mark.parametrize("skip_bad", [True, False])
def test_bytes_that_are_no_utf8_are_refused(
    forms: Forms, form: str, place: str, skip_bad: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    read_in_pieces(64, monkeypatch)
    path = getattr(forms, form)(bad=False)
    content = path.read_bytes()
    at = content.index(b'": "') + 4 if place == "begin" else content.rindex(b'": "') + 4
    path.write_bytes(content[:at] + b"\xe9" + content[at:])
    with pytest.raises(AegisError, match="is not JSON"):
        sets.read(str(path), skip_bad)


@pytest.mark.parametrize("skip_bad", [True, False])
@pytest.mark.parametrize("problem", ["none.png", "again"])
def test_a_file_that_ends_too_soon_is_refused_for_that(
    problem: str, skip_bad: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not for a bad question before its end: the file itself is incomplete."""
    read_in_pieces(100, monkeypatch)
    write_jsonl(tmp_path, 3)
    rows = [row(f"images/{i}.png", id=i) for i in range(3)]
    rows[1] |= {"image": problem} if problem != "again" else {"id": 0}
    (tmp_path / "set.json").write_text(json.dumps(rows)[:-1])
    with pytest.raises(AegisError, match="is not JSON: Expecting ',' delimiter"):
        sets.read(str(tmp_path / "set.json"), skip_bad)


@pytest.mark.parametrize("skip_bad", [True, False])
def test_a_list_that_is_there_twice_is_refused(
    tmp_path: Path, skip_bad: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    read_in_pieces(100, monkeypatch)
    questions, annotations = official_pair(4)
    path = write_official(tmp_path, images=4, annotations=annotations)
    one, other = json.dumps(questions["questions"][:2]), json.dumps(questions["questions"])
    path.write_text(f'{{"questions": {one}, "questions": {other}}}')
    with pytest.raises(AegisError, match="has the key 'questions' twice"):
        sets.read(str(path), skip_bad)


def test_a_list_may_be_named_as_an_official_file(tmp_path: Path) -> None:
    write_jsonl(tmp_path, 3)
    text = json.dumps([row(f"images/{i}.png") for i in range(3)])
    (tmp_path / "questions.json").write_text(text)
    assert len(sets.read(str(tmp_path / "questions.json")).entries) == 3


# --- packed ---------------------------------------------------------------------------------------


def test_packed_questions_are_a_sequence(tmp_path: Path) -> None:
    source = sets.read(str(write_jsonl(tmp_path, 5)))
    assert isinstance(source, sets.Listed)
    every = list(source.entries)
    assert len(source.entries) == len(every) == 10 and source.entries[-1] == every[-1]
    assert source.entries[2:7:2] == every[2:7:2] and source.entries[20:] == []
    with pytest.raises(IndexError):
        source.entries[10]
    assert list(pickle.loads(pickle.dumps(source.entries))) == every
    assert source.entries.about("images/1.png") == every[2:4]
    assert source.entries.about("images/1.png", 1) == every[2:3]
    assert list(packed.Entries(every)) == every


@given(
    st.lists(
        st.builds(
            lambda base, turn: base if turn is None else f"{base}.{turn}",
            st.sampled_from(["", "a", "1", "a.1"]),
            st.sampled_from([None, "", "0", "1", "2", "3", "02", "-1", "1" * 12, "\u0661"]),
        ),
        max_size=20,
    )
)
def test_an_id_is_taken_once_it_was_given(names: list[str]) -> None:
    made, known = packed.Entries(), dict[str, int]()
    ids = packed.Ids(made)
    for number, name in enumerate(names):
        question = entries.make_question("", "is it", "red", name, "all")
        entry = entries.Entry(f"line {number} of 'x'", question, sets.Picture("k", "w", "p"))
        problem = ids.add(entry)
        assert (problem is None) == (name not in known)
        if problem is None:
            known[name] = number
            made.append(entry)
        else:
            assert f"first in line {known[name]} of 'x'" in problem.found


def test_what_is_left_out_keeps_nothing_of_its_file(forms: Forms) -> None:
    """A traceback would keep all that was read around the error."""
    source = sets.read(str(forms.lines(True)), skip_bad=True)
    assert isinstance(source, sets.Listed) and len(source.problems) > 50
    assert all(problem.__traceback__ is None for problem in source.problems)


def test_an_image_is_looked_up_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Disks across a network answer slowly, and a set may have a million images."""
    path = write_jsonl(tmp_path, 50)
    lookups: list[str] = []
    for name in ("stat", "lstat"):
        real = getattr(entries.os, name)
        monkeypatch.setattr(
            entries.os, name, lambda at, real=real, **k: (lookups.append(str(at)), real(at, **k))[1]
        )
    sets.read(str(path))
    of_images = [at for at in lookups if at.endswith(".png")]
    assert len(of_images) == len(set(of_images)) == 50


def test_the_state_is_of_every_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sets, "_AT_ONCE", 4)
    events: list[Event] = []
    source = sets.read(str(write_jsonl(tmp_path, 10)), on_event=events.append)
    images = {f"images/{i}.png": tmp_path / f"images/{i}.png" for i in range(10)}
    images["images/3.png"].unlink()
    digests = {
        key: hashlib.sha256(path.read_bytes()).hexdigest() if path.exists() else None
        for key, path in images.items()
    }
    assert source.state["image_files"] == sets.sha256_value(digests)
    told = [event for event in events if isinstance(event, Progress)]
    assert [e.done for e in told if e.stage == "checksums"] == [4, 8, 10]


# --- what is told ---------------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("bad", [False, True], ids=["good", "bad"])
def test_progress_rises_to_its_end(
    form: str, bad: bool, forms: Forms, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = getattr(forms, form)(bad)
    read_in_pieces(20, monkeypatch)
    events: list[Event] = []
    source = sets.read(str(path), skip_bad=bad, on_event=events.append)
    assert isinstance(source, sets.Listed)
    told = [event for event in events if isinstance(event, Progress)]
    stages = dict.fromkeys(event.stage for event in told)
    before = {"official": ["read questions", "read annotations"], "saved": ["open"]}
    before["chats"] = before["saved"]
    assert list(stages) == [*before.get(form, []), "read"]
    for stage in stages:
        own = [event for event in told if event.stage == stage]
        shares = [event.done / event.total for event in own]
        assert [event.done for event in own] == sorted(event.done for event in own)
        assert all(0 <= share < 1 for share in shares[:-1]) and shares[-1] == 1
        assert all(b > a - 0.1 for a, b in zip(shares, shares[1:], strict=False))
    own = [event for event in told if event.stage == "read"]
    assert len(own) > 3 and own[-1] == Progress(
        "read", len(source.entries), own[-1].done, "questions"
    )


def test_a_small_file_is_read_without_more_ado(tmp_path: Path) -> None:
    events: list[Event] = []
    sets.read(str(write_jsonl(tmp_path, 3)), on_event=events.append)
    assert events == [Progress("read", 6, 6, "questions")]


def test_inspect_tells_what_it_reads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read_in_pieces(200, monkeypatch)
    monkeypatch.setattr(summary, "_EVERY", 20)
    events: list[Event] = []
    path = write_jsonl(tmp_path, 30)
    summary.of_set(str(path), on_event=events.append)
    counted = [event for event in events if isinstance(event, Progress) and event.stage != "read"]
    assert [(event.stage, event.done, event.total) for event in counted] == [
        *(("count", done, 60) for done in (20, 40, 60)),
        *(("compare questions", done, 30) for done in (20, 30)),
    ]
    drawn: list[Event] = []
    summary.save_sheet(str(path), tmp_path / "sheet.png", drawn.append)
    for told in (events, drawn):
        assert len([e for e in told if isinstance(e, Progress) and e.stage == "read"]) > 3


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("command", ["inspect", "probe"])
def test_ctrl_c_while_it_is_read_ends_the_command(
    command: str, form: str, forms: Forms, aegis: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = getattr(forms, form)(False)
    read_in_pieces(20, monkeypatch)
    pressed = 0
    real = packed.Entries.append

    def append(made: packed.Entries, entry: entries.Entry) -> None:
        nonlocal pressed
        real(made, entry)
        if len(made) == 100:
            pressed += 1
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(packed.Entries, "append", append)
    said = ("inspect", path) if command == "inspect" else ("probe", "embedded", "--vqa", path)
    code, out, err = aegis(*said)
    assert (code, out, pressed) == (130, "", 1)
    last = err.splitlines()[-1]
    assert last.startswith("interrupted; ") and last.endswith(f"aegis {' '.join(map(str, said))}")
    assert "Traceback" not in err and "read: " in err
