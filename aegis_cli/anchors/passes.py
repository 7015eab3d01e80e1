"""VQA passes of our backbones for the recorders: each image once, each question once."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from aegis_cli.common.events import OnEvent, Progress
from aegis_cli.data.vqa.images import tensors
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.models.structure import Maps

if TYPE_CHECKING:  # the guard comes here, and has no use for a renderer of scenes
    from aegis_cli.data.vqa.dataset import VQASet

IMAGES = 32  # in a pass at most: the unfolded patches of a convolution take a few MB an image
QUESTIONS = 8  # at most, where each takes a pass of its image of its own


def maps_of(model: Backbone) -> Maps:
    """The maps of a backbone as its family names them, where `structure.find_maps` would guess.

    Raises:
        AegisError: modules whose parameters are used in a way that no inputs describe.
    """
    return Maps(kinds=model.sites(), twins={}, heads=dict(model.tied_heads), unknown={})


def run(
    model: Backbone, asked: VQASet, batch_size: int, stage: str, on_event: OnEvent
) -> Iterator[Tensor]:
    """Pass the whole set, up to `batch_size` images at a time with all their questions.

    Yields:
        The scores [n, V] of the answers' words, part by part.
    """
    image_of, step = torch.from_numpy(asked.image_of), min(IMAGES, batch_size)
    for first in range(0, len(asked.images), step):
        rows = ((image_of >= first) & (image_of < first + step)).nonzero().squeeze(1)
        images = tensors(asked.images[first : first + step])
        questions = [asked.questions[i] for i in rows.tolist()]
        texts, answers = [q.text for q in questions], [q.answer for q in questions]
        yield from model.read_vqa(
            images, image_of[rows] - first, texts, answers, min(QUESTIONS, batch_size)
        )
        on_event(Progress(stage, min(first + step, len(asked.images)), len(asked.images), "images"))
