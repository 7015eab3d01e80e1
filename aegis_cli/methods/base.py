"""A method as parts that combine freely, and the inputs that it gets."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from torch import Tensor, nn

from aegis_cli.common.ranks import ALONE, Ranks
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.projection import Combine
from aegis_cli.data.batch import RobotBatch, Share

Options = Mapping[str, Any]
M = TypeVar("M", bound=nn.Module)


@dataclass(frozen=True)
class MethodContext(Generic[M]):
    """What a method is started with: model, options, anchor and data.

    Every tensor is on the training device. A method that the guard offers takes any module M;
    others may require a `Backbone`.

    Attributes:
        backbone: already adapted, still with the pre-trained weights.
        groups: every trainable parameter, in exactly one group; `layers.{i}` for each language
            layer. Under the guard, empty for a method that compares no layers.
        sites: each map whose inputs an anchor can describe, or lone row that it has used -> its
            kind: maps, norms, embeddings or stem. Sites that the user has frozen are left out.
        options: the method's own part of the recipe.
        anchor: measurements of the pre-trained backbone on VQA; None if the method needs none.
        vqa_loss: pass -> mean cross-entropy of an answer over a batch of training questions, with
            its graph; only for a method that trains on questions.
        instructions: all instructions of the frames, so that a method which adds text to them can
            refuse one that is too long before any work; empty under the guard.
        targets: robot frames -> the actions as the expert has to predict them, [B, H, A], on the
            CPU; None under the guard.
        actions: A, the number of values in an action.
        owners: the processes that each have some rows of every weight; just one if each has all.
    """

    backbone: M
    groups: Mapping[str, Sequence[nn.Parameter]]
    sites: Mapping[str, str]
    options: Options
    anchor: Anchor | None = None
    vqa_loss: Callable[[Pass], Tensor] | None = None
    instructions: Sequence[str] = ()
    targets: Callable[[RobotBatch], Tensor] | None = None
    actions: int = 0
    owners: Ranks = ALONE

    def learning(self) -> dict[str, nn.Parameter]:
        """The backbone's trainable parameters by name."""
        return {name: p for name, p in self.backbone.named_parameters() if p.requires_grad}

    def reference(self) -> dict[str, Tensor]:
        """Copies of the pre-trained values of these parameters."""
        return {name: p.detach().clone() for name, p in self.learning().items()}


@dataclass(frozen=True)
class Pass:
    """One forward pass over robot frames.

    Several processes may make one pass together, each over a share of its frames. Then a method
    measures statistics over all shares, and a loss is the contribution of this share.

    Attributes:
        step: number of the step, from 0.
        inputs: the input of the backbone's `encode`.
        hidden: residual stream after each layer, L tensors [B, T, D].
        mask: [B, T] bool; padding is False.
        image: [T] or [B, T] bool; True at image tokens.
        frames: the frames behind the inputs, and the actions that follow; None under the guard.
        share: which of the step's frames this pass covers.
        total: sums a tensor over the processes that make this pass; None for one process.
        prepared: the result of the method's own `prepare` for the frames; None if it was not run.
    """

    step: int
    inputs: Any
    hidden: Sequence[Tensor]
    mask: Tensor
    image: Tensor
    frames: RobotBatch | None = None
    share: Share = Share()
    total: Callable[[Tensor], Tensor] | None = None
    prepared: Any = None


@dataclass(frozen=True)
class Update:
    """The optimizer's most recent update, over the number of steps given by the method's `every`.

    A method constrains it by changing the parameters in place; their `.grad` still holds the
    (clipped) gradient of the last step.

    Attributes:
        before: value of each trainable parameter of the backbone before the first of these steps,
            by name; empty for a method that does not compare.
        anchor_gradient: gradient of the penalty before the last step, by name; empty without a
            penalty.
        steps: how many of these steps have moved anything. A tensor [] float64 if a step may have
            moved nothing and reading that would force a sync; with 0, a method changes nothing.
        rate_left: the learning rate at the last of these steps as a fraction of its peak; 1 until
            the schedule has reached the peak, and under the guard. A tensor whenever `steps` is.
    """

    before: Mapping[str, Tensor]
    anchor_gradient: Mapping[str, Tensor]
    steps: int | Tensor = 1
    rate_left: float | Tensor = 1.0


@dataclass(frozen=True)
class Parts:
    """What a started method does at each stage of a step; parts that are left out cost nothing.

    Attributes:
        penalty: pass -> (a scalar with its graph, whose gradient is the anchor gradient; the
            distance of each layer from the anchor [L], detached, which is W2^2 in `aegis`). It
            costs a second backward pass.
        combine: inner products of task and anchor gradient, per group -> their weights.
        refresh: steps that share one anchor gradient, computed at the first of them.
        fraction: fraction of the batch that the anchor gradient is computed on; below 1, it has a
            graph of its own.
        keeps_idle: whether the anchor gradient counts only where the task gradient is not zero.
        auxiliary: pass -> a loss that is added to the task loss; the report still gives the task
            loss alone.
        prepare: robot frames -> the `Pass.prepared` that `auxiliary` reads, made on the CPU ahead
            of a GPU step; it may be called from several threads.
        pull: adds to `.grad` after the backward pass, before the gradient is clipped.
        shares: returns, from the gradients, the fraction of its learning rate that each parameter
            has in this step, as a tensor [] if reading it would force a sync; parameters that it
            does not list have all of it.
        constrain: changes the applied update, after the optimizer's step.
        begin: called before the first of the steps that one call of `constrain` covers.
        compares: whether `constrain` reads `Update.before`; if not, that is empty and nothing is
            copied.
        every: steps that one call of `constrain` covers; fewer before a checkpoint or a validation,
            so that neither sees an unconstrained update.
    """

    penalty: Callable[[Pass], tuple[Tensor, Tensor]] | None = None
    combine: Combine | None = None
    refresh: int = 1
    fraction: float = 1.0
    keeps_idle: bool = False
    auxiliary: Callable[[Pass], Tensor] | None = None
    prepare: Callable[[RobotBatch], Any] | None = None
    pull: Callable[[], None] | None = None
    shares: Callable[[], Mapping[Tensor, float | Tensor]] | None = None
    constrain: Callable[[Update], None] | None = None
    begin: Callable[[], None] | None = None
    compares: bool = True
    every: int = 1

    def reuses(self, step: int) -> bool:
        """Whether a step (from 0) reuses the anchor gradient of an earlier one."""
        return step % self.refresh != 0

    @property
    def dual(self) -> bool:
        """Whether there is a second backward pass, so that a ledger has inner products."""
        return self.penalty is not None

    @property
    def constrains(self) -> bool:
        """Whether the applied update differs from the optimizer's own."""
        return self.constrain is not None or self.shares is not None

    @property
    def copies(self) -> bool:
        """Whether weights have to be copied before a step, for comparison afterwards."""
        return self.constrain is not None and self.compares


@dataclass(frozen=True)
class Method:
    """One way to fine-tune a backbone under an action expert.

    Attributes:
        name: as users write it; its options are under the recipe key of that name.
        summary: one line for tables and help.
        adapt: sets up the backbone's trainable part, given the linear maps of its language layers
            and the method's options; called once, before the optimizer is created.
        start: returns the method's parts for a run; called once, after `adapt`.
        needs: which parts of an anchor (`moments`, `inputs`, `curvature`, `fisher`) it reads.
        vqa_weight: name of its option that weights a loss on VQA questions, if it has one. Above 0
            the method is a ceiling (an upper bound): it trains on data that the others do not use.
        stop_gradient: whether the expert's gradient stops at the backbone's keys and values.
        export: turns an adapted copy of the backbone into a plain one; None if it is already plain.
        shards: whether it works when each process has only some rows of each weight.
    """

    name: str
    summary: str
    adapt: Callable[[nn.Module, Mapping[str, nn.Linear], Options], None]
    start: Callable[[MethodContext], Parts] = lambda context: Parts()
    needs: frozenset[str] = frozenset()
    vqa_weight: str | None = None
    stop_gradient: bool = False
    export: Callable[[nn.Module], None] | None = None
    shards: bool = True

    @property
    def compares_layers(self) -> bool:
        """Whether it compares the hidden states after each layer with the anchor's moments."""
        return "moments" in self.needs

    def trains_on_questions(self, options: Options) -> bool:
        """Whether it trains on VQA data with these options, which makes it a ceiling."""
        return self.vqa_weight is not None and options[self.vqa_weight] > 0


def train_all(backbone: nn.Module, _: Mapping[str, nn.Linear], __: Options) -> None:
    """Let every parameter learn."""
    backbone.requires_grad_(True)


def freeze(backbone: nn.Module, _: Mapping[str, nn.Linear], __: Options) -> None:
    """Let nothing in the backbone learn."""
    backbone.requires_grad_(False)
