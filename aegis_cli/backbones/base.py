"""What every vision-language backbone offers to the stages."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor, nn

from aegis_cli.core.attention import KeyValue, Rotation
from aegis_cli.errors import AegisError


# Of B rows: [B, H, W, 3] uint8; to a backbone without an `image_size` also B images [H, W, 3] of any sizes, and to one
# that `reads_several` images of a row (a robot's cameras) also B sequences of them.
Images = Tensor | Sequence[Tensor] | Sequence[Sequence[Tensor]]


@dataclass(frozen=True)
class Batch:
    """A prepared batch, rows padded on the right.

    Attributes:
        pixels: [B, 3, H, W] float32, or in the shape that the model's own processor gives them.
        ids: [B, S] int64.
        mask: [B, S] bool; True: a token.
        extra: what else the processor has for the model, by the model's own names.
    """

    pixels: Tensor
    ids: Tensor
    mask: Tensor
    extra: Mapping[str, Tensor] = field(default_factory=dict)


@dataclass(frozen=True)
class Encoding:
    """One pass over images and prompts.

    Attributes:
        hidden: residual stream after each transformer layer, L tensors [B, T, D].
        keys_values: each layer's keys and values as it attends to them (after any rotary embedding), L pairs
            [B, kv_heads, T, head_dim].
        mask: [B, T] bool; padding is False.
        image: [T] bool, or [B, T] where rows differ; True at image tokens, False at text.
        next_position: [B] int64, the position of a token that would follow each row; None in a model that
            does not rotate its keys by position.
    """

    hidden: tuple[Tensor, ...]
    keys_values: tuple[KeyValue, ...]
    mask: Tensor
    image: Tensor
    next_position: Tensor | None = None


@dataclass(frozen=True)
class Suffix:
    """How tokens that follow an encoding see it.

    Attributes:
        visible: [B, T] bool for all layers, or for each layer [B, S, T].
        rotation: of their own queries and keys, [B, S, head_dim]; None in a model without rotary embedding.
    """

    visible: Tensor | tuple[Tensor, ...]
    rotation: Rotation | None = None


# What a module does to tokens is linear in its own parameters, so that its inputs say what VQA uses of it.
SITES: dict[type[nn.Module], str] = {
    nn.Linear: "maps", nn.LayerNorm: "norms", nn.Embedding: "embeddings",
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
        tied_heads: embedding table -> the module whose output is scored against its rows, or the linear map that
            shares its weight.
        kv_heads: heads of the keys and values; fewer than `heads` where queries are grouped.
        image_size: side in pixels of the square images it reads; None: images of any size.
        compiles: whether `encode` may be given to `torch.compile`.
        reads_several: whether a prompt may be about several images.
    """

    tied_heads: Mapping[str, str] = {}
    image_size: int | None = None
    compiles: bool = True
    reads_several: bool = False
    depth: int
    width: int
    heads: int
    kv_heads: int
    head_dim: int

    @abstractmethod
    def prepare(self, images: Images, prompts: Sequence[str]) -> Batch:
        """Images and one prompt each, as the model's own VQA path wants them; questions below are about one image each."""

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
        self, images: Tensor, image_of: Tensor, questions: Sequence[str], answers: Sequence[str], together: int = 8
    ) -> Iterator[Tensor]:
        """Read questions with their answers, and nothing but valid tokens, for whoever watches the modules.

        Each image is passed once (where no text changes what becomes of it) and every text without padding, so that
        a forward hook needs no mask.

        Args:
            images: [N, H, W, 3] uint8.
            image_of: [M] int64, the image of each question.
            questions, answers: M texts each.
            together: questions in one pass at most, where each takes a pass of its image of its own.

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
    def in_vision(self, name: str) -> bool:
        """Whether the module, or lone row, of that dotted name is of the part that turns pixels into tokens."""

    def fingerprint(self) -> str:
        """sha256 of the weights: names, shapes and values."""
        return digest(self.state_dict())

    def suffix(self, encoding: Encoding, count: int) -> Suffix:
        """How `count` tokens that follow the encoding see it: here, all that is not padding."""
        return Suffix(encoding.mask)

    def checkpoint_gradients(self) -> None:
        """From now on, keep each layer's inputs alone for the backward pass and compute the rest again.

        Raises:
            AegisError: the backbone cannot.
        """
        raise AegisError(
            "train.gradient_checkpointing with the embedded backbone",
            "a Hugging Face backbone",
            "--set train.gradient_checkpointing=false",
        )

    def halve_weights(self) -> None:
        """Round every weight to bfloat16, and keep it so.

        Raises:
            AegisError: the backbone cannot.
        """
        raise AegisError(
            "train.weights: bf16 with the embedded backbone", "a Hugging Face backbone", "--set train.weights=float32"
        )

    def check_text(self, question: str, answer: str) -> None:
        """Raise AegisError where the model cannot read a question with its answer; most read anything."""

    def sites(self) -> dict[str, str]:
        """Dotted name -> kind (maps, norms, embeddings, stem) of every module that owns parameters, of a tied weight the first.

        A lone row (`lone_rows`) is a site by its own name, of the kind of embeddings.

        Raises:
            AegisError: modules whose parameters are used in a way that no inputs describe.
        """
        owners, named = _owners(self), dict(self.named_parameters())
        kinds = {name: site_kind(module) for name, module in owners.items()}
        lone = {name: lone_rows(name, module) for name, module in owners.items() if kinds[name] is None}
        if unknown := [f"{name} ({type(owners[name]).__name__})" for name, rows in lone.items() if not rows]:
            raise AegisError(
                f"{', '.join(unknown)}: what its parameters read on VQA cannot be measured",
                "linear maps, convolutions, normalisations and embeddings",
                "leave the inputs out: aegis anchor --parts moments, and a method other than nullspace",
            )
        found = {name: kind for name, kind in kinds.items() if kind is not None}
        found |= {row: "embeddings" for rows in lone.values() for row in rows if row in named}
        return {site: "stem" if self.in_vision(site) else kind for site, kind in found.items()}

    def site_modules(self) -> dict[str, nn.Module]:
        """The modules among the sites."""
        named = dict(self.named_parameters())
        return {site: self.get_submodule(site) for site in self.sites() if site not in named}

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device


def _owners(model: nn.Module) -> dict[str, nn.Module]:
    """The modules that own parameters; a module whose parameters all belong to an earlier one owns none."""
    taken: set[int] = set()
    found: dict[str, nn.Module] = {}
    for name, module in model.named_modules():
        own = {id(p) for p in module.parameters(recurse=False)}
        if own - taken:
            found[name] = module
        taken |= own
    return found


def lone_rows(name: str, module: nn.Module) -> list[str]:
    """Dotted names of the parameters of a module that is made of others and owns but single rows itself; else none.

    No input says what such a row does. It is the same for every question, so that holding it still keeps all that
    depends on it: of a row that scales something this protects more than it has to, never less.
    """
    own = dict(module.named_parameters(recurse=False))
    made_of_others = next(module.children(), None) is not None
    if not made_of_others or any(p.numel() != max(p.shape, default=1) for p in own.values()):
        return []
    return [f"{name}.{row}" if name else row for row in own]


def site_kind(module: nn.Module) -> str | None:
    """maps, norms or embeddings; None for a module whose inputs do not say what it does to tokens."""
    if isinstance(module, nn.Conv2d | nn.Conv3d):
        plain = module.groups == 1 and module.padding_mode == "zeros" and module.padding != "same"
        return "maps" if plain else None  # else what it reads is not the unfolded patch
    if type(module) in SITES:
        return SITES[type(module)]
    if isinstance(module, nn.Embedding):  # some scale the row they look up: still linear in it
        return "embeddings"
    return "norms" if is_rms_norm(module) else None


@torch.no_grad()
def is_rms_norm(module: nn.Module) -> bool:
    """Whether all the module does is to scale x / rms(x) by its weight, or by 1 + its weight."""
    parameters = dict(module.named_parameters())
    if parameters.keys() != {"weight"} or parameters["weight"].ndim != 1 or rms_epsilon(module) is None:
        return False
    weight = parameters["weight"]
    x = torch.linspace(-1, 2, len(weight), dtype=weight.dtype, device=weight.device)[None]
    found, plain = module(x).float(), rms_normed(module, x).float()
    return any(torch.allclose(found, plain * scale.float(), rtol=2e-2, atol=1e-3) for scale in (weight, 1 + weight))


def rms_epsilon(module: nn.Module) -> float | None:
    """The epsilon under its root, if it names one."""
    return next((getattr(module, name) for name in ("eps", "variance_epsilon") if hasattr(module, name)), None)


def rms_normed(module: nn.Module, x: Tensor) -> Tensor:
    """x / rms(x) over the last dimension [..., D], with the module's own epsilon, in float32 or wider."""
    wide = x if x.dtype == torch.float64 else x.float()
    return wide * torch.rsqrt(wide.square().mean(-1, keepdim=True) + rms_epsilon(module))
