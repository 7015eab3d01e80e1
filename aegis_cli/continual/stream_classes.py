"""A classification task as something to learn from: pictures of classes, told apart by the classes'
names.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from aegis_cli.data.streams.contract import StreamTask
from aegis_cli.models.backbones.dual import DualEncoder, class_weights

# Training images, evenly spaced, on which routers are measured: always the same, so nothing is
# drawn, and no more than a step has, since they need a gradient too.
GAUGE_IMAGES = 64


class Classes:
    """Cross-entropy over a task's own classes, whose names stand in the first template."""

    def __init__(self, task: StreamTask, encoder: DualEncoder, label_smoothing: float) -> None:
        self.name, self.size = task.name, len(task.train)
        self._task, self._encoder, self._smoothing = task, encoder, label_smoothing
        rows = torch.linspace(0, self.size - 1, min(GAUGE_IMAGES, self.size)).long()
        self._gauge = self.fetch(rows)
        self._texts: Tensor | None = (
            None  # the classes' features [C, D] as long as nothing that learns acts on them
        )

    def fetch(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Images and labels [B]."""
        return self._task.train.images(rows), self._task.train.labels[rows]

    def loss(self, batch: tuple[Tensor, Tensor], step: int) -> Tensor:
        return self._loss(batch, self._class_features)

    def gauge(self) -> Tensor:
        return self._loss(self._gauge, self._class_weights)

    def changed(self) -> None:
        self._texts = None

    def _loss(self, batch: tuple[Tensor, Tensor], texts: Callable[[], Tensor]) -> Tensor:
        images, labels = batch
        features = self._encoder.image_features(self._encoder.pixels(images))
        logits = self._encoder.scale() * features @ texts().T
        return nn.functional.cross_entropy(
            logits.float(), labels.to(logits.device), label_smoothing=self._smoothing
        )

    def _class_features(self) -> Tensor:
        if self._texts is not None:
            return self._texts
        found = self._class_weights()
        if not found.requires_grad and torch.is_grad_enabled():
            self._texts = found
        return found

    def _class_weights(self) -> Tensor:
        return class_weights(self._encoder, self._task.classes, self._task.templates[:1])
