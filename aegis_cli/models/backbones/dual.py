"""The interface of every dual encoder: an image and a text tower, as in CLIP.

Streams of classification tasks learn on these.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from aegis_cli.models.structure import digest


class DualEncoder(nn.Module, ABC):
    """An image and a text tower whose features lie on one unit sphere (CLIP, arXiv 2103.00020).

    Attributes:
        image_size: side in pixels of the square images it reads.
        width: D, size of a feature.
    """

    image_size: int
    width: int

    @abstractmethod
    def pixels(self, images: Tensor) -> Tensor:
        """Images [B, S, S, 3] uint8, S = `image_size` -> what the image tower reads, float32."""

    @abstractmethod
    def image_features(self, pixels: Tensor) -> Tensor:
        """[B, D] float32, each row of length 1."""

    @abstractmethod
    def looks(self, pixels: Tensor) -> Tensor:
        """Mean over positions of the output of the image tower's layer at two thirds of its depth.

        It tells tasks apart by what their images look like; the last layers make of them what a
        text could say.

        Returns:
            [B, W] float32.
        """

    @abstractmethod
    def text_features(self, texts: Sequence[str]) -> Tensor:
        """[N, D] float32, each row of length 1.

        Raises:
            AegisError: a text that it cannot read.
        """

    @abstractmethod
    def scale(self) -> Tensor:
        """What cosines are multiplied by to become logits: a positive number []."""

    @abstractmethod
    def sites(self) -> dict[str, nn.Linear]:
        """Output maps of MLPs and attentions in both towers, by dotted name, for low-rank terms."""

    @abstractmethod
    def in_text(self, site: str) -> bool:
        """Whether a map of `sites` is one of the text tower's."""

    @abstractmethod
    def save(self, folder: Path) -> None:
        """Write a plain, loadable dual encoder."""

    def fingerprint(self) -> str:
        """sha256 of the weights: names, shapes and values."""
        return digest(self.state_dict())

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device


def early_layer(depth: int) -> int:
    """Number, from 1, of the layer whose output `looks` reads: at two thirds of the depth."""
    return max(1, 2 * depth // 3)


def class_weights(encoder: DualEncoder, classes: Sequence[str], templates: Sequence[str]) -> Tensor:
    """The zero-shot classifier [C, D]: each class's mean feature over templates, at length 1.

    Each template holds one "{}", which the class's name takes the place of.
    """
    texts = [template.format(name) for name in classes for template in templates]
    features = encoder.text_features(texts).view(len(classes), len(templates), -1)
    means = features.mean(1)  # [C, D], shorter than 1 where templates differ
    return nn.functional.normalize(means, dim=-1)
