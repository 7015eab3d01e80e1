"""Packing: inputs are recovered, and a mirrored scene gets the answers of a mirrored scene."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
from samples.vqa_truth import SCENES, WORDS, truth

from aegis_cli.data.vqa.packing import mirror, mirror_cells, mirror_words, pack
from aegis_cli.data.vqa.questions import FAMILIES, Question, cell_labels
from aegis_cli.data.vqa.things import IMAGE_SIZE, Scene
from aegis_cli.models.backbones.tokenizer import Tokenizer
from aegis_cli.pretraining.vlm import BLOCK_TOKENS, BLOCKS, SHARES

ENCODE = Tokenizer(WORDS).encode


def unpack(ids: np.ndarray, prompt_length: int) -> tuple[str, str]:
    """(question, answer) of one block, read token by token."""
    assert WORDS[ids[prompt_length - 1]] == "<answer>"
    words = [WORDS[i] for i in ids]
    end = words.index("<end>")
    assert set(words[end + 1 :]) <= {"<pad>"}
    return " ".join(words[: prompt_length - 1]), " ".join(words[prompt_length:end])


def unpack_image(ids: np.ndarray, prompt_length: np.ndarray) -> list[tuple[str, str]]:
    assert not ids[prompt_length == 0].any()
    return [unpack(block, int(n)) for block, n in zip(ids, prompt_length, strict=True) if n]


def test_packed_questions_come_back(scenes) -> None:
    packed = pack([questions for _, questions in scenes], ENCODE, BLOCKS, BLOCK_TOKENS)
    assert packed.ids.shape == (SCENES, BLOCKS, BLOCK_TOKENS)
    for (_, questions), ids, length in zip(scenes, packed.ids, packed.prompt_length, strict=True):
        assert sorted(unpack_image(ids, length)) == sorted((q.text, q.answer) for q in questions)
        sizes = (ids != 0).sum(-1)
        assert (np.diff(sizes) >= 0).all()  # empty blocks, then short ones, then long ones


def test_shares_are_cut_to_their_longest_block_and_lose_nothing(scenes) -> None:
    packed = pack([questions for _, questions in scenes], ENCODE, BLOCKS, BLOCK_TOKENS)
    rows = np.array([5, 0, 7])
    parts = [packed.blocks(rows, share) for share in SHARES]
    assert parts[0][0].shape[-1] < parts[1][0].shape[-1] <= BLOCK_TOKENS
    assert all((ids[..., -1] != 0).any() for ids, _ in parts)
    for i, row in enumerate(rows):
        found = [pair for ids, length in parts for pair in unpack_image(ids[i], length[i])]
        assert sorted(found) == sorted((q.text, q.answer) for q in scenes[row][1])


def mirrored(scene: Scene) -> Scene:
    """The mirrored scene, built from its things: independent of the token maps."""
    return Scene(
        scene.image[:, ::-1], tuple(replace(t, x_px=IMAGE_SIZE - t.x_px) for t in scene.things)
    )


def test_a_mirrored_scenes_answers_are_true_and_the_others_are_left_alone(scenes) -> None:
    packed = pack([questions for _, questions in scenes], ENCODE, BLOCKS, BLOCK_TOKENS)
    family_of = {q.text: q.family for _, questions in scenes for q in questions}
    images = np.stack([scene.image for scene, _ in scenes])
    flip = np.arange(SCENES) % 3 > 0
    before = packed.ids.copy(), images.copy()
    turned, blocks = mirror(images, packed.ids, packed.prompt_length, flip, mirror_words(WORDS))
    assert np.array_equal(packed.ids, before[0]) and np.array_equal(
        images, before[1]
    )  # the set itself is unchanged
    assert np.array_equal(blocks[~flip], packed.ids[~flip]) and np.array_equal(
        turned[~flip], images[~flip]
    )
    checked = Counter()
    for i in np.flatnonzero(flip):
        scene = mirrored(scenes[i][0])
        assert np.array_equal(turned[i], scene.image)
        for (text, answer), (old, _) in zip(
            *(unpack_image(b[i], packed.prompt_length[i]) for b in (blocks, packed.ids))
        ):
            question = Question(family_of[old], text, answer)
            assert answer == truth(question, scene.things), question
            checked[question.family] += 1
    assert set(checked) == set(FAMILIES) and min(checked.values()) > 50


def test_mirroring_twice_is_nothing(scenes) -> None:
    packed = pack([questions for _, questions in scenes], ENCODE, BLOCKS, BLOCK_TOKENS)
    images, words = np.stack([scene.image for scene, _ in scenes]), mirror_words(WORDS)
    everywhere = np.ones(SCENES, bool)
    once = mirror(images, packed.ids, packed.prompt_length, everywhere, words)
    twice = mirror(*once[:1], once[1], packed.prompt_length, everywhere, words)
    assert not np.array_equal(once[1], packed.ids)
    assert np.array_equal(twice[0], images) and np.array_equal(twice[1], packed.ids)


def test_mirrored_cells_are_those_of_the_mirrored_scene(scenes) -> None:
    cells = np.stack([cell_labels(scene) for scene, _ in scenes])
    flip = np.arange(SCENES) % 2 == 0
    expected = [
        cell_labels(mirrored(scene) if turn else scene)
        for (scene, _), turn in zip(scenes, flip, strict=True)
    ]
    assert np.array_equal(mirror_cells(cells, flip), np.stack(expected))
