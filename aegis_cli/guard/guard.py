"""AEGIS around the backward pass of any PyTorch loop, or another method around its steps."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn
from torch import distributed as dist
from torch.optim.optimizer import Optimizer

from aegis_cli import methods
from aegis_cli.anchors.any_model import Measurement
from aegis_cli.anchors.hooks import LayerHooks, Removable
from aegis_cli.common.errors import AegisError, Diverged
from aegis_cli.common.ranks import ALONE, Ranks
from aegis_cli.guard import accumulation
from aegis_cli.guard.accumulation import Accumulation
from aegis_cli.guard.options import SECTIONS, start
from aegis_cli.guard.stepper import GuardedStepper, Scaler
from aegis_cli.methods import backward
from aegis_cli.methods.base import Pass
from aegis_cli.methods.known_parameters import (
    check_row,
    refuse_partly_sharded,
    refuse_sharded,
    sharded,
)
from aegis_cli.methods.ledger_file import LedgerOutsideRuns
from aegis_cli.models import structure

if TYPE_CHECKING:
    from torch.distributed import ProcessGroup

METHODS = tuple(SECTIONS)
# The token types that a scope tells apart.
_COMPARED = {"all": (), "image": ("image",), "text": ("text",), "each": ("image", "text")}


class Guard(Removable):
    """Keeps what a model knew while somebody else's loop trains it.

        guard = Guard(model, anchor="anchor.safetensors", layers="model.text_model.layers")
        for batch in loader:
            with guard.watch(batch["attention_mask"]):  # None: every token counts
                loss = model(**batch).loss
            guard.backward(loss)  # instead of loss.backward()
            guard.step(optimizer)  # or optimizer.step(), where nothing constrains the update
            optimizer.zero_grad()
        guard.ledger.save("ledger.safetensors")

    Give it the VLM rather than the policy around it: what lies outside is left to the task alone.

    Several backward passes before one step: the *sum* of their task gradients is projected against
    the mean of their anchor gradients, and lies in `.grad` after each. What lay in `.grad` before
    the first is part of that sum.

    Attributes:
        ledger: inner products of each group and W2^2 of each layer, one row per optimizer step.
        unprotected: names of learning modules that `protect` leaves free (`nullspace` and `kfac`).
    """

    def __init__(
        self,
        model: nn.Module,
        anchor: str | Path,
        layers: str | Sequence[nn.Module] | None = None,
        *,
        method: str = "aegis",
        vision: str | Sequence[str] = (),
        process_group: ProcessGroup | None = None,
        **options: Any,
    ) -> None:
        """Check model and anchor against each other, and start the method.

        The weights must be those that the anchor was measured on.

        Args:
            model: the pre-trained VLM; frozen parts stay frozen.
            anchor: file of `Guard.measure`, or for the embedded VLM of `aegis anchor`.
            layers: dotted name of the list of transformer layers, or the layers; None: the only
                list of equal blocks.
            method: `aegis`; or `nullspace` or `kfac`, which need `guard.step`.
            vision: dotted names of the parts that read pixels (of `protect`, the kind `stem`).
            process_group: the processes that train copies of the model together
                (DistributedDataParallel), or a model that is sharded already (FSDP2).
            options: the method's, as in a recipe. `nullspace` and `kfac` protect all that learns,
                or refuse; with `protect`, exactly those kinds (of `kfac`: `maps`, `stem`). Their
                `every` is 1 unless given: see `settle`.

        Raises:
            AegisError: nothing that learns, layers that cannot be told, an anchor of another model,
                unknown options, sharded weights.
        """
        if method not in METHODS:
            raise AegisError(
                f"method '{method}'", f"one of {', '.join(METHODS)}", "choose with method="
            )
        self._dual, self._processes = methods.get(method).dual, process_group
        self._owners = _owners(model, process_group)
        if self._dual:
            accumulation.check_group(process_group)
        if not structure.learning(model):
            raise AegisError(
                f"a {type(model).__name__} without trainable parameters",
                "at least one",
                "model.requires_grad_(True)",
            )
        # The other methods look at maps, and need not be told which modules are layers.
        found = structure.find_layers(model, layers) if self._dual else {}
        groups = structure.parameter_groups(model, found) if self._dual else {}
        self._groups = list(groups.values())
        pixels = structure.plain_parts(model, vision)
        path = Path(anchor)
        started = start(method, model, path, found, groups, pixels, options, self._owners)
        self._parts, self._widths = started.parts, started.widths
        self.unprotected = started.unprotected
        self._compared = _COMPARED[options.get("scope", "all")]
        self.ledger = LedgerOutsideRuns(
            list(groups), [f"layers.{i}" for i in range(len(found))], method, started.sha256
        )
        self._hooks, self._seen = LayerHooks(found), None
        self._sum: Accumulation | None = None
        self._stepper = GuardedStepper(model, self._parts, may_shard=self._owners.several)
        self._step, self._removed, self._looked = 0, False, False

    measure = Measurement

    # --- the loop ---------------------------------------------------------------------------------

    @contextlib.contextmanager
    def watch(self, mask: Tensor | None, image: Tensor | None = None) -> Iterator[None]:
        """Compare the forward pass inside the block with the anchor.

        Each `backward` needs one block; evaluation needs none. `nullspace` and `kfac` compare
        nothing, and need no block.

        Args:
            mask: [B, T] of the tokens that the layers see, true at those that count; None: every
                token counts. Where a layer is called several times in the block, all tokens in the
                order of the calls.
            image: [B, T] or [T], true at image tokens; for the options `scope="image"`, `"text"`
                and `"each"`.

        Raises:
            AegisError: a mask of another shape, layers that were not called or have no graph, a
                pass still unused, parameters that the guard does not know.
        """
        self._check_ready()
        self._stepper.check()
        if not self._dual:
            yield
            return
        if self._seen is not None:
            raise AegisError(
                "a watched pass that guard.backward never saw",
                "guard.backward(loss) for every watched pass",
                "call it instead of loss.backward(); guard.discard() for a batch that you skip; "
                "evaluate outside guard.watch",
            )
        if not torch.is_grad_enabled():
            raise AegisError(
                "a watched pass without gradients",
                "a training pass",
                "evaluate outside guard.watch",
            )
        if self._compared and image is None:
            raise AegisError(
                "no image mask",
                "image= for a scope that tells tokens apart",
                "guard.watch(mask, image=...)",
            )
        if self._sum is not None and accumulation.absent(self._groups):
            self._sum = None  # before the forward pass needs the memory
        backward.keep_compiled()
        with self._hooks.watch(mask, image, self._note):
            yield

    def discard(self) -> None:
        """Forget the watched pass of a batch that is skipped."""
        self._seen = None

    def backward(self, loss: Tensor, scaler: Scaler | None = None) -> None:
        """Leave the gradients as the method wants them in `.grad`, instead of `loss.backward()`.

        Args:
            loss: the task's, a scalar with its graph, unscaled.
            scaler: scales it and the penalty; then `scaler.unscale_`, clipping and `scaler.step`
                follow as ever.

        Raises:
            AegisError: no watched pass, no scalar with a graph, gradients that changed between two
                calls, or a pass that does not reach what the guard knows.
            Diverged: a loss or gradient that is not finite, and no scaler to skip the step; nothing
                has moved.
        """
        self._check_ready()
        if not self._owners.several:
            # Sharded weights may still be gathered, and others then in their place.
            self._stepper.check()
        if self._hooks.open:
            raise AegisError(
                "guard.backward inside guard.watch",
                "the forward pass alone in the block",
                "call it after the block",
            )
        if loss.numel() != 1 or not loss.requires_grad:
            raise AegisError(
                f"a loss {list(loss.shape)} {'with' if loss.requires_grad else 'without'} a graph",
                "one number with its graph",
                "give the loss that the forward pass computed",
            )
        scaled = loss if scaler is None else scaler.scale(loss)
        # An enabled scaler expects overflows: it skips such steps by itself, and lowers its scale.
        skips = scaler is not None and scaler.is_enabled()
        if not self._dual:
            if not skips and not loss.isfinite():
                raise self._diverged()
            scaled.backward()
            self._stepper.passed()
            if not skips and not self._gradients_finite():
                raise self._diverged()
            return
        seen, self._seen = self._seen, None
        if seen is None:
            raise AegisError(
                "guard.backward without a watched pass",
                "one guard.watch block for each guard.backward",
                "run the forward pass inside `with guard.watch(mask):`",
            )
        self._dual_backward(scaled, seen, 1.0 if scaler is None else scaler.get_scale(), skips)

    def step(self, optimizer: Optimizer, scaler: Scaler | None = None) -> None:
        """Take the step with the update as the method wants it, instead of `optimizer.step()`.

        Args:
            optimizer: the user's own.
            scaler: takes the step where there is one, instead of `scaler.step(optimizer)`.

        Raises:
            AegisError: no guard.backward before it, or other parameters learning than when the
                guard was made.
        """
        self._check_ready()
        if self._parts.constrains and self._dual and self._sum is None and scaler is None:
            raise AegisError(
                "guard.step without guard.backward",
                "guard.backward(loss) first",
                "call it instead of loss.backward()",
            )
        self._stepper.step(optimizer, scaler, {} if self._sum is None else self._sum.anchor)

    def settle(self) -> None:
        """Constrain the steps since the last constraint now, before a model is saved or evaluated.

        Only `nullspace` and `kfac` with `every` above 1 need it, which constrain so many steps
        together: in between, the weights also hold what the last steps have moved along protected
        directions.
        """
        self._check_ready()
        self._stepper.settle()

    def remove(self) -> None:
        """Settle, and take all hooks off; the model is as it was."""
        self._stepper.settle()
        self._hooks.remove()
        self._stepper.remove()
        self._removed, self._seen, self._sum = True, None, None

    # --- two backward passes ----------------------------------------------------------------------

    def _note(self, seen: Pass) -> None:
        if not any(hidden.requires_grad for hidden in seen.hidden):
            raise AegisError(
                "hidden states without a graph in every layer",
                "layers that learn, or that something below them feeds",
                "unfreeze a layer, or do without the guard: nothing it guards can move",
            )
        widths = [hidden.shape[-1] for hidden in seen.hidden]
        if widths != self._widths:
            raise AegisError(
                f"hidden states of width {widths} for an anchor of {self._widths}",
                "the layers it was measured on",
                "give layers= as for the anchor, or measure it again",
            )
        for kind in self._compared:
            if not (seen.mask & (seen.image if kind == "image" else ~seen.image)).any():
                raise AegisError(
                    f"a batch without a valid {kind} token",
                    "at least one, for they are compared",
                    "check the masks",
                )
        self._seen = seen

    def _dual_backward(self, loss: Tensor, seen: Pass, scale: float, skips: bool) -> None:
        """Add both gradients of one graph to the sum, and project the sum.

        The ledger's row of this step is that of the sum.
        """
        assert self._parts.penalty is not None and self._parts.combine is not None
        penalty, w2 = self._parts.penalty(seen)
        self._refuse_reentrant(penalty)
        groups = self._groups_that_learn()
        if not any(groups):
            raise AegisError(
                "a model of which nothing learns any more that learned when the guard was made",
                "parameters that the guard knows",
                "freeze, and add adapters (peft.get_peft_model), before the guard is made",
            )
        total = self._sum if accumulation.continues(self._sum, groups) else None
        self._sum = None  # until this pass has ended well
        if total is not None:
            accumulation.take_back(total, groups)
        # Loss and penalty share the graph. Both are scaled alike, so that the weights of their
        # gradients are those of unscaled ones.
        loss.backward(retain_graph=True)
        self._stepper.passed()
        if self._owners.several:
            taken = backward.second_backward_of_rows(groups, penalty * scale)
        else:
            taken = backward.second_backward(groups, penalty * scale)
        if self._processes is not None:
            if not self._owners.several:  # else they arrive as means
                learning = {id(p): p for group in groups for p in group}
                taken = accumulation.mean_gradients(taken, learning, self._processes)
            w2, loss = accumulation.mean_over([w2, loss.detach()], self._processes)
        if total is None:
            self._step += 1
            total = accumulation.started(taken, w2)
        else:
            accumulation.grow(total, taken, w2)
        over_rows = self._owners.total if self._owners.several else None
        gram, weights = backward.bend(groups, total.anchor, self._parts.combine, over_rows)
        # A further micro-batch of the same step replaces the step's row.
        self.ledger.truncate(self._step - 1)
        if not all(x.isfinite().all() for x in (loss, *gram, total.w2)):
            if not skips:
                raise self._diverged()
            accumulation.poison(groups)
            return
        check_row(gram, self.ledger.groups)
        self.ledger.append(self._step, *(x / scale**2 for x in gram), total.w2)
        accumulation.mark(total, groups, weights)
        self._sum = total

    def _groups_that_learn(self) -> list[list[nn.Parameter]]:
        return [[p for p in group if p.requires_grad] for group in self._groups]

    def _gradients_finite(self) -> bool:
        largest = nn.utils.get_total_norm(self._stepper.gradients(), norm_type=math.inf)
        return not self._owners.any(not largest.isfinite())[0]

    def _diverged(self) -> Diverged:
        return Diverged(
            "a loss or gradient that is not finite",
            "finite numbers",
            "lower the learning rate, or give guard.backward the GradScaler; "
            "optimizer.zero_grad() goes on without this batch",
            len(self.ledger),
        )

    def _refuse_reentrant(self, penalty: Tensor) -> None:
        if not self._looked and backward.has_node(penalty, "CheckpointFunctionBackward"):
            raise AegisError(
                "gradient checkpointing with use_reentrant=True",
                "use_reentrant=False",
                "the other knows no second pass; Hugging Face: "
                'gradient_checkpointing_kwargs={"use_reentrant": False}',
            )
        self._looked = True

    # --- checks -----------------------------------------------------------------------------------

    def _check_ready(self) -> None:
        if self._removed:
            raise AegisError("a guard that was removed", "one at work", "make a new Guard")


def _owners(model: nn.Module, group: ProcessGroup | None) -> Ranks:
    """The processes that have some rows of every weight; one where each has all.

    Raises:
        AegisError: weights that are sharded in a way that no method knows.
    """
    if not sharded(model):
        return ALONE
    if group is None:
        refuse_sharded(model)
    found = Ranks(dist.get_rank(group), dist.get_world_size(group), group)
    refuse_partly_sharded(model, found.count)
    return found
