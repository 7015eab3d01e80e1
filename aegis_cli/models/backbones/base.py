"""The interface of every vision-language backbone."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor, nn

from aegis_cli.common.devices import send
from aegis_cli.common.errors import AegisError
from aegis_cli.core.attention import KeyValue, Rotation
from aegis_cli.data.batch import Asked, Images
from aegis_cli.models.backbones.compiling import compiled
from aegis_cli.models.structure import (
    averaging,
    digest,
    lone_rows,
    owning_modules,
    site_kind,
    under,
    what_learns,
)

FLOAT32 = "float32"
# Names of the types that weights are stored in.
STORED_TYPES = {
    FLOAT32: torch.float32,
    "bfloat16": torch.bfloat16,
    "float16": torch.float16,
}


class AnswerScores(NamedTuple):
    """Scores of the words of some questions' answers, with their graph.

    Attributes:
        scores: [n, V] unnormalised; those of one answer are together, in the words' order.
        question: [n] int64 on the CPU, the question that each word answers.
    """

    scores: Tensor
    question: Tensor


@dataclass(frozen=True)
class Batch:
    """A prepared batch, rows padded on the right.

    Attributes:
        pixels: [B, 3, H, W] float32, or in the shape that the model's own processor gives them.
        ids: [B, S] int64.
        mask: [B, S] bool; True at tokens, False at padding.
        extra: what else the processor makes for the model, by the model's own names.
    """

    pixels: Tensor
    ids: Tensor
    mask: Tensor
    extra: Mapping[str, Tensor] = field(default_factory=dict)

    def to(self, device: torch.device) -> Batch:
        """The batch on that device; the program goes on while a GPU copies it."""
        extra = {name: send(tensor, device) for name, tensor in self.extra.items()}
        return Batch(
            send(self.pixels, device), send(self.ids, device), send(self.mask, device), extra
        )


@dataclass(frozen=True)
class Encoding:
    """One pass over images and prompts.

    Attributes:
        hidden: residual stream after each transformer layer, L tensors [B, T, D].
        keys_values: each layer's keys and values as the layer attends to them, after any rotary
            embedding: L pairs [B, kv_heads, T, head_dim].
        mask: [B, T] bool; padding is False.
        image: [T] bool, or [B, T] where rows differ; True at image tokens, False at text.
        next_position: [B] int64, the position of a token that would follow each row; None in a
            model that does not rotate its keys by position.
    """

    hidden: tuple[Tensor, ...]
    keys_values: tuple[KeyValue, ...]
    mask: Tensor
    image: Tensor
    next_position: Tensor | None = None


@dataclass(frozen=True)
class Suffix:
    """How S tokens that follow an encoding see it.

    Attributes:
        visible: which tokens of the encoding: [B, T] bool for all layers, or one [B, S, T] per
            layer.
        rotation: the rotary embedding of their own queries and keys, [B, S, head_dim], for all
            layers or one per layer; None in a model without one.
    """

    visible: Tensor | tuple[Tensor, ...]
    rotation: Rotation | list[Rotation] | None = None


class Backbone(nn.Module, ABC):
    """A VLM that answers questions and lends its layers to an action expert.

    Attributes:
        tied_heads: embedding table -> the module whose output is scored against its rows, or the
            linear map that shares its weight.
        kv_heads: heads of the keys and values; fewer than `heads` where queries are grouped.
        image_size: side in pixels of the square images it reads; None: images of any size.
        reads_several: whether a prompt may be about several images.
        rounds: whether its weights may be kept in another type than float32.
        stored: name of the type that the weights were read in, one of `STORED_TYPES`.
        hub_id: the id on the hub of the model that it is, or was before Aegis trained it.
        held: names of parameters that no input describes; they are protected as lone rows are, by
            holding them still.
        idle: dotted names of the parts whose outputs nothing reads: no gradient comes to them.
        numbers: how many numbers, from 0 on, `number_texts` has texts for.
        inside: what stands before the names that its parts have in the model itself.
    """

    tied_heads: Mapping[str, str] = {}
    image_size: int | None = None
    reads_several: bool = False
    rounds: bool = False
    stored: str = FLOAT32
    hub_id: str | None = None
    held: Sequence[str] = ()
    idle: Sequence[str] = ()
    numbers: int = 256
    inside: str = ""
    depth: int
    width: int
    heads: int
    kv_heads: int
    head_dim: int

    def prepare(self, images: Images, prompts: Sequence[str]) -> Batch:
        """A batch from images with one prompt each, in the form that the model's VQA path reads."""
        return self.process(images, prompts).to(self.device)

    @abstractmethod
    def process(self, images: Images, prompts: Sequence[str]) -> Batch:
        """What `prepare` makes, but on the CPU if it is made there; several threads may call it."""

    @abstractmethod
    def encode(self, batch: Batch) -> Encoding:
        """One forward pass over image and prompt tokens."""

    @abstractmethod
    def answer(
        self, images: Images, questions: Sequence[str], most: int | None = None
    ) -> list[str]:
        """Answers by greedy autoregressive decoding.

        Args:
            images: one per question, or several where the backbone `reads_several`.
            most: tokens of an answer at most; None: as many as a short answer has.
        """

    def prepare_answers(
        self, images: Images, questions: Sequence[str], answers: Sequence[str]
    ) -> Any:
        """What `answer_log_likelihood` takes as `prepared`, made on the CPU ahead of a step.

        It is None for a backbone that makes nothing of it.
        """
        return None

    @abstractmethod
    def answer_log_likelihood(
        self,
        images: Images,
        questions: Sequence[str],
        answers: Sequence[str],
        prepared: Any = None,
    ) -> Tensor:
        """log p(answer and its end | image, question), summed over the answer's tokens.

        Args:
            prepared: what `prepare_answers` has made of the same.

        Returns:
            [B] float32 in nats, with its graph.
        """

    def answers(self, batches: Iterable[Asked]) -> Iterator[tuple[list[str], Tensor]]:
        """What `answer` and `answer_log_likelihood` tell of each batch, one after the other."""
        for images, questions, answers in batches:
            likelihood = self.answer_log_likelihood(images, questions, answers)
            yield self.answer(images, questions), likelihood

    @abstractmethod
    def read_vqa(
        self,
        images: Tensor | Sequence[Tensor],
        image_of: Tensor,
        questions: Sequence[str],
        answers: Sequence[str],
        together: int = 8,
    ) -> Iterator[AnswerScores]:
        """Read questions with their answers, so that hooks on the modules see valid tokens alone.

        Each image is passed once, where no text changes its tokens, and every text without padding.
        So a forward hook needs no mask.

        Args:
            images: [N, H, W, 3] uint8, or N of any sizes.
            image_of: [M] int64, the image of each question.
            questions, answers: M texts each.
            together: how many questions one pass may read, in models that pass the image again for
                each question.

        Yields:
            Scores of some questions' answers, in parts that together cover all, with their graph
            where gradients are enabled. No two parts share one, so that a backward pass from a part
            frees its graph.
        """

    @abstractmethod
    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """The parameters, each in exactly one group: `layers.{i}`, or another part by its name."""

    def train(self, mode: bool = True) -> Self:
        """Go to training mode, but for running averages (BatchNorm's) of what does not learn.

        Those without weights of their own belong to the part that they lie in.
        """
        super().train(mode)
        for name, module in averaging(self).items():
            around = self.get_submodule(name.rpartition(".")[0])
            own = list(module.parameters()) or list(around.parameters())
            if own and not any(p.requires_grad for p in own):
                module.eval()
        return self

    def learning_groups(self) -> dict[str, list[nn.Parameter]]:
        """What learns of each group, without the groups of which nothing does."""
        return what_learns(self.parameter_groups())

    @abstractmethod
    def language_maps(self) -> dict[str, nn.Linear]:
        """The language layers' linear maps by dotted name; LoRA adapts these."""

    @abstractmethod
    def save(self, folder: Path) -> None:
        """Write a plain, loadable VLM."""

    @abstractmethod
    def in_vision(self, name: str) -> bool:
        """Whether a module or lone row is of the part that turns pixels into tokens."""

    def fingerprint(self) -> str:
        """sha256 of the weights: names, shapes and values."""
        return digest(self.state_dict())

    def settings(self) -> dict[str, str]:
        """Digests of what beside the weights decides what it reads; here the code alone does."""
        return {}

    def suffix(self, encoding: Encoding, count: int) -> Suffix:
        """How `count` tokens that follow the encoding see it: everything but padding, here."""
        return Suffix(encoding.mask)

    def checkpoint_gradients(self) -> None:
        """Keep only the inputs of each layer for backward passes, and compute the rest again.

        Raises:
            AegisError: the backbone cannot.
        """
        raise AegisError(
            "train.gradient_checkpointing with the embedded backbone",
            "a Hugging Face backbone",
            "--set train.gradient_checkpointing=false",
        )

    def compile_passes(self, backend: str = "inductor") -> None:
        """Let torch.compile make what every step runs, in shapes that do not vary.

        Args:
            backend: of torch.compile.

        Raises:
            AegisError: the backbone cannot.
        """
        self.encode = compiled(self.encode, backend)  # type: ignore[method-assign]

    def round_weights(self, dtype: torch.dtype) -> None:
        """Round every weight to a type, and keep it in that type."""
        # Module.to would round buffers too. Rotary frequencies are buffers, and a position that is
        # rounded to eight bits is another position.
        for parameter in self.parameters():
            parameter.data = parameter.data.to(dtype)

    def number_texts(self, count: int) -> list[str]:
        """The numbers below `count`, at most `numbers`, as texts that the model can answer with.

        Robot actions are written so: RT-2 writes 256 levels as integers (arXiv 2307.15818).
        """
        return [str(i) for i in range(count)]

    def check_text(self, question: str, answer: str, image: Tensor | None = None) -> None:
        """Raise AegisError if the model cannot read a question with its answer; most read any.

        Args:
            image: [H, W, 3] uint8 that the question is about. With it the whole is tried, which
                takes the time of preparing it.
        """

    def check_prompt(self, text: str) -> None:
        """Raise AegisError if the model cannot read this text as a prompt; most read any.

        Whether it is too long beside an image, only `process` tells.
        """

    def check_prompts(self, images: Images, texts: Sequence[str]) -> None:
        """Raise AegisError unless the model can read each text as a prompt beside one row's images.

        The images are prepared once, with the longest text: a processor takes a good part of a
        second for them, and demonstrations have thousands of texts.
        """
        for text in texts:
            self.check_prompt(text)
        self.process(images, [max(texts, key=len)])

    def sites(self) -> dict[str, str]:
        """The kind (maps, norms, embeddings, stem) of every module that owns parameters, by name.

        A tied weight belongs to the first module that has it. A lone row (`lone_rows`) is a site by
        its own name, and counts as embeddings. What takes no part (`idle`) is no site.

        Raises:
            AegisError: modules whose parameters are used in a way that no inputs describe.
        """
        owners, named = owning_modules(self), dict(self.named_parameters())
        owners = {name: m for name, m in owners.items() if not under(name, self.idle)}
        kinds = {name: site_kind(module) for name, module in owners.items()}
        # What no input describes can still be protected, by holding it still.
        lone = {}
        for name, module in owners.items():
            if kinds[name] is None:
                lone[name] = lone_rows(name, module) or self._held_rows(name, module)
        without = [name for name, rows in lone.items() if not rows]
        if without:
            unknown = [f"{name} ({type(owners[name]).__name__})" for name in without]
            raise AegisError(
                f"{', '.join(unknown)}: what its parameters read on VQA cannot be measured",
                "linear maps, convolutions, normalisations and embeddings",
                "leave the inputs out: aegis anchor --parts moments, and a method other than "
                "nullspace",
            )
        found = {name: kind for name, kind in kinds.items() if kind is not None}
        for rows in lone.values():
            # A row that is tied to an earlier one has that one's name among the parameters.
            found |= {row: "embeddings" for row in rows if row in named}
        return {site: "stem" if self.in_vision(site) else kind for site, kind in found.items()}

    def _held_rows(self, name: str, module: nn.Module) -> list[str]:
        """What a module owns, if all of it is `held`."""
        own = [f"{name}.{leaf}" for leaf, _ in module.named_parameters(recurse=False)]
        return own if set(own) <= set(self.held) else []

    def site_modules(self) -> dict[str, nn.Module]:
        """The modules among the sites."""
        named = dict(self.named_parameters())
        return {site: self.get_submodule(site) for site in self.sites() if site not in named}

    @property
    def device(self) -> torch.device:
        """The device that the parameters are on."""
        return next(self.parameters()).device
