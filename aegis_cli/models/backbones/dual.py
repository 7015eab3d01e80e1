"""The interface of every dual encoder: an image and a text tower, as in CLIP.

Streams of classification tasks are learned with these.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from aegis_cli.models.structure import digest


class DualEncoder(nn.Module, ABC):
    """An image and a text tower whose features share a unit sphere (CLIP, arXiv 2103.00020).

    Attributes:
        image_size: side in pixels of the square images it reads.
        width: D, size of a feature.
    """

    image_size: int
    width: int

    @abstractmethod
    def pixels(self, images: Tensor) -> Tensor:
        """Images [B, S, S, 3] uint8, S = `image_size` -> the image tower's input, float32."""

    @abstractmethod
    def image_features(self, pixels: Tensor) -> Tensor:
        """[B, D] float32, each row of length 1."""

    @abstractmethod
    def looks(self, pixels: Tensor) -> Tensor:
        """Mean over positions of the output of the image tower's layer at two thirds of its depth.

        It distinguishes tasks by the look of their images; the last layers represent what a text
        could say about them.

        Returns:
            [B, W] float32.
        """

    @abstractmethod
    def text_features(self, texts: Sequence[str]) -> Tensor:
        """[N, D] float32, each row of length 1.

        Raises:
            AegisError: it cannot read one of the texts.
        """

    @abstractmethod
    def scale(self) -> Tensor:
        """The factor from cosines to logits: a positive number []."""

    @abstractmethod
    def sites(self) -> dict[str, nn.Linear]:
        """Output maps of MLPs and attentions in both towers, by dotted name, for low-rank terms."""

    @abstractmethod
    def in_text(self, site: str) -> bool:
        """Whether a map of `sites` belongs to the text tower."""

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
    """The number, from 1, of the layer whose output `looks` reads: at two thirds of the depth."""
    return max(1, 2 * depth // 3)


def class_weights(encoder: DualEncoder, classes: Sequence[str], templates: Sequence[str]) -> Tensor:
    """The zero-shot classifier [C, D]: each class's mean feature over templates, at length 1.

    Each template contains one "{}" for the class's name.
    """
    texts = [template.format(name) for name in classes for template in templates]
    features = encoder.text_features(texts).view(len(classes), len(templates), -1)
    means = features.mean(1)  # [C, D], shorter than 1 if templates differ
    return nn.functional.normalize(means, dim=-1)
