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
# The dtypes that weights are stored in, by name.
STORED_TYPES = {
    FLOAT32: torch.float32,
    "bfloat16": torch.bfloat16,
    "float16": torch.float16,
}


class AnswerScores(NamedTuple):
    """Scores of the tokens of some questions' answers, with their autograd graph.

    Attributes:
        scores: [n, V] unnormalised; those of one answer are consecutive, in the order of its
            tokens.
        question: [n] int64 on the CPU, the question whose answer each token belongs to.
    """

    scores: Tensor
    question: Tensor


@dataclass(frozen=True)
class Batch:
    """A prepared batch, rows padded on the right.

    Attributes:
        pixels: [B, 3, H, W] float32, or in the shape that the model's own processor produces.
        ids: [B, S] int64.
        mask: [B, S] bool; True at tokens, False at padding.
        extra: further inputs that the processor makes, by the model's own argument names.
    """

    pixels: Tensor
    ids: Tensor
    mask: Tensor
    extra: Mapping[str, Tensor] = field(default_factory=dict)

    def to(self, device: torch.device) -> Batch:
        """The batch on that device; a copy to a GPU is asynchronous."""
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
        image: [T] bool, or [B, T] if rows differ; True at image tokens, False at text.
        next_position: [B] int64, the position of the token that would follow each row; None in a
            model without rotary embedding.
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
        visible: which tokens of the encoding they see: [B, T] bool for all layers, or one [B, S, T]
            per layer.
        rotation: the rotary embedding of their own queries and keys, [B, S, head_dim], for all
            layers or one per layer; None in a model without one.
    """

    visible: Tensor | tuple[Tensor, ...]
    rotation: Rotation | list[Rotation] | None = None


class Backbone(nn.Module, ABC):
    """A VLM that answers questions and whose layers an action expert reads.

    Attributes:
        tied_heads: embedding table -> the module whose output is scored against its rows, or the
            linear map that shares its weight.
        kv_heads: heads of the keys and values; fewer than `heads` with grouped-query attention.
        image_size: side in pixels of the square images it reads; None: images of any size.
        reads_several: whether a prompt may be about several images.
        rounds: whether its weights may be kept in another dtype than float32.
        stored: name of the dtype that the weights were stored in, one of `STORED_TYPES`.
        hub_id: the id on the hub of the model that it is, or was before Aegis trained it.
        held: names of parameters that no input describes; like lone rows, they are protected by
            freezing them.
        idle: dotted names of the parts whose outputs nothing reads: they get no gradient.
        numbers: how many numbers, starting from 0, `number_texts` has texts for.
        inside: the prefix of its parts' names, which they do not have in the model itself.
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
        """A batch from images with one prompt each, in the same format as for VQA."""
        return self.process(images, prompts).to(self.device)

    @abstractmethod
    def process(self, images: Images, prompts: Sequence[str]) -> Batch:
        """As `prepare`, but on the CPU if it is computed there; several threads may call it."""

    @abstractmethod
    def encode(self, batch: Batch) -> Encoding:
        """One forward pass over image and prompt tokens."""

    @abstractmethod
    def answer(
        self, images: Images, questions: Sequence[str], most: int | None = None
    ) -> list[str]:
        """Answers by greedy autoregressive decoding.

        Args:
            images: one per question, or several if the backbone `reads_several`.
            most: the most tokens in an answer; None: enough for a short answer.
        """

    def prepare_answers(
        self, images: Images, questions: Sequence[str], answers: Sequence[str]
    ) -> Any:
        """The argument `prepared` of `answer_log_likelihood`, made on the CPU ahead of a step.

        It is None for a backbone that prepares nothing.
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
            prepared: the result of `prepare_answers` for the same arguments.

        Returns:
            [B] float32 in nats, with its autograd graph.
        """

    def answers(self, batches: Iterable[Asked]) -> Iterator[tuple[list[str], Tensor]]:
        """The results of `answer` and `answer_log_likelihood` for each batch in turn."""
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
        """Read questions with their answers, so that hooks on the modules see only valid tokens.

        Each image is passed once if no text changes its tokens, and every text without padding. So
        a forward hook needs no mask.

        Args:
            images: [N, H, W, 3] uint8, or N of any sizes.
            image_of: [M] int64, the image of each question.
            questions, answers: M texts each.
            together: the most questions per pass, in models that pass the image again for each
                question.

        Yields:
            Scores of some questions' answers, in parts that together cover all, with their graph if
            gradients are enabled. No two parts share a graph, so the backward pass of a part frees
            its graph.
        """

    @abstractmethod
    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """The parameters, each in exactly one group: `layers.{i}`, or another part by name."""

    def train(self, mode: bool = True) -> Self:
        """Set training mode, except for running averages (BatchNorm's) of frozen modules.

        Those without weights of their own count as part of the module that contains them.
        """
        super().train(mode)
        for name, module in averaging(self).items():
            around = self.get_submodule(name.rpartition(".")[0])
            own = list(module.parameters()) or list(around.parameters())
            if own and not any(p.requires_grad for p in own):
                module.eval()
        return self

    def learning_groups(self) -> dict[str, list[nn.Parameter]]:
        """The trainable parameters of each group, without groups that have none."""
        return what_learns(self.parameter_groups())

    @abstractmethod
    def language_maps(self) -> dict[str, nn.Linear]:
        """The language layers' linear maps by dotted name; LoRA adapts these."""

    @abstractmethod
    def save(self, folder: Path) -> None:
        """Write a plain, loadable VLM."""

    @abstractmethod
    def in_vision(self, name: str) -> bool:
        """Whether a module or lone row belongs to the part that turns pixels into tokens."""

    def fingerprint(self) -> str:
        """sha256 of the weights: names, shapes and values."""
        return digest(self.state_dict())

    def settings(self) -> dict[str, str]:
        """Digests of what, besides weights and code, affects how inputs are read; none here."""
        return {}

    def preparation(self) -> Mapping[str, str]:
        """The settings that decide what inputs images and texts become (preparation.py); none here.

        The embedded models' inputs depend on their code alone.
        """
        return {}

    def suffix(self, encoding: Encoding, count: int) -> Suffix:
        """How `count` tokens that follow the encoding see it; here, everything but padding."""
        return Suffix(encoding.mask)

    def checkpoint_gradients(self) -> None:
        """Keep only the inputs of each layer for backward passes, and recompute the rest.

        Raises:
            AegisError: the backbone cannot.
        """
        raise AegisError(
            "train.gradient_checkpointing with the embedded backbone",
            "a Hugging Face backbone",
            "--set train.gradient_checkpointing=false",
        )

    def compile_passes(self, backend: str = "inductor") -> None:
        """Compile with torch.compile what every step runs, in shapes that do not vary.

        Args:
            backend: of torch.compile.

        Raises:
            AegisError: the backbone cannot.
        """
        self.encode = compiled(self.encode, backend)  # type: ignore[method-assign]

    def round_weights(self, dtype: torch.dtype) -> None:
        """Cast every weight to a dtype, and keep it in that dtype."""
        # Module.to would round buffers too. Rotary frequencies are buffers, and a position rounded
        # to eight bits is another position.
        for parameter in self.parameters():
            parameter.data = parameter.data.to(dtype)

    def number_texts(self, count: int) -> list[str]:
        """The numbers below `count`, at most `numbers`, as texts that the model can answer with.

        Robot actions are written with them: RT-2 writes 256 levels as integers (arXiv 2307.15818).
        """
        return [str(i) for i in range(count)]

    def check_text(self, question: str, answer: str, image: Tensor | None = None) -> None:
        """Raise AegisError if the model cannot read a question with its answer; most read any.

        Args:
            image: [H, W, 3] uint8 that the question is about. If given, the full input is prepared
                as a test, which takes time.
        """

    def check_prompt(self, text: str) -> None:
        """Raise AegisError if the model cannot read this text as a prompt; most read any.

        Only `process` checks whether it is too long together with an image.
        """

    def check_prompts(self, images: Images, texts: Sequence[str]) -> None:
        """Raise AegisError unless the model can read each text as a prompt with one row's images.

        The images are prepared once, with the longest text: a processor may need most of a second
        for them, and demonstrations have thousands of texts.
        """
        for text in texts:
            self.check_prompt(text)
        self.process(images, [max(texts, key=len)])

    def sites(self) -> dict[str, str]:
        """The kind (maps, norms, embeddings, stem) of every module that owns parameters, by name.

        A tied weight belongs to the first module that has it. A lone row (`lone_rows`) is a site
        under its own name, of kind embeddings. Parts that are `idle` are no sites.

        Raises:
            AegisError: the parameters of some modules are used in a way that no inputs describe.
        """
        owners, named = owning_modules(self), dict(self.named_parameters())
        owners = {name: m for name, m in owners.items() if not under(name, self.idle)}
        kinds = {name: site_kind(module) for name, module in owners.items()}
        # Parameters that no input describes can still be protected by freezing them.
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
            # A row that is tied to an earlier one is listed under that one's name.
            found |= {row: "embeddings" for row in rows if row in named}
        return {site: "stem" if self.in_vision(site) else kind for site, kind in found.items()}

    def _held_rows(self, name: str, module: nn.Module) -> list[str]:
        """The parameters that a module owns, if all of them are in `held`."""
        own = [f"{name}.{leaf}" for leaf, _ in module.named_parameters(recurse=False)]
        return own if set(own) <= set(self.held) else []

    def site_modules(self) -> dict[str, nn.Module]:
        """The sites that are modules."""
        named = dict(self.named_parameters())
        return {site: self.get_submodule(site) for site in self.sites() if site not in named}

    @property
    def device(self) -> torch.device:
        """The device that the parameters are on."""
        return next(self.parameters()).device
