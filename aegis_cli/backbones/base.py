"""What every vision-language backbone offers to the stages."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

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
        image: [T] bool; True at image tokens, False at text.
    """

    hidden: tuple[Tensor, ...]
    keys_values: tuple[KeyValue, ...]
    mask: Tensor
    image: Tensor


# What a module does to tokens is linear in its own parameters, so that its inputs say what VQA uses of it.
SITES: dict[type[nn.Module], str] = {
    nn.Linear: "maps", nn.Conv2d: "maps", nn.LayerNorm: "norms", nn.Embedding: "embeddings",
}  # fmt: skip


def digest(state: Mapping[str, Tensor]) -> str:
    """sha256 of weights: names, shapes and values in float32."""
    whole = hashlib.sha256()
    for name, tensor in sorted(state.items()):
        whole.update(f"{name} {tuple(tensor.shape)}".encode())
        whole.update(tensor.detach().float().cpu().contiguous().numpy().tobytes())
    return whole.hexdigest()


class Backbone(nn.Module, ABC):
    """A VLM that answers questions and lends its layers to an action expert.

    Attributes:
        vision: dotted name of the part that turns pixels into tokens.
        tied_heads: embedding table -> the module whose output is scored against its rows.
        image_size: side in pixels of the square images it reads; None: images of any size.
    """

    vision: str
    tied_heads: ClassVar[Mapping[str, str]] = {}
    image_size: int | None = None
    depth: int
    width: int
    heads: int
    head_dim: int

    @abstractmethod
    def prepare(self, images: Tensor, prompts: Sequence[str]) -> Batch:
        """Images and one prompt each, as the model's own VQA path wants them.

        Images, here and below: [B, H, W, 3] uint8; to a model without an `image_size` also a list of [H, W, 3].
        """

    @abstractmethod
    def encode(self, batch: Batch) -> Encoding:
        """Forward over image and prompt tokens."""

    @abstractmethod
    def answer(self, images: Tensor, questions: Sequence[str]) -> list[str]:
        """Greedy autoregressive answers."""

    @abstractmethod
    def answer_log_likelihood(self, images: Tensor, questions: Sequence[str], answers: Sequence[str]) -> Tensor:
        """log p(answer and its end | image, question) in nats, summed over tokens: [B] float32, with its graph."""

    @abstractmethod
    def read_vqa(
        self, images: Tensor, image_of: Tensor, questions: Sequence[str], answers: Sequence[str]
    ) -> Iterator[Tensor]:
        """Read questions with their answers, and nothing but valid tokens, for whoever watches the modules.

        Each image is passed once and every text without padding, so that a forward hook needs no mask.

        Args:
            images: [N, H, W, 3] uint8.
            image_of: [M] int64, the image of each question.
            questions, answers: M texts each.

        Yields:
            Scores [n, V] of the words of some questions' answers, in parts that together cover all; with
            their graph where gradients are enabled.
        """

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

    def check_text(self, question: str, answer: str) -> None:
        """Raise AegisError where the model cannot read a question with its answer; most read anything."""

    def sites(self) -> dict[str, str]:
        """Dotted name -> kind (maps, norms, embeddings, stem) of every module that owns parameters."""
        owners = {name: module for name, module in self.named_modules() if any(True for _ in module.parameters(recurse=False))}
        if unknown := sorted({type(m).__name__ for m in owners.values() if type(m) not in SITES}):
            raise NotImplementedError(f"what {', '.join(unknown)} reads on VQA cannot be measured yet")
        kinds = {name: SITES[type(module)] for name, module in owners.items()}
        return {name: "stem" if name.startswith(f"{self.vision}.") else kind for name, kind in kinds.items()}

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device
