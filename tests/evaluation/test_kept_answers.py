"""Answers are kept as they arrive: an interrupted probe resumes and gives the same report."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from samples.vqa_files import picture, write_jsonl
from torch import Tensor

from aegis_cli.common import cache, circumstances
from aegis_cli.common.events import Event, Progress, ignore
from aegis_cli.common.ranks import ALONE, Ranks
from aegis_cli.data.vqa import sets
from aegis_cli.data.vqa.dataset import VQASet
from aegis_cli.data.vqa.metrics import Graded
from aegis_cli.evaluation import kept_answers
from aegis_cli.models.backbones.embedded import EmbeddedVLM

BATCH = 4


class Stopped(Exception):
    """Ends a probe halfway."""


@pytest.fixture
def model(tiny: EmbeddedVLM, tmp_path: Path) -> str:
    """A model's folder; `tiny` is the model in it."""
    tiny.save(tmp_path / "model")
    return str(tmp_path / "model")


def questions(folder: Path, count: int, images: int = 30) -> VQASet:
    source = sets.read(str(write_jsonl(folder, images)))
    return source.choose("probe", count, 0)


@pytest.fixture
def asked(tmp_path: Path) -> VQASet:
    return questions(tmp_path, 18)


@pytest.fixture
def batches(tiny: EmbeddedVLM, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The number of questions in each pass of `tiny`."""
    seen: list[int] = []
    plain = tiny.answers

    def counted(given: Iterator[Any]) -> Iterator[tuple[list[str], Tensor]]:
        for said, likelihood in plain(given):
            seen.append(len(said))
            yield said, likelihood

    monkeypatch.setattr(tiny, "answers", counted)
    return seen


Ask = Callable[..., list[Graded]]


@pytest.fixture
def ask(tiny: EmbeddedVLM, model: str) -> Ask:
    def ask(
        of: VQASet,
        batch: int = BATCH,
        on_event: Callable[[Event], None] = ignore,
        ranks: Ranks = ALONE,
        name: str = model,
    ) -> list[Graded]:
        loaded = kept_answers.load(name)
        assert loaded.digest is not None
        return kept_answers.ask(loaded._replace(model=tiny), of, batch, ranks, on_event)

    return ask


def store() -> Path:
    (path,) = cache.folder("answers").glob("*.jsonl")
    return path


@pytest.mark.parametrize("after", [1, 2, 4])
def test_an_interrupted_probe_goes_on_to_the_same_answers(
    after: int, ask: Ask, asked: VQASet, batches: list[int], tmp_path: Path
) -> None:
    """Batches that were answered are not asked again, and no bit differs."""

    def stop(event: Event) -> None:
        if isinstance(event, Progress) and event.done >= after * BATCH:
            raise Stopped

    with pytest.raises(Stopped):
        ask(asked, on_event=stop)
    answered = list(batches)
    del batches[:]
    events: list[Event] = []
    found = ask(asked, on_event=events.append)
    assert sum(answered) == after * BATCH
    assert sum(batches) == 18 - sum(answered)
    told = [(each.done, each.total) for each in events if isinstance(each, Progress)]
    assert told[0] == (after * BATCH, 18) and told[-1] == (18, 18)
    store().unlink()
    assert ask(asked) == found


def test_what_was_answered_before_is_not_asked_again(
    ask: Ask, asked: VQASet, batches: list[int]
) -> None:
    first = ask(asked)
    del batches[:]
    events: list[Event] = []
    assert ask(asked, on_event=events.append) == first and batches == []
    assert events == [Progress("probe", 18, 18, "questions")]


def test_a_longer_probe_asks_the_rest(
    ask: Ask, asked: VQASet, batches: list[int], tmp_path: Path
) -> None:
    ask(asked.part(slice(8)))
    del batches[:]
    found = ask(asked)
    assert batches == [4, 4, 2]
    store().unlink()
    assert ask(asked) == found


@pytest.mark.parametrize("change", ["weights", "question", "answer", "picture", "code"])
def test_another_probe_is_asked(
    change: str,
    ask: Ask,
    asked: VQASet,
    batches: list[int],
    tiny: EmbeddedVLM,
    model: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ask(asked)
    del batches[:]
    path = tmp_path / "set.jsonl"
    if change == "weights":
        with torch.no_grad():
            next(iter(tiny.parameters())).add_(0.1)
        tiny.save(Path(model))
    elif change == "question":
        path.write_text(path.read_text().replace("cube", "ball"))
    elif change == "answer":
        path.write_text(path.read_text().replace('"red"', '"green"'))
    elif change == "picture":
        for image in (tmp_path / "images").iterdir():
            picture(1000, 50).save(image)
    else:
        monkeypatch.setattr(circumstances.version, "code", lambda: "another")
    same = sets.read(str(path)).choose("probe", 18, 0)
    ask(same)
    assert sum(batches) > 0


def test_nothing_is_kept_for_a_backward_pass(
    ask: Ask, asked: VQASet, tiny: EmbeddedVLM, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The graphs of all batches would not fit beside a large model."""
    seen: list[bool] = []
    plain = tiny.answers

    def noted(given: Iterator[Any]) -> Iterator[tuple[list[str], Tensor]]:
        for said, likelihood in plain(given):
            seen.append(torch.is_grad_enabled() or likelihood.requires_grad)
            yield said, likelihood

    monkeypatch.setattr(tiny, "answers", noted)
    ask(asked)
    assert seen and not any(seen)


@pytest.mark.parametrize("when", ["link", "file"])
def test_answers_of_weights_that_nobody_knows_are_not_kept(
    when: str, tmp_path: Path, tiny: EmbeddedVLM, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As when a training writes its next checkpoint while the last one is loaded."""
    for name in ("a", "b"):
        tiny.save(tmp_path / name)
        with torch.no_grad():
            next(iter(tiny.parameters())).add_(0.1)
    link = tmp_path / "last"
    link.symlink_to("a")
    plain = kept_answers.backbones.load

    def loaded_meanwhile(name: str) -> Any:
        found = plain(name)
        if when == "link":
            link.unlink()
            link.symlink_to("b")
        else:
            shutil.copy(tmp_path / "b" / "model.safetensors", tmp_path / "a")
        return found

    assert kept_answers.load(str(link)).digest is not None
    monkeypatch.setattr(kept_answers.backbones, "load", loaded_meanwhile)
    assert kept_answers.load(str(link)).digest is None


def test_people_may_be_graded_by_other_answers(
    ask: Ask, asked: VQASet, batches: list[int], tmp_path: Path
) -> None:
    """The answers are kept; their scores follow from the reference answers that are there now."""
    before = ask(asked)
    path = tmp_path / "set.jsonl"
    changed = path.read_text().replace('["red", "red", "blue"]', '["red", "red", "red"]')
    path.write_text(changed)
    del batches[:]
    after = ask(sets.read(str(path)).choose("probe", 18, 0))
    assert batches == []
    assert [one.said for one in after] == [one.said for one in before]
    assert {len(set(one.question.answers)) for one in after} == {1}


def test_lines_that_were_cut_off_are_asked_again(
    ask: Ask, asked: VQASet, batches: list[int]
) -> None:
    expected = ask(asked)
    lines = store().read_text().splitlines(keepends=True)
    store().write_text("".join(lines[:-1]) + lines[-1][:20])
    del batches[:]
    assert ask(asked) == expected and batches == [2]  # the last batch
    del batches[:]
    assert ask(asked) == expected and batches == []


@pytest.mark.parametrize("line", ['{"question": 3}', "[]", "null", '{"said": "red"}'])
def test_foreign_lines_are_left_out(line: str, ask: Ask, asked: VQASet) -> None:
    expected = ask(asked)
    with store().open("a") as file:
        file.write(f"{line}\n")
    assert ask(asked) == expected


def test_figures_that_are_not_finite_are_kept_as_they_are(
    ask: Ask, asked: VQASet, tiny: EmbeddedVLM, monkeypatch: pytest.MonkeyPatch, batches: list[int]
) -> None:
    plain = tiny.answers

    def sure(given: Iterator[Any]) -> Iterator[tuple[list[str], Tensor]]:
        for said, likelihood in plain(given):
            yield said, torch.full_like(likelihood, -torch.inf)

    monkeypatch.setattr(tiny, "answers", sure)
    first = ask(asked)
    del batches[:]
    assert ask(asked) == first and batches == []
    assert {one.cross_entropy for one in first} == {float("inf")}


def test_the_command_reports_the_same_the_second_time(
    model: str, asked: VQASet, tmp_path: Path, aegis
) -> None:
    args = ("probe", model, "--baseline", model, "--vqa", tmp_path / "set.jsonl", "--json")
    first, second = (aegis(*args) for _ in range(2))
    assert first[0] == second[0] == 0
    assert json.loads(first[1]) == json.loads(second[1])
    assert "probe baseline" in second[2]
