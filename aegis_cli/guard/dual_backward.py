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
    """The gradient of one pass's penalty.

    Attributes:
        taken: it, by the parameters' ids; None where the penalty does not reach.
        w2: W2^2 of each layer [L].
    """

    taken: dict[int, Tensor | None]
    w2: Tensor


class DualBackward:
    """The backward passes of a method that has a penalty.

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
        """Begin without a pass.

        Args:
            groups: the parameters that learn, each once; the ledger has a column for each group.
            owners: the processes that have some rows of every weight.
            processes: those that train the model together.
            around: the parameters of the policy that the model is a part of, which are left to the
                task alone.
        """
        self._parts, self._groups, self._stepper = parts, groups, stepper
        self._ledger, self._owners, self._processes = ledger, owners, processes
        self._around = around
        self._sum: Accumulation | None = None
        self._reopened: Accumulation | None = None  # while a backward pass of the loop adds to it
        self._step, self._checkpointing_checked = 0, False
        # Whether the ledger has a row of the last sum, of which a step may still be to come; and
        # whether a scaler may skip that.
        self._row_is_open, self._skips = False, False
        # Those whose `.grad` tells a scaler to skip the step that it is of.
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
        """Drop the row of the last sum where no step was made of it.

        A scaler has skipped it, as for a gradient of what the guard does not know, or the loop has
        left it out.
        """
        if self._row_is_open and not self._stepper.may_have_moved(self._skips):
            self._ledger.truncate(self._step - 1)
        self._row_is_open = False

    def check_group(self) -> None:
        """Raise AegisError where processes have been connected of which the guard does not know.

        Trainers connect them long after the guard was made.
        """
        process_groups.check(self._processes)

    def forget_cleared(self) -> None:
        """Forget the sum if its gradients are gone, before a forward pass needs the memory."""
        if self._sum is not None and accumulation.absent(self._groups):
            self._sum = None

    def continues(self) -> bool:
        """Whether `.grad` still holds the projected sum, which further passes add to.

        Raises:
            AegisError: it is neither that nor cleared, or a step was made of it already.
        """
        continued = accumulation.continues(self._sum, self._learning())
        if continued and self._sum is not None and not self._sum.empty:
            self._refuse_uncleared()
        return continued

    def _refuse_uncleared(self) -> None:
        """Refuse to add to gradients of which a step was made: they would count in the next too."""
        if self._stepper.has_stepped:
            raise AegisError(
                "gradients that were not cleared after their step",
                "optimizer.zero_grad() after each step, or before the next one's first pass",
                "call it; several guard.backward go before one step, none between the step and "
                "zero_grad()",
            )

    def backward(self, loss: Tensor, seen: Pass, scale: float, skips: bool) -> None:
        """Go back from the loss and the pass's penalty, and project the sum.

        Args:
            loss: scaled by `scale`.
            skips: whether a scaler skips steps that overflow.
        """
        assert self._parts.penalty is not None
        penalty, w2 = self._parts.penalty(seen)
        self._refuse_reentrant(penalty)
        groups = self._learning()
        continued = self.continues()
        total, self._sum = self._sum if continued else None, None  # until this pass has ended well
        # PyTorch adds to `.grad`, where the sum has to lie plain: what is projected is the sum, not
        # each pass's share of it.
        if total is not None:
            accumulation.take_back(total, groups)
        else:
            self.close_row()
        self._see_whether_cleared()
        # Loss and penalty share the graph. Both are scaled alike, so that the weights of their
        # gradients are those of unscaled ones.
        loss.backward(retain_graph=True)
        self._stepper.passed()
        # Under FSDP a gradient is reduced and cut only on its way into `.grad`.
        if self._owners.several:
            taken = backward.second_backward_of_rows(groups, penalty * scale, self._around)
        else:
            taken = backward.second_backward(groups, penalty * scale)
        self._add(total, AnchorGradient(taken, w2), loss.detach(), scale, skips)

    def ahead(self, seen: Pass, scale: float) -> AnchorGradient:
        """The anchor gradient of a pass that a loss is still to be made of; the graph stays.

        Args:
            scale: what the loss is going to be scaled by. The penalty is scaled before it goes
                back, as the loss is: in half precision its gradients would vanish otherwise.
        """
        assert self._parts.penalty is not None
        penalty, w2 = self._parts.penalty(seen)
        self._refuse_reentrant(penalty)
        taken = backward.second_backward(self._learning(), penalty * scale, retain_graph=True)
        return AnchorGradient(taken, w2.detach())

    def reopen(self) -> None:
        """Make `.grad` the plain sum, before a backward pass of the loop's own adds to it.

        DistributedDataParallel averages `.grad` as that pass ends, and each process has taken back
        its own projection by then.

        Raises:
            AegisError: as `continues`.
        """
        self._reopened, self._sum = self._sum if self.continues() else None, None
        if self._reopened is not None:
            accumulation.take_back(self._reopened, self._learning())
        else:
            self.close_row()
        self._see_whether_cleared()

    def _see_whether_cleared(self) -> None:
        """Before a backward pass: whether a step that overflowed is over.

        Raises:
            AegisError: it is for some of the parameters alone. The others' infinities would have
                every step skipped from now on.
        """
        if accumulation.cleared([self._poisoned]):
            self._poisoned = []
        accumulation.refuse_partly_cleared(self._poisoned)

    def leave(self) -> None:
        """Project `.grad` as it was before `reopen`, for that pass has added nothing to it."""
        self._sum, self._reopened = self._reopened, None
        if self._sum is not None:
            accumulation.put_back(self._sum, self._learning())

    def arrived(self, anchor: AnchorGradient, scale: float, skips: bool) -> None:
        """Project `.grad`, to which a backward pass of the loop's own has added its gradient.

        Args:
            anchor: what `ahead` gave of the same forward pass, with the same `scale`.
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

        The ledger's row of this step is that of the sum.
        """
        assert self._parts.combine is not None
        groups, taken, w2 = self._learning(), anchor.taken, anchor.w2
        processes = process_groups.resolved(self._processes)
        if processes is not None:
            if not self._owners.several:  # else they arrive as means
                learning = {id(p): p for group in groups for p in group}
                taken = process_groups.mean_gradients(taken, learning, processes)
            # The same figures in every process: they decide together whether the step is finite.
            numbers = [w2] if loss is None else [w2, loss]
            w2, *rest = process_groups.mean_over(numbers, processes)
            loss = next(iter(rest), None)
        if total is None:
            if not self._poisoned:  # else it is a further micro-batch of that step
                self._step += 1
            total = accumulation.started(taken, w2)
        else:
            accumulation.grow(total, taken, w2)
        over_rows = self._owners.total if self._owners.several else None
        # Noted before the combination, which may give these parameters the anchor's gradient.
        total.idle = {id(p) for group in groups for p in group if p.grad is None}
        gram, weights = backward.combine_gradients(
            groups, total.anchor, self._parts.combine, over_rows
        )
        # A further micro-batch of the same step replaces the step's row.
        self._ledger.truncate(self._step - 1)
        numbers = [*gram, total.w2] if loss is None else [loss, *gram, total.w2]
        if not all(x.isfinite().all() for x in numbers) or _overflowed(groups):
            if not skips:
                raise diverged(len(self._ledger))
            self._poisoned = accumulation.poison(total, groups)
            return
        check_row(gram, self._ledger.groups)
        # Both gradients are scaled, so that each inner product has the scale twice.
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
    """Whether a combination of finite gradients is none in float16, the only type so narrow."""
    gradients = [p.grad for group in groups for p in group if p.grad is not None]
    narrow = [gradient for gradient in gradients if gradient.dtype == torch.float16]
    return bool(narrow) and not nn.utils.get_total_norm(narrow, norm_type=math.inf).isfinite()


def diverged(steps: int) -> Diverged:
    """The error for a loss or gradient that is not finite, after so many steps."""
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
        widths: of the anchor's layers.
        compared: token types that are compared apart.

    Raises:
        AegisError: no graph, other layers than the anchor's, or no token of a compared type.
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
