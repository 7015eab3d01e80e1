"""The common parts of both pre-trainings: two optimizers, a resumable loop, and one state file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor, nn

from aegis_cli.common import artifacts, files, interrupts
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Progress
from aegis_cli.common.state_dicts import reading_meta
from aegis_cli.models.backbones import embedded_file
from aegis_cli.models.backbones.embedded_file import EmbeddedModel
from aegis_cli.recipes import DualRecipe, PretrainRecipe, digest, every_key
from aegis_cli.training import folder, optimizer_state
from aegis_cli.training.schedule import warmup_then_decay

STATE = "state.safetensors"
FINAL_LR_SHARE = 0.02
CLIP_NORM = 1.0


class Pretraining(Protocol):
    """One run of pre-training.

    `parameters` are all trainable ones, including those that are not part of the finished model.
    """

    optimizers: list[torch.optim.Optimizer]

    @property
    def recipe(self) -> PretrainRecipe | DualRecipe: ...

    @property
    def model(self) -> nn.Module: ...

    @property
    def parameters(self) -> dict[str, nn.Parameter]: ...


def begin(recipe: PretrainRecipe | DualRecipe, out: Path, resume: bool) -> Path:
    """Create the folder, and return the path where the state is or will be.

    Raises:
        AegisError: `out` holds an earlier run and `resume` is off, its state belongs to another
            recipe, or it holds a finished model without a state to resume from.
    """
    path = out / STATE
    if not path.exists() and (out / "model.safetensors").exists():
        raise AegisError(
            f"a finished model in '{out}'", "a folder without one", "choose another --out"
        )
    if path.exists() and not resume:
        raise AegisError(
            f"{path} from an earlier run",
            "an empty output folder",
            "add --resume, or choose another --out",
        )
    files.make_folder(out)
    if path.exists():
        _check_same(recipe, path)
    return path


def _check_same(recipe: PretrainRecipe | DualRecipe, path: Path) -> None:
    """Raise AegisError unless the state in `path` belongs to this recipe.

    A state of an earlier version does not contain its recipe.
    """
    saved = artifacts.read_header(path, "training-state")
    if saved.inputs.get("recipe") == digest(recipe):
        return
    began = saved.meta.get("recipe")
    why = f": {folder.differences(began, every_key(recipe))}" if began else ""
    raise AegisError(
        f"{path} belongs to another recipe{why}",
        "the recipe the run began with",
        "choose another --out",
    )


def optimizers(
    matrices: Sequence[nn.Parameter],
    parameters: Sequence[nn.Parameter],
    recipe: PretrainRecipe | DualRecipe,
) -> list[torch.optim.Optimizer]:
    """Muon for the matrices of the layers, AdamW for the rest.

    They reach the same accuracy in fewer steps than AdamW alone.
    """
    inside = {id(p) for p in matrices}
    rest = [p for p in parameters if id(p) not in inside]
    decay = recipe.weight_decay
    # `match_rms_adamw` scales Muon's updates to the size of AdamW's, so one rate suits both.
    return [
        torch.optim.Muon(
            matrices, lr=recipe.lr, weight_decay=decay, adjust_lr_fn="match_rms_adamw"
        ),
        torch.optim.AdamW(
            rest, lr=recipe.lr / 2, weight_decay=decay, betas=(0.9, 0.98), fused=True
        ),
    ]


def train(
    run: Pretraining,
    path: Path,
    loss: Callable[[int], Tensor],
    on_event: OnEvent,
    validate: Callable[[], dict[str, float]] = dict,
) -> None:
    """Take all remaining steps, after those of the state in `path` if there is one.

    Args:
        loss: returns the loss of a step, given its number, with its graph.
        validate: returns the metrics to show beside the loss at every checkpoint.

    Raises:
        AegisError: the state is damaged or not of this model, or a loss is not finite.
        KeyboardInterrupt: a signal has come, and the steps up to it are saved.
    """
    recipe = run.recipe
    peak = [[group["lr"] for group in o.param_groups] for o in run.optimizers]
    done = _restore(run, path) if path.exists() else 0
    run.model.train()
    with interrupts.saved_first("pretrain", on_event) as signaled:
        if done < recipe.steps:
            on_event(Progress("pretrain", done, recipe.steps, "steps"))
        for step in range(done, recipe.steps):
            factor = warmup_then_decay(step, recipe.steps, recipe.warmup, FINAL_LR_SHARE)
            for optimizer, rates in zip(run.optimizers, peak, strict=True):
                for group, rate in zip(optimizer.param_groups, rates, strict=True):
                    group["lr"] = rate * factor
            metrics = {"loss": _step(run, loss(step), step)}
            at_checkpoint = (step + 1) % recipe.checkpoint_every == 0
            if at_checkpoint:
                metrics |= validate()
            on_event(Progress("pretrain", step + 1, recipe.steps, "steps", metrics))
            if at_checkpoint or step + 1 == recipe.steps or signaled.number is not None:
                _save(run, path, step + 1)
            if signaled.number is not None:
                signaled.leave()


def _restore(run: Pretraining, path: Path) -> int:
    """Restore the state in `path`; returns the number of steps that it has completed."""
    saved = artifacts.load(path, "training-state")
    with reading_meta(path):
        done = int(saved.header.meta["step"])
        bare = optimizer_state.said_stateless(saved.header.meta)
    source = f"'{path}'"
    optimizer_state.from_tensors(saved.tensors, run.parameters, run.optimizers, source, bare)
    return done


def _save(run: Pretraining, path: Path, steps: int) -> None:
    meta = {
        "step": steps,
        "recipe": every_key(run.recipe),
        optimizer_state.STATELESS: optimizer_state.stateless(run.parameters, run.optimizers),
    }
    artifacts.save(
        path,
        "training-state",
        optimizer_state.to_tensors(run.parameters, run.optimizers),
        seed=run.recipe.seed,
        inputs={"recipe": digest(run.recipe)},
        meta=meta,
    )


def save(model: EmbeddedModel, out: Path, provenance: Mapping[str, object]) -> Path:
    """Write the finished model in bfloat16, to which its weights have been rounded."""
    target = out / "model.safetensors"
    embedded_file.save(model, target, torch.bfloat16, provenance)
    return target


def _step(run: Pretraining, loss: Tensor, step: int) -> float:
    _check_finite("loss", loss, step)
    for optimizer in run.optimizers:
        optimizer.zero_grad()
    loss.backward()
    # Without the cell head, which is dropped in the end: the shipped models were trained this way.
    norm = nn.utils.clip_grad_norm_(run.model.parameters(), CLIP_NORM)
    _check_finite("gradient norm", norm, step)  # otherwise clipping would make all weights NaN
    for optimizer in run.optimizers:
        optimizer.step()
    return loss.item()


def _check_finite(name: str, value: Tensor, step: int) -> None:
    """Raise AegisError for a value of a step that is not finite."""
    if not torch.isfinite(value):
        raise AegisError(
            f"{name} {value.item()} at step {step}",
            f"a finite {name}",
            "lower the learning rate: --set lr=1e-3",
        )
