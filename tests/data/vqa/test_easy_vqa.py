"""easy-VQA: its own split, its families, and the words that a model needs to read it."""

from __future__ import annotations

import sys
from collections import Counter
from importlib import metadata

import easy_vqa
import pytest
from dm_control import suite as published

from aegis_cli.common.errors import AegisError
from aegis_cli.data.vqa import easy, sets
from aegis_cli.data.vqa.dataset import VQASet
from aegis_cli.data.vqa.images import Pictures
from aegis_cli.data.vqa.questions import vocabulary
from aegis_cli.data.vqa.words import wide_vocabulary
from aegis_cli.models.backbones.tokenizer import SPECIAL, Tokenizer
from aegis_cli.sim.suite_table import sentence

METAWORLD = (
    "assembly basketball bin-picking box-close button-press-topdown button-press-topdown-wall "
    "button-press button-press-wall coffee-button coffee-pull coffee-push dial-turn disassemble "
    "door-close door-lock door-open door-unlock hand-insert drawer-close drawer-open faucet-open "
    "faucet-close hammer handle-press-side handle-press handle-pull-side handle-pull lever-pull "
    "peg-insert-side pick-place-wall pick-out-of-hole reach push-back push pick-place plate-slide "
    "plate-slide-side plate-slide-back plate-slide-back-side peg-unplug-side soccer stick-push "
    "stick-pull push-wall reach-wall shelf-place sweep-into sweep window-open window-close"
).split()


@pytest.fixture(scope="module")
def source() -> sets.EasyVqa:
    found = sets.read("easy-vqa")
    assert isinstance(found, sets.EasyVqa)
    return found


def images_of(asked: VQASet) -> set[str]:
    assert isinstance(asked.images, Pictures)
    return {picture.key for picture in asked.images.pictures}


def test_probes_ask_the_published_test_part_and_nothing_else_does(source: sets.EasyVqa) -> None:
    parts = {part: source.choose(part, len(source.entries), 0) for part in sets.PARTS}
    own = {part: images_of(asked) for part, asked in parts.items()}
    assert own["probe"] == {f"test/{i}" for i in range(1000)}
    assert own["anchor"] == own["train"] and not own["anchor"] & own["validation"]
    assert own["train"] | own["validation"] == {f"train/{i}" for i in range(4000)}
    assert 300 <= len(own["validation"]) <= 500
    texts, answers, _ = easy_vqa.get_test_questions()
    asked = Counter((q.text, q.answer) for q in parts["probe"].questions)
    assert asked == Counter(zip(texts, answers))


def test_a_question_has_its_own_picture_in_its_own_size(source: sets.EasyVqa) -> None:
    asked = source.choose("probe", 40, seed=0).sized(64)
    texts, _, image_ids = easy_vqa.get_test_questions()
    by_image = {(text, f"test/{image}") for text, image in zip(texts, image_ids)}
    assert isinstance(asked.images, Pictures)
    for image, question in zip(asked.image_of, asked.questions):
        assert (question.text, asked.images.pictures[image].key) in by_image
    images, _ = next(asked.batches(40))
    assert images.shape == (40, 64, 64, 3)


@pytest.mark.parametrize(
    ("text", "family"),
    [
        ("what color is the shape?", "color"),
        ("what is the color of the circle?", "color"),
        ("what shape does the image contain?", "shape"),
        ("what is the blue shape?", "shape"),
        ("is there a red shape in the image?", "exists"),
        ("does the image contain a circle?", "exists"),
        ("is no teal shape present?", "exists-not"),
        ("does the image not contain a circle?", "exists-not"),
    ],
)
def test_families(text: str, family: str) -> None:
    assert easy.family(text) == family


def test_the_answers_of_a_family_are_of_one_kind(source: sets.EasyVqa) -> None:
    answers: dict[str, set[str]] = {family: set() for family in easy.FAMILIES}
    for entry in source.entries:
        answers[entry.question.family].add(entry.question.answer)
    assert answers["shape"] == {"circle", "rectangle", "triangle"}
    assert answers["exists"] == answers["exists-not"] == {"yes", "no"}
    assert len(answers["color"]) == 8 and answers["color"] < set(easy_vqa.get_answers())


def test_the_wide_vocabulary_reads_questions_and_instructions(source: sets.EasyVqa) -> None:
    tokenizer = Tokenizer((*SPECIAL, *wide_vocabulary()))
    for entry in source.entries:
        ids = tokenizer.encode(entry.question.text)
        assert tokenizer.vocabulary[ids[-1]] == "?" and len(ids) <= 10
        tokenizer.encode(entry.question.answer)
    for domain, task in published.ALL_TASKS:
        tokenizer.encode(sentence(f"suite/{domain}-{task}"))
    for name in METAWORLD:
        tokenizer.encode(name.replace("-", " ").replace("picking", "pick"))


def test_the_wide_vocabulary_begins_with_that_of_scenes() -> None:
    words = wide_vocabulary()
    assert words[: len(vocabulary())] == vocabulary() and len(set(words)) == len(words)


def test_a_vocabulary_without_a_question_mark_refuses_it() -> None:
    with pytest.raises(AegisError, match="the word 'cube\\?'"):
        Tokenizer((*SPECIAL, *vocabulary())).encode("what color is the cube?")


def test_no_question_is_an_instruction(source: sets.EasyVqa) -> None:
    asked = {entry.question.text.rstrip("?") for entry in source.entries}
    said = {sentence(f"suite/{domain}-{task}") for domain, task in published.ALL_TASKS}
    assert not asked & said


def test_a_missing_package_is_named_with_its_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "easy_vqa", None)
    with pytest.raises(AegisError, match="no package 'easy_vqa'") as caught:
        sets.read("easy-vqa")
    assert "pip install 'aegis-vla[easy-vqa]'" in caught.value.fix


def test_another_version_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metadata, "version", lambda _: "1.1")
    with pytest.raises(AegisError, match="easy-vqa 1.1") as caught:
        sets.read("easy-vqa")
    assert caught.value.expected == "version 1.0"


def test_its_state_is_the_same_on_every_machine(source: sets.EasyVqa) -> None:
    """A cell's key contains it, so file times must not."""
    (name, digests), *more = source.state.items()
    assert name == "question_files" and not more
    assert {key: value[:16] for key, value in digests.items()} == {
        "vqa/easy-vqa/train": "bb67697636aed0e6",
        "vqa/easy-vqa/test": "0d4630a51bafec65",
    }
