"""A method as parts that combine freely, and what it is given."""

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

    Every tensor is on the device where training runs. A method that the guard has takes any module
    M; others may ask for a `Backbone`.

    Attributes:
        backbone: adapted, its weights still the pre-trained ones.
        groups: every parameter that learns in exactly one group, `layers.{i}` for each language
            layer; under the guard, empty for a method that compares no layers.
        sites: each map whose inputs an anchor can describe, or lone row that it has used -> its
            kind: maps, norms, embeddings or stem. What the user has frozen is none of them.
        options: the method's own part of the recipe.
        anchor: what was measured of the pre-trained backbone on VQA; None where the method needs
            none of it.
        vqa_loss: pass -> mean cross-entropy of an answer over a batch of training questions, with
            its graph; only for a method that trains on questions.
        instructions: every text that the frames come with, so that a method which makes more text
            of them can refuse it before any work; empty under the guard.
        targets: robot frames -> what the expert has to predict of their actions, [B, H, A], on the
            CPU; None under the guard.
        actions: A, how many numbers an action has.
        owners: the processes each of which has some rows of every weight; one where each has all.
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
        """Copies of their pre-trained values."""
        return {name: p.detach().clone() for name, p in self.learning().items()}


@dataclass(frozen=True)
class Pass:
    """One forward pass over robot frames.

    Several processes may make one pass together, over a share of its frames each. Then what a
    method measures is that of all shares, and a loss is what this share contributes to it.

    Attributes:
        step: number of the step, from 0.
        inputs: what the backbone's `encode` was given.
        hidden: residual stream after each layer, L tensors [B, T, D].
        mask: [B, T] bool; padding is False.
        image: [T] or [B, T] bool; True at image tokens.
        frames: what the inputs were prepared from, and the actions that follow; None under the
            guard.
        share: which of the step's frames.
        total: a tensor -> its sum over the processes that make this pass; None for one process.
        prepared: what the method's own `prepare` has made of the frames; None where nobody has.
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
    """What the optimizer has just done, over as many steps as the method's `every`.

    A method constrains it by changing the parameters in place; their `.grad` still holds the
    gradient (clipped) that the last step was made from.

    Attributes:
        before: value of each trainable parameter of the backbone before the first of these steps,
            by name; empty for a method that does not compare.
        anchor_gradient: gradient of the penalty before the last step, by name; empty without a
            penalty.
        steps: how many of these steps have moved anything. A tensor [] float64 where a step may
            have moved nothing and reading that would wait; 0 of them change nothing.
        rate_left: share of the peak learning rate that the schedule had left at the last of them; 1
            until it has reached the peak, and under the guard. A tensor like `steps`.
    """

    before: Mapping[str, Tensor]
    anchor_gradient: Mapping[str, Tensor]
    steps: int | Tensor = 1
    rate_left: float | Tensor = 1.0


@dataclass(frozen=True)
class Parts:
    """What a started method does at each stage of a step; what is left out costs nothing.

    Attributes:
        penalty: pass -> (a scalar with its graph, whose gradient is the anchor gradient; the
            distance of each layer from the anchor [L], detached, which is W2^2 in `aegis`). It
            costs a second backward pass.
        combine: inner products of task and anchor gradient, per group -> their weights.
        refresh: steps that share one anchor gradient, taken at the first of them.
        fraction: share of the batch that the anchor gradient is taken on; below 1, from a graph of
            its own.
        keeps_idle: whether the anchor gradient counts only where the task's is not zero.
        auxiliary: pass -> a loss that is added to the task's; the report's loss stays the task's
            own.
        prepare: robot frames -> what `auxiliary` finds in `Pass.prepared`, made on the CPU ahead of
            a GPU's step; several threads may call it.
        pull: adds to `.grad` after the backward, before the gradient is clipped.
        shares: parameter -> the share of its learning rate that this step is to have, from the
            gradients, a tensor [] where reading it would wait; others have all.
        constrain: changes the applied update, after the optimizer's step.
        begin: called before the first of the steps that one call of `constrain` covers.
        compares: whether `constrain` reads `Update.before`; where it does not that is empty, and
            nothing is copied.
        every: steps that one call of `constrain` covers; fewer before a checkpoint or a validation,
            so that neither sees an update that has not been constrained.
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
        """Whether a step, from 0, takes the anchor gradient of one before it."""
        return step % self.refresh != 0

    @property
    def dual(self) -> bool:
        """Whether a second backward pass is taken, so that a ledger has inner products."""
        return self.penalty is not None

    @property
    def constrains(self) -> bool:
        """Whether the applied update is another than the optimizer's own."""
        return self.constrain is not None or self.shares is not None

    @property
    def copies(self) -> bool:
        """Whether weights have to be copied before a step, to be compared with those after."""
        return self.constrain is not None and self.compares


@dataclass(frozen=True)
class Method:
    """One way to fine-tune a backbone under an action expert.

    Attributes:
        name: as users write it; its options are the recipe's key of that name.
        summary: one line for tables and help.
        adapt: makes the backbone's trainable part trainable, given its language layers' linear maps
            and the method's options; called once, before the optimizer is made.
        start: the parts at work, from what the run has to offer; called once, after `adapt`.
        needs: which parts of an anchor (`moments`, `inputs`, `curvature`, `fisher`) it reads.
        vqa_weight: its option that weighs a loss on VQA questions, if it has one. Above 0 it is a
            ceiling (an upper bound): it trains on data that the others do without.
        stop_gradient: the expert's gradient ends at the backbone's keys and values.
        export: turns an adapted copy of the backbone into a plain one; None where it is one
            already.
        shards: whether it works where a process has only some rows of each weight.
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
        """Whether it trains on VQA data, with these options: then it is a ceiling."""
        return self.vqa_weight is not None and options[self.vqa_weight] > 0


def train_all(backbone: nn.Module, _: Mapping[str, nn.Linear], __: Options) -> None:
    """Let every parameter learn."""
    backbone.requires_grad_(True)


def freeze(backbone: nn.Module, _: Mapping[str, nn.Linear], __: Options) -> None:
    """Let nothing in the backbone learn."""
    backbone.requires_grad_(False)
