"""How well a dual encoder classifies the images of stream tasks that it was not trained on."""

from __future__ import annotations

import torch

from aegis_cli.data.streams.contract import Part, StreamTask
from aegis_cli.models.backbones.dual import DualEncoder, class_weights

BATCH = 250


@torch.inference_mode()
def accuracy(encoder: DualEncoder, task: StreamTask, part: Part) -> float:
    """Share of a part's images that are nearest to their own class's mean over all templates."""
    weights = class_weights(encoder, task.classes, task.templates)
    right = 0
    for rows in torch.arange(len(part)).split(BATCH):
        features = encoder.image_features(encoder.pixels(part.images(rows)))  # [B, D]
        nearest = (features @ weights.T).argmax(1).cpu()
        right += int((nearest == part.labels[rows]).sum())
    return right / len(part)
