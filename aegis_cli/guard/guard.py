"""The guard: a method of Aegis in any PyTorch training loop."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import torch
from torch import Tensor, nn
from torch import distributed as dist
from torch.optim.optimizer import Optimizer

from aegis_cli import methods
from aegis_cli.anchors.any_model import Measurement
from aegis_cli.anchors.hooks import LayerHooks, Removable
from aegis_cli.common.errors import AegisError
from aegis_cli.common.ranks import ALONE, Ranks
from aegis_cli.guard import process_groups
from aegis_cli.guard.automatic import AutomaticLoop, LoopHooks, Source
from aegis_cli.guard.dual_backward import DualBackward, check_pass, diverged
from aegis_cli.guard.options import SECTIONS, is_pretrained, naming_its_part, start
from aegis_cli.guard.process_groups import ProcessGroup
from aegis_cli.guard.stepper import GuardedStepper, Scaler
from aegis_cli.guard.trainer_callback import trainer_callback
from aegis_cli.methods import backward
from aegis_cli.methods.base import Pass
from aegis_cli.methods.known_parameters import refuse_partly_sharded, refuse_sharded, sharded
from aegis_cli.methods.ledger_file import LedgerOutsideRuns
from aegis_cli.models import structure

if TYPE_CHECKING:
    from transformers import TrainerCallback

METHODS = tuple(SECTIONS)
# The token types that each scope compares separately.
_COMPARED = {"all": (), "image": ("image",), "text": ("text",), "each": ("image", "text")}


class Guard(Removable):
    """Protects what a model knows while your own loop trains it.

        guard = Guard(model, anchor="anchor.safetensors", layers="model.text_model.layers")
        for batch in loader:
            with guard.watch(batch["attention_mask"]):  # None: every token counts
                loss = model(**batch).loss
            guard.backward(loss)  # instead of loss.backward()
            guard.step(optimizer)  # or optimizer.step(), if nothing constrains the update
            optimizer.zero_grad()
        guard.ledger.save("ledger.safetensors")

    Pass the VLM rather than the policy around it: parameters outside it follow the task alone.

    With several backward passes before one step, the *sum* of their task gradients is projected
    against the mean of their anchor gradients, and the result is in `.grad` after each pass.
    Gradients that were in `.grad` before the first pass are part of that sum.

    Attributes:
        ledger: inner products of each group that has trainable parameters, and W2^2 of each layer,
            one row per optimizer step.
        unprotected: names of trainable modules that are not protected (`nullspace` and `kfac`):
            those that `protect` leaves free, and those on which no answer depended when the anchor
            was measured.
    """

    def __init__(
        self,
        model: nn.Module,
        anchor: str | Path,
        layers: str | Sequence[nn.Module] | None = None,
        *,
        method: str = "aegis",
        part: str | None = None,
        vision: str | Sequence[str] = (),
        process_group: ProcessGroup = None,
        **options: Any,
    ) -> None:
        """Check model and anchor against each other, and start the method.

        The weights must be those that the anchor was measured on.

        Args:
            model: the pre-trained VLM, or with `part` the policy around it; frozen parts stay
                frozen.
            anchor: file from `Guard.measure`, or from `aegis anchor` for the loaded VLM.
            layers: dotted name of the list of transformer layers, or the layers themselves; None:
                the only list of equal blocks.
            part: dotted name of the VLM within a policy given as `model`; all other names are
                relative to it.
            method: `aegis`, or `nullspace` or `kfac`, which need `guard.step`.
            vision: dotted names of the parts that read pixels (kind `stem` of `protect`).
            process_group: the processes that train copies of the model together
                (DistributedDataParallel), or a model that is already sharded (FSDP2). "world" means
                all of them, even if a trainer connects them later.
            options: options of the method, as in a recipe. `nullspace` and `kfac` protect
                everything trainable or raise an error; with `protect`, exactly the kinds given (for
                `kfac`: `maps`, `stem`). Their `every` defaults to 1: see `settle`.

        Raises:
            AegisError: nothing is trainable, the layers cannot be identified, the anchor is of
                another model, options are unknown, or weights are sharded in an unsupported way.
        """
        if method not in METHODS:
            raise AegisError(
                f"method '{method}'", f"one of {', '.join(METHODS)}", "choose with method="
            )
        policy = model
        model, path = structure.part_of(policy, part), Path(anchor)
        dual = methods.get(method).compares_layers
        self._owners = _owners(model, process_groups.resolved(process_group))
        if dual:
            process_groups.check(process_group)
        _refuse_unfit(model)
        # The other methods work on maps and do not need to know which modules are layers.
        with naming_its_part(model, path, part):
            found = structure.find_layers(model, layers) if dual else {}
        groups = structure.learning_groups(model, found) if dual else {}
        pixels = structure.plain_parts(model, vision)
        started = start(method, model, path, found, groups, pixels, options, self._owners, part)
        self._parts, self._widths = started.parts, started.widths
        self.unprotected, self._fingerprint = started.unprotected, started.fingerprint
        self._compared = _COMPARED[options.get("scope", "all")]
        self.ledger = LedgerOutsideRuns(
            list(groups), [f"layers.{i}" for i in range(len(found))], method, started.sha256
        )
        # Naming the kinds to protect is a decision about all others too.
        averaging = {} if dual or "protect" in options else structure.averaging(model)
        self._stepper = GuardedStepper(
            model, self._parts, self._owners.several, averaging, started.why_strong
        )
        self._hooks = LayerHooks(found)
        self._seen: Pass | None = None
        self._dual: DualBackward | None = None
        if dual:
            self._dual = DualBackward(
                self._parts,
                list(groups.values()),
                self._stepper,
                self.ledger,
                self._owners,
                process_group,
                list(policy.parameters()),
            )
        self._model, self._removed = model, False
        self._automatic: AutomaticLoop | None = None
        self._loop_hooks: LoopHooks | None = None

    measure = Measurement

    # --- the loop ---------------------------------------------------------------------------------

    @contextlib.contextmanager
    def watch(self, mask: Tensor | None, image: Tensor | None = None) -> Generator[None]:
        """Compare the forward pass inside the block with the anchor.

        Each `backward` needs one block; evaluation needs none. `nullspace` and `kfac` compare
        nothing and need no block.

        Args:
            mask: [B, T] for the tokens that the layers see, true at those that count; None: every
                token counts. If a layer is called several times in the block, it covers the tokens
                of all calls, in their order.
            image: [B, T] or [T], true at image tokens; for the options `scope="image"`, `"text"`
                and `"each"`.

        Raises:
            AegisError: the mask has a wrong shape, layers were not called or have no graph, the
                previous pass is still unused, or the model has parameters that the guard does not
                know.
        """
        self._check_ready()
        self._refuse_automatic("guard.watch", "the model itself")
        _check_mask(mask)
        self._stepper.check()
        if self._dual is None:
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
        self._check_image(image)
        self._dual.check_group()
        self._dual.forget_cleared()
        # In every pass, because the model may be compiled after the guard was created.
        backward.recompile_for_two_backward_passes()
        with self._hooks.watch(mask, image, self._note):
            yield

    def note(self, layer: int | nn.Module, hidden: Tensor) -> None:
        """Report the hidden states after a layer by hand, if the layer itself is never called.

        Loops that run two models side by side need this, such as that of pi0: they call the parts
        of both models' layers and attend over the tokens of both. Outside a watched pass this does
        nothing, so the call can stay in the policy. It also does nothing after `remove`, and for
        `nullspace` and `kfac`, which compare no hidden states.

        Args:
            layer: one of the guard's layers, or its index.
            hidden: [B, T, D] after the layer, for the tokens that the mask covers.

        Raises:
            AegisError: it is none of the layers, or one that is also called.
        """
        if not self._removed:
            self._hooks.note(layer, hidden)

    def automatic(
        self,
        *,
        around: nn.Module | None = None,
        mask: Source = "attention_mask",
        image: Source = None,
        scaler: Scaler | None = None,
    ) -> Self:
        """Guard a loop that never calls the guard: a trainer's, or your own, unchanged.

        From now on each forward pass with gradients is watched, each `backward()` leaves the
        gradients that the method computes, and each `optimizer.step()` is constrained.

        Args:
            around: the module whose call is one forward pass; None: the model itself.
            mask: the argument of that call that is the mask [B, T] of `watch`; or a function that
                takes a mapping of all its arguments and returns the mask; None: every token counts.
            image: likewise for the image mask, for the options `scope="image"`, `"text"`, `"each"`.
            scaler: the GradScaler that scales the loop's losses.

        Returns:
            The guard itself.

        Raises:
            AegisError: a needed image mask is missing, the method has a second backward pass but
                the weights are sharded, or the guard is automatic already.
        """
        self._check_ready()
        if self._automatic is not None:
            raise AegisError(
                "guard.automatic of an automatic guard",
                "one call of it",
                "leave the second one out; guard.callback() calls it as a training begins",
            )
        if around is not None and not isinstance(around, nn.Module):
            raise AegisError(
                f"around={around!r}", "the module whose call is a pass", "around=policy"
            )
        if self._owners.several and self._dual is not None:
            raise AegisError(
                "guard.automatic with sharded weights and a second backward pass",
                "weights that are whole in every process, or method nullspace or kfac",
                "call the guard in the loop: guard.watch, guard.backward and guard.step",
            )
        self._check_image(image)
        backward.compile_for_two_backward_passes()
        self._automatic = AutomaticLoop(
            self._stepper,
            self._dual,
            self._hooks,
            self._check_pass,
            scaler,
            self.ledger,
            self._owners,
        )
        self._stepper.take_by_itself(self._anchor_gradient)
        called = self._model if around is None else around
        # Hooks on sharded parameters are never called: see `LoopHooks`.
        learning = [] if self._owners.several else structure.learning(self._model).values()
        reads = self._dual is not None
        self._loop_hooks = LoopHooks(learning, called, self._automatic, reads, mask, image)
        return self

    def callback(self, *, mask: Source = "attention_mask", image: Source = None) -> TrainerCallback:
        """A callback for `transformers.Trainer(callbacks=[...])` that guards its training.

        It makes the guard automatic when training begins, and settles before each checkpoint and
        evaluation, and at the end.

        Args:
            mask: as for `automatic`.
            image: as for `automatic`.

        Raises:
            AegisError: transformers is not installed.
        """
        untrained = functools.partial(is_pretrained, self._model, self._fingerprint)
        return trainer_callback(self, self._model, mask, image, untrained)

    @property
    def is_automatic(self) -> bool:
        """Whether `automatic` was called."""
        return self._automatic is not None

    @property
    def pending(self) -> int:
        """Steps since updates were last constrained: see `settle`."""
        return self._stepper.pending

    def discard(self) -> None:
        """Forget the watched pass of a batch that is skipped."""
        self._seen = None
        if self._automatic is not None:
            self._automatic.discard()

    def backward(self, loss: Tensor, scaler: Scaler | None = None) -> None:
        """Compute the gradients that the method wants in `.grad`, instead of `loss.backward()`.

        Args:
            loss: the task loss, a scalar with its graph, unscaled.
            scaler: scales the loss and the penalty; then `scaler.unscale_`, clipping and
                `scaler.step` follow as usual.

        Raises:
            AegisError: there is no watched pass, the loss is not a scalar with a graph, gradients
                changed between two calls, or the pass does not reach the guarded parameters.
            Diverged: a loss or gradient is not finite, and there is no scaler to skip the step;
                nothing has moved.
        """
        self._check_ready()
        self._refuse_automatic("guard.backward", "loss.backward()")
        if not self._owners.several:
            # Sharded weights may still be gathered, with other parameters in their place.
            self._stepper.check()
        if self._hooks.open:
            raise AegisError(
                "guard.backward inside guard.watch",
                "the forward pass alone in the block",
                "call it after the block",
            )
        _check_loss(loss)
        scaled = loss if scaler is None else scaler.scale(loss)
        # An enabled scaler expects overflows: it skips such steps itself and lowers its scale.
        skips = scaler is not None and scaler.is_enabled()
        if self._dual is None:
            # No second backward pass: the method constrains the update, and the gradients stay
            # those of the task.
            if not skips and not loss.isfinite():
                raise diverged(len(self.ledger))
            scaled.backward()
            self._stepper.passed()
            if not skips and not self._stepper.gradients_finite(self._owners):
                raise diverged(len(self.ledger))
            return
        seen, self._seen = self._seen, None  # used only once: its graph is freed here
        if seen is None:
            raise AegisError(
                "guard.backward without a watched pass",
                "one guard.watch block for each guard.backward",
                "run the forward pass inside `with guard.watch(mask):`",
            )
        self._dual.backward(scaled, seen, 1.0 if scaler is None else scaler.get_scale(), skips)

    def step(self, optimizer: Optimizer, scaler: Scaler | None = None) -> None:
        """Take a step with the update that the method allows, instead of `optimizer.step()`.

        Args:
            optimizer: the user's own optimizer.
            scaler: if given, the step is taken through it, instead of `scaler.step(optimizer)`.

        Raises:
            AegisError: there was no guard.backward before it, or the trainable parameters are not
                those from when the guard was created.
        """
        self._check_ready()
        self._refuse_automatic("guard.step", "optimizer.step()")
        _check_optimizer(optimizer, self._parts.constrains)
        dual = self._dual
        if self._parts.constrains and dual is not None and not dual.begun and scaler is None:
            raise AegisError(
                "guard.step without guard.backward",
                "guard.backward(loss) first",
                "call it instead of loss.backward()",
            )
        self._stepper.step(optimizer, scaler, self._anchor_gradient())
        # With several optimizers, another one may still take a step with the same sum.
        if dual is not None and self._stepper.is_of_all(optimizer):
            dual.close_row()

    def settle(self) -> None:
        """Constrain the pending steps now, before weights are saved, loaded, copied or evaluated.

        Only `nullspace` and `kfac` with `every` above 1 need it, because they constrain that many
        steps together: in between, the weights also contain what the last steps have moved along
        protected directions.
        """
        self._check_ready()
        self._stepper.settle()

    def drop_pending(self) -> None:
        """Forget the pending steps, after other weights were loaded into the model.

        The next step starts from the loaded weights. `nullspace` protects them from there on, and
        `kfac` still pulls towards the pre-trained ones. What was pending is not constrained, so do
        not call this for weights that the pending steps have moved: see `settle`.
        """
        self._check_ready()
        self._stepper.drop_pending()

    def remove(self) -> None:
        """Settle, and remove all hooks from the model."""
        self._stepper.settle()
        self._hooks.remove()
        self._stepper.remove()
        if self._loop_hooks is not None:
            self._loop_hooks.remove()
        self._removed, self._seen = True, None
        if self._dual is not None:
            self._dual.forget()

    def _note(self, seen: Pass) -> None:
        self._check_pass(seen)
        self._seen = seen

    def _check_pass(self, seen: Pass) -> None:
        check_pass(seen, self._widths, self._compared)

    def _anchor_gradient(self) -> dict[int, Tensor | None]:
        return {} if self._dual is None else self._dual.anchor

    # --- checks -----------------------------------------------------------------------------------

    def _check_ready(self) -> None:
        if self._removed:
            raise AegisError("a guard that was removed", "one at work", "make a new Guard")

    def _check_image(self, image: object) -> None:
        if self._compared and image is None:
            raise AegisError(
                "no image mask",
                "image= for a scope that tells tokens apart",
                "guard.watch(mask, image=...), or guard.automatic(image=...)",
            )

    def _refuse_automatic(self, found: str, instead: str) -> None:
        if self._automatic is not None:
            raise AegisError(
                f"{found} of an automatic guard",
                f"{instead}, which it sees by itself",
                f"call {instead}, or leave guard.automatic() out",
            )


def _check_mask(mask: object) -> None:
    """Raise AegisError for a mask that is not a tensor."""
    if mask is not None and not isinstance(mask, Tensor):
        raise AegisError(
            f"a mask that is a {type(mask).__name__}",
            "a tensor [B, T]",
            "torch.as_tensor(mask); from a batch, only its mask: batch['attention_mask']",
        )


def _check_loss(loss: object) -> None:
    """Raise AegisError for a loss that no backward pass can start from."""
    if not isinstance(loss, Tensor):
        raise AegisError(
            f"a loss that is a {type(loss).__name__}",
            "a tensor of one number with its graph",
            "with a Hugging Face model, give output.loss; leave .item() out",
        )
    if loss.numel() != 1 or not loss.requires_grad:
        raise AegisError(
            f"a loss {list(loss.shape)} {'with' if loss.requires_grad else 'without'} a graph",
            "one number with its graph",
            "give the loss that the forward pass computed",
        )


def _check_optimizer(optimizer: object, constrained: bool) -> None:
    """Raise AegisError for an object that takes no steps, or lacks the `param_groups` needed."""
    needed = "param_groups" if constrained else "step"
    is_scheduler = isinstance(optimizer, torch.optim.lr_scheduler.LRScheduler)
    if is_scheduler or not hasattr(optimizer, needed):
        raise AegisError(
            f"guard.step of a {type(optimizer).__name__}",
            "an optimizer",
            "guard.step(optimizer), and scheduler.step() after it as usual",
        )


def _refuse_unfit(model: nn.Module) -> None:
    """Raise AegisError for a model that no method can guard, or in which nothing learns."""
    _refuse_sparse(model)
    structure.refuse_offloaded(model)
    _refuse_spread_together(model)
    if not structure.learning(model):
        raise AegisError(
            f"a {type(model).__name__} without trainable parameters",
            "at least one",
            "model.requires_grad_(True)",
        )


def _refuse_sparse(model: nn.Module) -> None:
    """Raise AegisError for tables with sparse gradients, which no projection supports."""
    for name, module in model.named_modules():
        table = isinstance(module, nn.Embedding | nn.EmbeddingBag)
        if table and module.sparse and module.weight.requires_grad:
            raise AegisError(
                f"'{name}', a table with sparse gradients",
                "dense gradients",
                "make it with sparse=False, or freeze it",
            )


def _refuse_spread_together(model: nn.Module) -> None:
    """Raise AegisError if several processes each have a model that spans several devices.

    They would exchange gradients on a device that belongs to another process.
    """
    devices = sorted({str(p.device) for p in model.parameters()})
    if len(devices) > 1 and process_groups.count() > 1:
        raise AegisError(
            f"a model on {' and '.join(devices)} in one of {process_groups.count()} processes",
            "a model on one device in each process, or on several devices in one process",
            "load it without device_map in each process, or start a single process",
        )


def _owners(model: nn.Module, group: dist.ProcessGroup | None) -> Ranks:
    """The processes that each have some rows of every weight; just one if each has all.

    Raises:
        AegisError: the weights are sharded in a way that no method supports.
    """
    if not sharded(model):
        return ALONE
    if group is None:
        refuse_sharded(model)
    found = Ranks(dist.get_rank(group), dist.get_world_size(group), group)
    if not found.several:
        raise AegisError(
            "weights that are sharded over one process",
            "several processes, or whole weights",
            "leave fully_shard out in a single process",
        )
    refuse_partly_sharded(model, found.count)
    return found
