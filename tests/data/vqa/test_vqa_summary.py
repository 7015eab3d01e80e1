"""`aegis inspect QUESTIONS`: what a set holds, what is wrong with it, and how it looks."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import pytest
from PIL import Image
from samples.command import refused
from samples.vqa_files import ASKED, row, write_jsonl, write_official

from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, Progress
from aegis_cli.data.vqa import sets, summary

_BAD = ("{", json.dumps(row("images/0.png", question=None)), json.dumps(row("images/none.png")))


def test_questions_images_and_answers_are_counted(tmp_path: Path) -> None:
    found = summary.of_set(str(write_jsonl(tmp_path, images=24)))
    assert (found.questions, found.images, found.bad, found.repeated) == (48, 24, 0, 0)
    assert found.problems == ()
    assert found.words == {"median": 5, "most": max(len(text.split()) for text, _ in ASKED)}
    assert found.answer_words == {"median": 1, "most": 1}
    assert found.answers_a_question == {"least": 1, "most": 3}
    told = [(each.answer, each.questions, each.share) for each in found.answers]
    assert sorted(told) == [("2", 24, 0.5), ("red", 24, 0.5)] and found.distinct_answers == 2
    assert found.families == (summary.Family("all", 48),)


def test_parts_are_what_anchors_tuning_and_probes_get(tmp_path: Path) -> None:
    path = write_jsonl(tmp_path, images=60)
    source = sets.read(str(path))
    assert isinstance(source, sets.Listed)
    found = summary.of_set(str(path))
    assert sum(part.images for part in found.parts) == 60
    for part in found.parts:
        chosen = source.choose(part.name, 1000, seed=0)
        assert (len(chosen.questions), len(chosen.images)) == (part.questions, part.images)


def test_bad_questions_are_counted_and_the_first_are_told(tmp_path: Path) -> None:
    found = summary.of_set(str(write_jsonl(tmp_path, extra=_BAD * 3)))
    assert (found.questions, found.bad, len(found.problems)) == (48, 9, summary.PROBLEMS)
    assert found.problems[0].startswith(f"line 49 of '{tmp_path / 'set.jsonl'}': not JSON")
    assert "no question" in found.problems[1] and "no image" in found.problems[2]


def test_a_question_that_is_asked_again_is_told(tmp_path: Path) -> None:
    again = [json.dumps(row(f"images/{i}.png", asked)) for i, asked in ((0, 0), (0, 0), (1, 1))]
    assert summary.of_set(str(write_jsonl(tmp_path, extra=again))).repeated == 3


def test_images_are_decoded_where_that_is_asked(tmp_path: Path) -> None:
    path = write_jsonl(tmp_path, images=8)
    (tmp_path / "images" / "3.png").write_bytes(b"no image")
    assert summary.of_set(str(path)).bad == 0
    events: list[Event] = []
    found = summary.of_set(str(path), images=True, on_event=events.append)
    assert (found.questions, found.images, found.bad) == (14, 7, 2)
    (told,) = found.problems  # once for both questions about it
    assert "3.png' cannot be read as an image (not in a known raster format" in told
    done = [event for event in events if isinstance(event, Progress)]
    assert (done[-1].done, done[-1].total) == (8, 8)


def test_a_set_without_a_whole_image_is_refused(tmp_path: Path) -> None:
    path = write_jsonl(tmp_path, images=2)
    for image in (tmp_path / "images").iterdir():
        image.write_bytes(b"no image")
    with pytest.raises(AegisError, match="no image of 'set.jsonl' can be decoded"):
        summary.of_set(str(path), images=True)


def test_families_are_those_of_the_annotations(tmp_path: Path) -> None:
    path = write_official(tmp_path)
    for named in (path, tmp_path):  # the file, or its folder
        found = summary.of_set(str(named))
        families = Counter({each.name: each.questions for each in found.families})
        assert families == {"number": 24, "other": 24}
        assert found.answer_words == {"median": 1, "most": 1}
    assert found.answers_a_question == {"least": 10, "most": 10}


def test_the_command_tells_and_draws_them(tmp_path: Path, aegis) -> None:
    path, sheet = write_jsonl(tmp_path, extra=_BAD), tmp_path / "sheet.png"
    code, out, _ = aegis("inspect", path, "--plot", sheet)
    assert code == 0 and "--skip-bad leaves out" in out and "line 49" in out
    with Image.open(sheet) as drawn:
        width, height = drawn.size
    assert width > 3 * 384 and height > 2 * 384  # six images in two lines
    report = json.loads(aegis("inspect", path, "--verify", "--json")[1])
    assert (report["kind"], report["questions"], report["bad"]) == ("questions", 48, 3)
    assert json.loads(aegis("inspect", "easy-vqa", "--json")[1])["images"] == 5000
    assert "--plot" in refused(aegis("inspect", path, "--plot", tmp_path / "sheet.pdf"))


def test_other_files_of_such_names_say_what_they_lack(tmp_path: Path, aegis) -> None:
    other = tmp_path / "metrics.jsonl"
    other.write_text('{"step": 1, "loss": 0.5}\n')
    assert "no image and no question" in refused(aegis("inspect", other))


def test_a_folder_that_is_something_else_is_no_set(tmp_path: Path, aegis) -> None:
    """A run with a questions file beside its recipe stays a run."""
    write_official(tmp_path)
    (tmp_path / "recipe.yaml").write_text("kind: policy\n")
    assert "recipe.yaml" in refused(aegis("inspect", tmp_path))
