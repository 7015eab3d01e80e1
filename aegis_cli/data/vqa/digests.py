"""Digests that tell questions apart by their words and by the bytes of their images."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from aegis_cli.common import files, kept_digests
from aegis_cli.data.vqa.dataset import VQASet


def of_questions(asked: VQASet) -> list[str]:
    """A digest of each question, its reference answer and its image."""
    images = _of_images(asked)
    return [
        files.sha256_value([question.text, question.answer, images[number]])
        for question, number in zip(asked.questions, asked.image_of.tolist(), strict=True)
    ]


def _of_images(asked: VQASet) -> Mapping[int, str]:
    """A digest of each image that is asked about, by its number."""
    numbers = sorted(set(asked.image_of.tolist()))
    images = asked.images
    if isinstance(images, np.ndarray):
        return {number: hashlib.sha256(images[number].tobytes()).hexdigest() for number in numbers}
    sources = {number: images.pictures[number].source for number in numbers}
    paths = {number: source for number, source in sources.items() if isinstance(source, Path)}
    found: dict[int, str] = {}
    if paths:
        of_files = kept_digests.of_files(paths.values(), min(paths.values()).parent)
        found = {number: of_files[path] for number, path in paths.items()}
    for number, source in sources.items():
        if not isinstance(source, Path):
            found[number] = hashlib.sha256(source()).hexdigest()
    return found
