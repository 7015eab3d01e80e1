"""What every vision-language backbone offers to the stages."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from aegis_cli.core.attention import KeyValue


@dataclass(frozen=True)
class Batch:
    """A prepared batch: `pixels` [B, 3, H, W] float32, `ids` [B, S] int64, `mask` [B, S] bool (True: a token)."""

    pixels: Tensor
    ids: Tensor
    mask: Tensor


@dataclass(frozen=True)
class Encoding:
    """One pass over images and prompts.

    Attributes:
        hidden: residual stream after each transformer layer, L tensors [B, T, D].
        keys_values: each layer's keys and values, L pairs [B, heads, T, head_dim].
        mask: [B, T] bool; padding is False.
    """

    hidden: tuple[Tensor, ...]
    keys_values: tuple[KeyValue, ...]
    mask: Tensor


class Backbone(nn.Module, ABC):
    """A VLM that answers questions and lends its layers to an action expert."""

    depth: int
    width: int
    heads: int
    head_dim: int

    @abstractmethod
    def prepare(self, images: Tensor, prompts: Sequence[str]) -> Batch:
        """Images [B, H, W, 3] uint8 and one prompt each, as the model's own VQA path wants them."""

    @abstractmethod
    def encode(self, batch: Batch) -> Encoding:
        """Forward over image and prompt tokens."""

    @abstractmethod
    def answer(self, images: Tensor, questions: Sequence[str]) -> list[str]:
        """Greedy autoregressive answers."""

    @abstractmethod
    def answer_log_likelihood(self, images: Tensor, questions: Sequence[str], answers: Sequence[str]) -> Tensor:
        """log p(answer and its end | image, question) in nats, summed over tokens: [B] float32."""

    @abstractmethod
    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Every parameter in exactly one group: `layers.{i}` for each layer, and the remaining parts by name."""

    @abstractmethod
    def language_maps(self) -> dict[str, nn.Linear]:
        """The language layers' linear maps by dotted name: where LoRA goes."""

    @abstractmethod
    def save(self, folder: Path) -> None:
        """Write a plain, loadable VLM."""

    @abstractmethod
    def fingerprint(self) -> str:
        """sha256 of the weights: names, shapes and values."""

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device
