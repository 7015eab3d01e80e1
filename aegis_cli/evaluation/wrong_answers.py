"""A few wrong answers with their images, small enough to keep with a probe's figures."""

from __future__ import annotations

import base64
import struct
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from aegis_cli.data.vqa.dataset import VQASet
from aegis_cli.data.vqa.metrics import Graded

MOST = 12  # answers
_SIDE = 96  # pixels; larger images are subsampled


def examples(graded: Sequence[Graded], asked: VQASet, size: int | None) -> list[dict[str, Any]]:
    """The first wrong answers of a set: one of each family, then a second one, and so on.

    Args:
        graded: answers in the order of the set's questions.
        size: side of the images that the model reads; None: the size in the set.

    Returns:
        Family, question, the answer given, the reference answer, and the image as base64 of a PNG.
    """
    families: dict[str, list[Graded]] = {}
    for answer in graded:
        if not answer.correct:
            families.setdefault(answer.question.family, []).append(answer)
    chosen: list[Graded] = []
    for turn in range(max(map(len, families.values()), default=0)):
        chosen += [own[turn] for own in families.values() if turn < len(own)]
    chosen = chosen[:MOST]
    images = asked.sized(size).images
    return [_example(answer, images[np.array([answer.image])][0]) for answer in chosen]


def _example(answer: Graded, image: np.ndarray) -> dict[str, Any]:
    return {
        "family": answer.question.family,
        "question": answer.question.text,
        "said": answer.said,
        "reference": answer.question.answer,
        "png": encoded(_small(image)),
    }


def encoded(image: np.ndarray) -> str:
    """An image [H, W, 3] uint8 as base64 of a PNG."""
    return base64.b64encode(png(image)).decode()


def _small(image: np.ndarray) -> np.ndarray:
    """Every n-th row and column of an image [H, W, 3], so that its longer side is small."""
    every = -(-max(image.shape[:2]) // _SIDE)  # rounded up, so that no side is larger than that
    return image[::every, ::every]


def png(image: np.ndarray) -> bytes:
    """A PNG of an image [H, W, 3] uint8, written without Pillow, an optional dependency.

    The format is that of ISO/IEC 15948: a header, the zlib-compressed rows, each preceded by the
    number of its filter (0: none), and an end.
    """
    height, width = image.shape[:2]
    rows = np.zeros((height, 1 + 3 * width), np.uint8)
    rows[:, 1:] = np.asarray(image, np.uint8).reshape(height, 3 * width)
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)  # 8 bits, RGB
    chunks = (("IHDR", header), ("IDAT", zlib.compress(rows.tobytes(), 9)), ("IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(name.encode(), data) for name, data in chunks)


def _chunk(name: bytes, data: bytes) -> bytes:
    checksum = zlib.crc32(name + data)
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", checksum)
