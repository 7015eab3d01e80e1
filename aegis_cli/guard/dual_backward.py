"""Both gradients of watched forward passes, and the projection of their sum."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from aegis_cli.common.errors import AegisError, Diverged
from aegis_cli.common.ranks import Ranks
from aegis_cli.guard import accumulation, process_groups
from aegis_cli.guard.accumulation import Accumulation
from aegis_cli.guard.process_groups import ProcessGroup
from aegis_cli.guard.stepper import GuardedStepper
from aegis_cli.methods import backward
from aegis_cli.methods.base import Parts, Pass
from aegis_cli.methods.known_parameters import check_row
from aegis_cli.methods.ledger_file import LedgerOutsideRuns


@dataclass(frozen=True)
class AnchorGradient:
    """The gradient of the penalty of one pass.

    Attributes:
        taken: the gradient by the parameters' ids; None if the penalty does not reach a parameter.
        w2: W2^2 of each layer [L].
    """

    taken: dict[int, Tensor | None]
    w2: Tensor


class DualBackward:
    """The backward passes of a method with a penalty.

    Attributes:
        anchor: mean anchor gradient of the current sum, by the parameters' ids.
    """

    def __init__(
        self,
        parts: Parts,
        groups: Sequence[Sequence[nn.Parameter]],
        stepper: GuardedStepper,
        ledger: LedgerOutsideRuns,
        owners: Ranks,
        processes: ProcessGroup,
        around: Sequence[nn.Parameter] = (),
    ) -> None:
        """Start in a state without a pass.

        Args:
            groups: the trainable parameters, each once; the ledger has a column for each group.
            owners: the processes that each have some rows of every weight.
            processes: the processes that train the model together.
            around: the parameters of the policy that the model is a part of, which keep only their
                task gradient.
        """
        self._parts, self._groups, self._stepper = parts, groups, stepper
        self._ledger, self._owners, self._processes = ledger, owners, processes
        self._around = around
        self._sum: Accumulation | None = None
        self._reopened: Accumulation | None = None  # while a backward pass of the loop adds to it
        self._step, self._checkpointing_checked = 0, False
        # Whether the ledger has a row for the last sum although its step may still be to come; and
        # whether a scaler may skip that step.
        self._row_is_open, self._skips = False, False
        # Parameters whose `.grad` makes a scaler skip the current step.
        self._poisoned: list[nn.Parameter] = []

    @property
    def anchor(self) -> dict[int, Tensor | None]:
        return {} if self._sum is None else self._sum.anchor

    @property
    def begun(self) -> bool:
        """Whether there is a sum."""
        return self._sum is not None

    def forget(self) -> None:
        """Forget the sum."""
        self._sum = None
        self.close_row()

    def close_row(self) -> None:
        """Drop the ledger's row for the last sum if it led to no step.

        Either a scaler skipped the step, perhaps because of a gradient outside the guarded model,
        or the loop left it out.
        """
        if self._row_is_open and not self._stepper.may_have_moved(self._skips):
            self._ledger.truncate(self._step - 1)
        self._row_is_open = False

    def check_group(self) -> None:
        """Raise AegisError if processes were connected that the guard does not know of.

        Trainers connect them long after the guard was created.
        """
        process_groups.check(self._processes)

    def forget_cleared(self) -> None:
        """Forget the sum if its gradients are gone, before a forward pass needs the memory."""
        if self._sum is not None and accumulation.absent(self._groups):
            self._sum = None

    def continues(self) -> bool:
        """Whether `.grad` still holds the projected sum, which further passes add to.

        Raises:
            AegisError: it is neither that nor cleared, or a step was already taken with it.
        """
        continued = accumulation.continues(self._sum, self._learning())
        if continued and self._sum is not None and not self._sum.empty:
            self._refuse_uncleared()
        return continued

    def _refuse_uncleared(self) -> None:
        """Refuse to add to gradients that were already used in a step: they would count twice."""
        if self._stepper.has_stepped:
            raise AegisError(
                "gradients that were not cleared after their step",
                "optimizer.zero_grad() after each step, or before the next one's first pass",
                "call it; several guard.backward go before one step, none between the step and "
                "zero_grad()",
            )

    def backward(self, loss: Tensor, seen: Pass, scale: float, skips: bool) -> None:
        """Backpropagate from the loss and the penalty of the pass, and project the sum.

        Args:
            loss: scaled by `scale`.
            skips: whether a scaler skips steps that overflow.
        """
        assert self._parts.penalty is not None
        penalty, w2 = self._parts.penalty(seen)
        self._refuse_reentrant(penalty)
        groups = self._learning()
        continued = self.continues()
        total, self._sum = self._sum if continued else None, None  # until this pass has succeeded
        # PyTorch adds to `.grad`, so that must hold the unprojected sum: the sum is projected, not
        # the share of each pass.
        if total is not None:
            accumulation.take_back(total, groups)
        else:
            self.close_row()
        self._see_whether_cleared()
        # Loss and penalty share the graph. Both have the same scale, so that the weights of their
        # gradients are the same as without it.
        loss.backward(retain_graph=True)
        self._stepper.passed()
        # Under FSDP a gradient is reduced and sharded only on its way into `.grad`.
        if self._owners.several:
            taken = backward.second_backward_of_rows(groups, penalty * scale, self._around)
        else:
            taken = backward.second_backward(groups, penalty * scale)
        self._add(total, AnchorGradient(taken, w2), loss.detach(), scale, skips)

    def ahead(self, seen: Pass, scale: float) -> AnchorGradient:
        """The anchor gradient of a pass whose loss is not computed yet; the graph is kept.

        Args:
            scale: the factor that the loss will be scaled by. The penalty is scaled by it before
                its backward pass too, because its half-precision gradients would underflow
                otherwise.
        """
        assert self._parts.penalty is not None
        penalty, w2 = self._parts.penalty(seen)
        self._refuse_reentrant(penalty)
        taken = backward.second_backward(self._learning(), penalty * scale, retain_graph=True)
        return AnchorGradient(taken, w2.detach())

    def reopen(self) -> None:
        """Make `.grad` the unprojected sum, before the loop's own backward pass adds to it.

        DistributedDataParallel averages `.grad` when that pass ends, and by then each process has
        undone its own projection.

        Raises:
            AegisError: as in `continues`.
        """
        self._reopened, self._sum = self._sum if self.continues() else None, None
        if self._reopened is not None:
            accumulation.take_back(self._reopened, self._learning())
        else:
            self.close_row()
        self._see_whether_cleared()

    def _see_whether_cleared(self) -> None:
        """Check, before a backward pass, whether a step that overflowed is over.

        Raises:
            AegisError: it is over only for some of the parameters. The infinite gradients of the
                others would cause every later step to be skipped.
        """
        if accumulation.cleared([self._poisoned]):
            self._poisoned = []
        accumulation.refuse_partly_cleared(self._poisoned)

    def leave(self) -> None:
        """Project `.grad` as before `reopen`, because the backward pass added nothing to it."""
        self._sum, self._reopened = self._reopened, None
        if self._sum is not None:
            accumulation.put_back(self._sum, self._learning())

    def arrived(self, anchor: AnchorGradient, scale: float, skips: bool) -> None:
        """Project `.grad`, to which the loop's own backward pass has added its gradient.

        Args:
            anchor: the result of `ahead` for the same forward pass, with the same `scale`.
        """
        total, self._reopened = self._reopened, None
        self._stepper.passed()
        self._add(total, anchor, None, scale, skips)

    def _add(
        self,
        total: Accumulation | None,
        anchor: AnchorGradient,
        loss: Tensor | None,
        scale: float,
        skips: bool,
    ) -> None:
        """Add an anchor gradient to the sum, and project.

        The ledger's row for this step is that of the sum.
        """
        assert self._parts.combine is not None
        groups, taken, w2 = self._learning(), anchor.taken, anchor.w2
        processes = process_groups.resolved(self._processes)
        if processes is not None:
            if not self._owners.several:  # otherwise they are already averaged
                learning = {id(p): p for group in groups for p in group}
                taken = process_groups.mean_gradients(taken, learning, processes)
            # The same values in every process, so that all agree on whether the step is finite.
            numbers = [w2] if loss is None else [w2, loss]
            w2, *rest = process_groups.mean_over(numbers, processes)
            loss = next(iter(rest), None)
        if total is None:
            if not self._poisoned:  # otherwise it is another micro-batch of the same step
                self._step += 1
            total = accumulation.started(taken, w2)
        else:
            accumulation.grow(total, taken, w2)
        over_rows = self._owners.total if self._owners.several else None
        # Recorded before the combination, which may give these parameters the anchor gradient.
        total.idle = {id(p) for group in groups for p in group if p.grad is None}
        gram, weights = backward.combine_gradients(
            groups, total.anchor, self._parts.combine, over_rows
        )
        # Another micro-batch of the same step replaces the row of the step.
        self._ledger.truncate(self._step - 1)
        numbers = [*gram, total.w2] if loss is None else [loss, *gram, total.w2]
        if not all(x.isfinite().all() for x in numbers) or _overflowed(groups):
            if not skips:
                raise diverged(len(self._ledger))
            self._poisoned = accumulation.poison(total, groups)
            return
        check_row(gram, self._ledger.groups)
        # Both gradients are scaled, so each inner product contains the scale squared.
        tt, ta, aa = (x / scale**2 for x in gram)
        self._ledger.append(self._step, tt, ta, aa, total.w2)
        self._row_is_open, self._skips = True, skips
        accumulation.mark(total, groups, weights)
        self._sum = total

    def _learning(self) -> list[list[nn.Parameter]]:
        groups = [[p for p in group if p.requires_grad] for group in self._groups]
        if not any(groups):
            raise AegisError(
                "a model in which nothing learns any more of what learned when the guard was made",
                "parameters that the guard knows",
                "freeze parts and add adapters (peft.get_peft_model) before the guard is made",
            )
        return groups

    def _refuse_reentrant(self, penalty: Tensor) -> None:
        if not self._checkpointing_checked and backward.uses_reentrant_checkpointing(penalty):
            raise AegisError(
                "gradient checkpointing with use_reentrant=True",
                "use_reentrant=False",
                "use that form, which supports a second pass; Hugging Face: "
                'gradient_checkpointing_kwargs={"use_reentrant": False}',
            )
        self._checkpointing_checked = True


def _overflowed(groups: Sequence[Sequence[nn.Parameter]]) -> bool:
    """Whether combined gradients overflowed in float16, the only dtype with so small a range."""
    gradients = [p.grad for group in groups for p in group if p.grad is not None]
    narrow = [gradient for gradient in gradients if gradient.dtype == torch.float16]
    return bool(narrow) and not nn.utils.get_total_norm(narrow, norm_type=math.inf).isfinite()


def diverged(steps: int) -> Diverged:
    """The error for a loss or gradient that is not finite, after `steps` steps."""
    return Diverged(
        "a loss or gradient that is not finite",
        "finite numbers",
        "lower the learning rate, or pass the GradScaler to guard.backward or guard.automatic; "
        "optimizer.zero_grad() skips this batch",
        steps,
    )


def check_pass(seen: Pass, widths: Sequence[int], compared: Sequence[str]) -> None:
    """Refuse a watched pass that cannot be compared with the anchor.

    Args:
        widths: widths of the anchor's layers.
        compared: token types that are compared separately.

    Raises:
        AegisError: there is no graph, the layers differ from those of the anchor, or there is no
            token of a compared type.
    """
    if not any(hidden.requires_grad for hidden in seen.hidden):
        raise AegisError(
            "hidden states without a graph in every layer",
            "layers that learn, or that read something that does",
            "unfreeze a layer, or leave the guard out: nothing that it guards can change",
        )
    found = [hidden.shape[-1] for hidden in seen.hidden]
    if found != list(widths):
        raise AegisError(
            f"hidden states of width {found} for an anchor of {list(widths)}",
            "the layers it was measured on",
            "give layers= as for the anchor, or measure it again",
        )
    for kind in compared:
        if not torch.any(seen.mask & (seen.image if kind == "image" else ~seen.image)):
            raise AegisError(
                f"a batch without a valid {kind} token",
                "at least one to compare",
                "check the masks",
            )
