"""Scenes, questions and sets of them: pictures match their labels, and answers are true."""

from __future__ import annotations

import colorsys
import math
import os
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from samples.vqa_truth import CELL_PX, FORMS, SCENES, WORDS, cell_of, only, truth

from aegis_cli import sim
from aegis_cli.common.errors import AegisError
from aegis_cli.common.palette import COLORS, RGB
from aegis_cli.data.vqa import dataset
from aegis_cli.data.vqa.dataset import VQASet, load_scenes, render_training
from aegis_cli.data.vqa.questions import FAMILIES, GRID, cell_labels, majority_share
from aegis_cli.data.vqa.scenes import SPLITS, SceneRenderer, renderer_of_thread, scene_rng
from aegis_cli.data.vqa.things import IMAGE_SIZE, SHAPES
from aegis_cli.models.backbones.embedded import MAX_ANSWER, MAX_TEXT
from aegis_cli.models.backbones.tokenizer import Tokenizer
from aegis_cli.pretraining.vlm import BLOCK_TOKENS

# Over 300 scenes the most common answer of a family may not exceed this share: chance is 1/8,
# 1/3, 1/4, ... 1/64.
MOST = {
    "color": 0.16,
    "shape": 0.38,
    "count": 0.34,
    "count-kind": 0.32,
    "exists": 0.54,
    "side": 0.55,
    "where": 0.06,
}
TASK_NAMES = sorted(sim.TASKS)


@pytest.fixture(scope="module")
def one_each() -> VQASet:
    return load_scenes("validation", 7 * SCENES // 3)


def hue_of(rgb: np.ndarray | tuple[float, float, float]) -> str:
    """The palette's colour with the nearest hue."""
    hue = colorsys.rgb_to_hsv(*rgb)[0]
    gap = {name: abs(hue - colorsys.rgb_to_hsv(*color)[0]) for name, color in RGB.items()}
    return min(gap, key=lambda name: min(gap[name], 1 - gap[name]))


# --- scenes -------------------------------------------------------------------------------------


def test_a_scene_is_a_function_of_seed_split_and_index() -> None:
    first, second = SceneRenderer(), SceneRenderer()
    second.render(scene_rng(9, "train", 9))  # earlier draws leave no trace
    for index in range(5):
        a, b = (
            first.render(scene_rng(3, "probe", index)),
            second.render(scene_rng(3, "probe", index)),
        )
        assert a.things == b.things and np.array_equal(a.image, b.image)
    first.close(), second.close()


def test_seeds_splits_and_indices_all_give_other_scenes() -> None:
    renderer = SceneRenderer()
    keys = [(seed, split, index) for seed in (0, 1) for split in SPLITS for index in range(10)]
    images = {renderer.render(scene_rng(*key)).image.tobytes() for key in keys}
    renderer.close()
    assert len(images) == len(keys) == 80


def test_a_things_centre_shows_its_colour(scenes) -> None:
    """The labels' positions and colours match the picture: no axis or thing is swapped."""
    shown = [
        hue_of(scene.image[int(thing.y_px), int(thing.x_px)] / 255) == thing.color
        for scene, _ in scenes
        for thing in scene.things
    ]
    assert len(shown) > SCENES and np.mean(shown) >= 0.98  # clutter may hide a few


def test_the_floor_shows_where_nothing_stands(scenes) -> None:
    """A thing covers its centre but nothing two radii away, as its size says."""
    alone = [scene for scene, _ in scenes if len(scene.things) == 1]
    colourful = []
    for scene in alone:
        y, x = np.mgrid[:IMAGE_SIZE, :IMAGE_SIZE] + 0.5
        away = np.hypot(x - scene.things[0].x_px, y - scene.things[0].y_px) > 16
        spread = (
            np.ptp(scene.image.astype(int), axis=-1) > 90
        )  # range over a pixel's channels: floor and clutter are grey
        colourful.append((spread & away).mean())
    assert len(alone) > 30 and np.mean(colourful) < 0.002


def test_things_keep_apart_and_inside(scenes) -> None:
    counts = Counter(len(scene.things) for scene, _ in scenes)
    assert set(counts) == {1, 2, 3, 4} and min(counts.values()) > SCENES / 8
    for scene, _ in scenes:
        for i, one in enumerate(scene.things):
            assert 5 <= one.x_px <= IMAGE_SIZE - 5 and 5 <= one.y_px <= IMAGE_SIZE - 5
            for other in scene.things[:i]:
                assert math.hypot(one.x_px - other.x_px, one.y_px - other.y_px) > 9


def test_every_colour_shape_and_cell_occurs(scenes) -> None:
    things = [thing for scene, _ in scenes for thing in scene.things]
    kinds = Counter((t.color, t.shape) for t in things)
    assert set(kinds) == {(c, s) for c in COLORS for s in SHAPES}
    assert len({cell_of(t) for t in things}) == GRID * GRID


# --- questions ----------------------------------------------------------------------------------


@pytest.mark.parametrize("family", FAMILIES)
def test_every_answer_is_true_and_every_name_means_one_thing(family: str, scenes) -> None:
    asked = [
        (q, scene.things) for scene, questions in scenes for q in questions if q.family == family
    ]
    assert len(asked) > SCENES / 2
    wrong = [(q, things) for q, things in asked if q.answer != truth(q, things)]
    assert not wrong, wrong[:3]


def test_sides_are_far_enough_apart_to_see(scenes) -> None:
    sides = [
        (re.fullmatch(FORMS["side"], q.text), s.things)
        for s, qs in scenes
        for q in qs
        if q.family == "side"
    ]
    gaps = [
        abs(only(m["thing"], things).x_px - only(m["other"], things).x_px) for m, things in sides
    ]
    assert min(gaps) >= 6


@pytest.mark.parametrize("family", FAMILIES)
def test_answers_are_balanced(family: str, one_each: VQASet) -> None:
    asked = [q for q in one_each.questions if q.family == family]
    assert len(asked) == SCENES // 3
    assert majority_share(asked) <= MOST[family] + 0.03
    answers = {
        "color": 8,
        "shape": 3,
        "count": 4,
        "count-kind": 4,
        "exists": 2,
        "side": 2,
        "where": 40,
    }
    assert len({q.answer for q in asked}) >= answers[family]


@pytest.mark.parametrize("family", FAMILIES)
def test_answers_of_the_training_mix_are_balanced(family: str, scenes) -> None:
    assert (
        majority_share(q for _, questions in scenes for q in questions if q.family == family)
        <= MOST[family]
    )


def test_no_scene_is_asked_the_same_twice(scenes) -> None:
    for _, questions in scenes:
        assert len({(q.family, q.text) for q in questions}) == len(questions)


def test_the_vocabulary_holds_every_word(scenes, one_each: VQASet) -> None:
    assert len(set(WORDS)) == len(WORDS) < 256  # ids are stored as uint8
    tokenizer = Tokenizer(WORDS)
    for q in [*one_each.questions, *(q for _, questions in scenes for q in questions)]:
        prompt, answer = tokenizer.prompt(q.text), tokenizer.encode(q.answer)
        assert (
            len(prompt) + len(answer) + 1 <= min(MAX_TEXT, BLOCK_TOKENS)
            and len(answer) < MAX_ANSWER
        )
        assert tokenizer.decode(prompt[:-1]) == q.text and tokenizer.decode(answer) == q.answer


@pytest.mark.parametrize("task", TASK_NAMES)
def test_the_vocabulary_holds_every_instruction(task: str) -> None:
    tokenizer = Tokenizer(WORDS)
    texts = [
        template.format(color=color)
        for template in sim.make(task).spec.templates
        for color in COLORS
    ]
    assert len(set(texts)) == len(texts) >= 3 * len(COLORS)
    for text in texts:
        assert (
            tokenizer.decode(tokenizer.prompt(text)[:-1]) == text
            and len(tokenizer.prompt(text)) <= MAX_TEXT
        )


def test_cell_labels_say_what_stands_where(scenes) -> None:
    for scene, _ in scenes[:50]:
        labels = cell_labels(scene).reshape(GRID, GRID)
        assert (labels > 0).sum() == len({cell_of(t) for t in scene.things})
        for thing in scene.things:
            label = int(labels[int(thing.y_px) // CELL_PX, int(thing.x_px) // CELL_PX])
            assert (COLORS[(label - 1) // 3], SHAPES[(label - 1) % 3]) == (thing.color, thing.shape)


# --- sets ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("questions", [1, 7, 40, 73])
def test_quotas(questions: int) -> None:
    made = load_scenes("probe", questions)
    counts = Counter(q.family for q in made.questions)
    assert len(made.questions) == questions == counts.total()
    assert max(counts.values()) - min(counts[family] for family in FAMILIES) <= 1


@pytest.mark.parametrize(
    "draw", [lambda count: load_scenes("probe", count), lambda count: render_training(0, count)]
)
def test_more_scenes_than_anybody_waits_for_are_refused_before_the_first(
    draw: Callable[[int], object],
) -> None:
    with pytest.raises(AegisError, match="at most 10,000,000"):
        draw(10**12)


def test_image_of_points_at_the_scene_that_was_asked_about() -> None:
    made = load_scenes("probe", 70)
    renderer = SceneRenderer()
    rendered = [renderer.render(scene_rng(0, "probe", index)) for index in range(100)]
    renderer.close()
    things = {scene.image.tobytes(): scene.things for scene in rendered}
    assert sorted(set(made.image_of.tolist())) == list(
        range(len(made.images))
    )  # nothing is rendered in vain
    for row, question in zip(made.image_of, made.questions, strict=True):
        assert question.answer == truth(question, things[made.images[row].tobytes()])


def test_a_set_is_a_function_of_split_size_and_seed() -> None:
    a, b = load_scenes("anchor", 30, seed=1), load_scenes("anchor", 30, seed=1)
    assert (
        a.questions == b.questions
        and np.array_equal(a.images, b.images)
        and np.array_equal(a.image_of, b.image_of)
    )
    others = (load_scenes("anchor", 30, seed=2), load_scenes("probe", 30, seed=1))
    assert not any(
        one.tobytes() in {i.tobytes() for i in other.images} for other in others for one in a.images
    )


def test_a_longer_set_holds_the_shorter_ones_scenes() -> None:
    short, long = ([i.tobytes() for i in load_scenes("probe", n).images] for n in (35, 140))
    assert short[:5] == long[:5]
    places = [long.index(image) for image in short]
    assert places == sorted(places) and len(long) > len(short)


def test_batches_deal_every_question_once_with_its_image() -> None:
    made = load_scenes("probe", 23)
    dealt = list(made.batches(5))
    assert [len(questions) for _, questions in dealt] == [5, 5, 5, 5, 3]
    assert [q for _, questions in dealt for q in questions] == list(made.questions)
    assert np.array_equal(
        np.concatenate([images for images, _ in dealt]), made.images[made.image_of]
    )


def test_training_scenes_are_the_train_split_whole_and_in_order(scenes) -> None:
    made = render_training(0, 12, workers=1)
    assert np.array_equal(made.images, np.stack([scene.image for scene, _ in scenes[:12]]))
    assert np.array_equal(made.cells, np.stack([cell_labels(scene) for scene, _ in scenes[:12]]))
    assert made.questions == [questions for _, questions in scenes[:12]]


def test_a_rendering_process_that_dies_is_one_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """As when the kernel kills it for its memory: nothing waits for its scenes."""
    monkeypatch.setattr(dataset, "_render_chunk", os._exit)
    with pytest.raises(AegisError, match="a rendering process died"):
        list(dataset._map([1, 1, 1], 2))


def test_a_thread_has_one_renderer_whose_scenes_are_those_of_a_new_one() -> None:
    ours = renderer_of_thread()
    first = [ours.render(scene_rng(3, "train", i)).image for i in range(4)]
    assert renderer_of_thread() is ours
    with ThreadPoolExecutor(1) as other:
        theirs = other.submit(renderer_of_thread).result()
        there = [other.submit(theirs.render, scene_rng(3, "train", i)) for i in range(4)]
        assert theirs is not ours
        assert all((a == b.result().image).all() for a, b in zip(first, there))
    again = [ours.render(scene_rng(3, "train", i)).image for i in reversed(range(4))]
    assert all((a == b).all() for a, b in zip(first, reversed(again)))


def test_questions_do_not_depend_on_the_process() -> None:
    """Sets of words iterate in another order in another process; the questions must not.

    Nor does the renderer print anything at exit if a simulator has been loaded after it.
    """
    code = (
        "from aegis_cli.data.vqa.dataset import load_scenes\n"
        "print(hash('a'), [(q.text, q.answer) for q in load_scenes('probe', 70).questions])\n"
        "import aegis_cli.sim.reach"
    )
    said = []
    for seed in ("1", "2"):
        env = {**os.environ, "PYTHONHASHSEED": seed}
        command = [sys.executable, "-c", code]
        ran = subprocess.run(command, env=env, capture_output=True, text=True, check=True)
        assert ran.stderr == ""
        said.append(ran.stdout)
    (first_hash, first), (second_hash, second) = (line.split(" ", 1) for line in said)
    assert first_hash != second_hash and first == second
