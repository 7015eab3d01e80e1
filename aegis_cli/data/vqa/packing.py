"""Pack an image's questions as blocks of tokens that share one image pass."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from aegis_cli.data.vqa.questions import GRID, X_WORDS, Question


@dataclass(frozen=True)
class Packed:
    """Token blocks of N images, the shorter questions of an image first.

    Attributes:
        ids: [N, Q, S] uint16: question, answer marker, answer, end, padding.
        prompt_length: [N, Q] uint8: tokens up to and including the answer marker; 0 marks an empty
            block.
    """

    ids: np.ndarray
    prompt_length: np.ndarray

    def blocks(self, rows: np.ndarray, share: slice) -> tuple[np.ndarray, np.ndarray]:
        """The blocks `share` of some images, cut to the longest of them.

        These are ids [B, Q', S'] and prompt_length [B, Q'].
        """
        ids = self.ids[rows, share]  # [B, Q', S]
        longest = int((ids != 0).sum(-1).max())
        return ids[..., :longest].astype(np.int64), self.prompt_length[rows, share].astype(np.int64)


def pack(
    questions: Sequence[Sequence[Question]],
    encode: Callable[[str], list[int]],
    blocks: int,
    length: int,
) -> Packed:
    """Tokenise up to `blocks` questions per image.

    Args:
        encode: a text -> its tokens. Token 0 is padding, 1 the answer marker and 2 the end.
        blocks, length: Q and S.
    """
    ids = np.zeros((len(questions), blocks, length), np.uint16)
    prompt_length = np.zeros((len(questions), blocks), np.uint8)
    for n, asked in enumerate(questions):
        rows = [(encode(q.text), encode(q.answer)) for q in asked]
        # By length, so that a share of the blocks, cut to its longest, has little padding.
        rows.sort(key=lambda row: len(row[0]) + len(row[1]))
        # Empty blocks come first, being the shortest.
        for b, (question, answer) in enumerate(rows, start=blocks - len(rows)):
            tokens = [*question, 1, *answer, 2]
            ids[n, b, : len(tokens)] = tokens
            prompt_length[n, b] = len(question) + 1
    return Packed(ids, prompt_length)


def mirror_words(vocabulary: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """Token maps for a mirrored image: for all positions, and for answers (left and right too)."""
    everywhere = np.arange(len(vocabulary))
    for i, name in enumerate(X_WORDS):
        everywhere[vocabulary.index(name)] = vocabulary.index(X_WORDS[GRID - 1 - i])
    in_answer = everywhere.copy()
    left, right = vocabulary.index("left"), vocabulary.index("right")
    in_answer[[left, right]] = right, left
    return everywhere, in_answer


def mirror(
    images: np.ndarray,
    blocks: np.ndarray,
    prompt_length: np.ndarray,
    flip: np.ndarray,
    words: tuple[np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Mirror the images [B, H, W, 3] where `flip` [B] is True, and swap the location words."""
    images, blocks = images.copy(), blocks.copy()
    images[flip] = images[flip][:, :, ::-1]  # the third axis is the width
    turned = blocks[flip]
    # In a question, "left or right" lists the possible answers; in an answer the words are swapped.
    answer = np.arange(blocks.shape[-1]) >= prompt_length[flip][..., None]
    blocks[flip] = np.where(answer, words[1][turned], words[0][turned])
    return images, blocks


def mirror_cells(cells: np.ndarray, flip: np.ndarray) -> np.ndarray:
    """Cell labels [B, 64] of images, mirrored where `flip` [B] is True."""
    grid = cells.reshape(-1, GRID, GRID)  # rows from top to bottom
    mirrored = np.where(flip[:, None, None], grid[:, :, ::-1], grid)
    return mirrored.reshape(len(cells), -1)
