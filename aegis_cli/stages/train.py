"""`aegis train`: fine-tune a backbone and an action expert on demonstrations with one method."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from aegis_cli import artifacts, backbones, methods
from aegis_cli import recipe as recipes
from aegis_cli.core.ledger import Ledger, conflict_share, energy_shed_mean
from aegis_cli.core.moments import Moments
from aegis_cli.errors import AegisError
from aegis_cli.events import OnEvent, Progress, ignore
from aegis_cli.expert import ActionExpert, ExpertShape
from aegis_cli.methods.base import Method
from aegis_cli.policy import Policy
from aegis_cli.recipe import Recipe
from aegis_cli.stages import anchor as anchors
from aegis_cli.stages import checkpoint, data, folder, step
from aegis_cli.stages import device as devices
from aegis_cli.stages.schedule import BatchOrder, warmup_cosine

VALIDATION_FRAMES = 512
_NOISE, _VALIDATION = 1, 2  # streams of a step's generator


@dataclass(frozen=True)
class TrainReport:
    """How the run ended; `energy_shed_mean` is None for a method that reads no anchor gradient."""

    method: str
    steps: int
    loss: float
    validation_loss: float
    energy_shed_mean: float | None
    step_s: float
    out: str

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


@dataclass
class _Run:
    """Everything the loop needs, built once."""

    recipe: Recipe
    method: Method
    out: Path
    inputs: dict[str, str]
    demos: data.Demonstrations
    anchor: list[Moments] | None
    policy: Policy
    optimizer: torch.optim.Optimizer
    ledger: Ledger

    @property
    def meta(self) -> dict[str, Any]:
        return {"method": self.method.name, "task": self.demos.task, "replan": self.recipe.rollout.replan}

    def save_checkpoint(self, steps: int) -> None:
        tensors = self.ledger.tensors()
        meta = {**self.meta, "groups": list(self.ledger.groups), "layers": list(self.ledger.layers)}
        with checkpoint.writing(self.out):
            artifacts.save(
                self.out / "ledger.safetensors", "ledger", tensors, seed=self.recipe.seed, inputs=self.inputs,
                units={"w2": "activation^2", "step": "steps"}, meta=meta,
            )
        checkpoint.save(self.out, steps, self.policy, self.method, self.optimizer, self.meta, self.inputs, self.recipe.seed)


def run(
    recipe: Recipe, method: str, demos: Path, anchor: Path | None, out: Path, resume: bool = False, on_event: OnEvent = ignore
) -> TrainReport:
    """Train `recipe.train.steps` steps into the run folder `out`.

    No question is ever read: the anchor's moments are all that training knows of VQA.

    Raises:
        AegisError: inputs that do not fit together, an existing run without `resume`, a loss or gradient
            that is not finite (after a checkpoint of the last good step), or a disk that cannot be written.
    """
    recipe = dataclasses.replace(recipe, train=dataclasses.replace(recipe.train, method=method))
    chosen = methods.get(method)
    if chosen.combine is not None and anchor is None:
        raise AegisError(f"no anchor for method '{method}'", "an anchor of the backbone", "add --anchor anchor.safetensors")
    out = Path(out)
    folder.check(out, recipe, resume)
    job = _build(recipe, chosen, Path(demos), anchor, out)
    if (out / "checkpoints" / checkpoint.LAST).exists():
        return _train(job, _restore(job), on_event)
    folder.begin(out, recipe)
    return _train(job, 0, on_event)


# --- before the first step ------------------------------------------------------------------------


def _build(recipe: Recipe, method: Method, demos: Path, anchor: Path | None, out: Path) -> _Run:
    demonstrations = data.load(demos, recipe.train.validation_share, recipe.seed)
    if demonstrations.task != recipe.task:
        raise AegisError(
            f"demonstrations of '{demonstrations.task}' for a recipe of '{recipe.task}'", "one and the same task",
            f"--set task={demonstrations.task}, or record with: aegis demos {recipe.task}",
        )
    backbone = backbones.load(recipe.backbone).to(devices.pick())
    fingerprint = backbone.fingerprint()
    moments = None if anchor is None else _to_device(anchors.load(anchor, fingerprint), backbone.device)
    torch.manual_seed(recipe.seed)  # the expert begins alike under every method
    policy = _policy(recipe, backbone, demonstrations)
    method.adapt(backbone, backbone.language_maps(), dataclasses.asdict(recipe.lora))
    if recipe.train.compile:
        from torch._functorch import config  # not loaded by `import torch`; here, because it takes a second

        config.donated_buffer = False  # the dual backward walks the compiled graph twice
        backbone.encode = torch.compile(backbone.encode)  # type: ignore[method-assign]
    inputs = {"demos": artifacts.sha256_file(demos), "backbone": fingerprint}
    if anchor is not None:
        inputs["anchor"] = artifacts.sha256_file(anchor)
    groups = list(backbone.parameter_groups()) if method.combine else []
    layers = [f"layers.{i}" for i in range(backbone.depth)] if method.combine else []
    return _Run(
        recipe, method, out, inputs, demonstrations, moments, policy, _optimizer(policy, recipe), Ledger(groups, layers)
    )


def _to_device(anchor: Sequence[Moments], device: torch.device) -> list[Moments]:
    """Float32 copies where the training step runs."""
    return [Moments(m.count, m.mean.float().to(device), m.var.float().to(device)) for m in anchor]


def _policy(recipe: Recipe, backbone: backbones.Backbone, demos: data.Demonstrations) -> Policy:
    proprio, action = demos.scales()
    shape = ExpertShape(
        depth=backbone.depth, heads=backbone.heads, head_dim=backbone.head_dim,
        proprio=len(proprio.mean), actions=len(action.mean), chunk=recipe.train.chunk,
        width=recipe.expert.width, mlp_ratio=recipe.expert.mlp_ratio,
    )
    return Policy(backbone, ActionExpert(shape), proprio, action).to(backbone.device)


def _optimizer(policy: Policy, recipe: Recipe) -> torch.optim.Optimizer:
    """AdamW with one group for the backbone (where it learns) and one for the expert."""
    learning = {
        "backbone": ([p for p in policy.backbone.parameters() if p.requires_grad], recipe.train.backbone_lr),
        "expert": (list(policy.expert.parameters()), recipe.train.expert_lr),
    }
    groups = [{"params": ps, "lr": lr, "peak": lr, "name": name} for name, (ps, lr) in learning.items() if ps]
    return torch.optim.AdamW(groups, weight_decay=recipe.train.weight_decay, fused=True)


def _restore(run: _Run) -> int:
    """State, ledger and metrics as they were after the last checkpoint."""
    saved = artifacts.read_header(checkpoint.last(run.out) / checkpoint.STATE)
    if saved.inputs != run.inputs:
        changed = sorted(k for k in saved.inputs.keys() | run.inputs.keys() if saved.inputs.get(k) != run.inputs.get(k))
        raise AegisError(
            f"another {', '.join(changed)} than the run in '{run.out}' began with", "the same inputs",
            "give the files the run began with, or start anew in another --out",
        )
    done = checkpoint.restore(run.out, run.policy, run.optimizer)
    kept = artifacts.load(run.out / "ledger.safetensors", "ledger")
    run.ledger = Ledger.from_tensors(run.ledger.groups, run.ledger.layers, kept.tensors)
    run.ledger.truncate(done)
    folder.truncate_metrics(run.out, done)
    return done


# --- the loop -------------------------------------------------------------------------------------


@dataclass
class _Window:
    """Sums since the last line of metrics."""

    loss: float = 0.0
    data_s: float = 0.0
    update_s: float = 0.0
    steps: int = 0

    def means(self, batch_size: int) -> dict[str, float]:
        step_s = (self.data_s + self.update_s) / self.steps
        return {
            "loss": self.loss / self.steps, "data_s": self.data_s / self.steps, "update_s": self.update_s / self.steps,
            "step_s": step_s, "samples_per_s": batch_size / step_s,
        }


def _train(run: _Run, done: int, on_event: OnEvent) -> TrainReport:
    settings = run.recipe.train
    order = BatchOrder(len(run.demos.train), settings.batch_size, run.recipe.seed)
    window, shown = _Window(), {}
    run.policy.train()
    for index in range(done, settings.steps):
        started = time.perf_counter()
        batch = run.demos.batch(run.demos.train[order.rows(index)], settings.chunk)
        fetched = time.perf_counter()
        window.loss += _update(run, index, batch)
        window.data_s += fetched - started
        window.update_s += time.perf_counter() - fetched
        window.steps += 1
        finished, last = index + 1, index + 1 == settings.steps
        save = finished % settings.checkpoint_every == 0 or last
        validate = finished % settings.validate_every == 0 or last
        if save or validate or finished % settings.log_every == 0:
            shown = _log(run, finished, window, validate)
            window = _Window()
        if save:
            run.save_checkpoint(finished)
        on_event(Progress("train", finished, settings.steps, "steps", {k: shown[k] for k in ("loss",) if k in shown}))
    return _report(run)


def _generator(run: _Run, index: int, stream: int) -> torch.Generator:
    """Noise as a function of (seed, step): a resumed run draws what the uninterrupted one drew."""
    return torch.Generator().manual_seed((run.recipe.seed * 1_000_003 + index) * 4 + stream)


def _update(run: _Run, index: int, batch: data.RobotBatch) -> float:
    """One step; returns its loss. The parameters are untouched if anything is not finite."""
    settings = run.recipe.train
    factor = warmup_cosine(index, settings.steps, settings.warmup, settings.final_lr_share)
    for group in run.optimizer.param_groups:
        group["lr"] = group["peak"] * factor
    run.optimizer.zero_grad()
    result = step.compute_gradients(
        run.policy, run.method, batch, _generator(run, index, _NOISE), flow_samples=settings.flow_samples,
        precision=settings.precision, anchor=run.anchor, weighting=run.recipe.aegis.weighting,
    )
    learning = [p for group in run.optimizer.param_groups for p in group["params"]]
    norm = nn.utils.clip_grad_norm_(learning, settings.clip_norm)
    figures = _figures(result, norm)
    if not all(math.isfinite(value) for value in figures.values()):
        run.save_checkpoint(index)
        raise AegisError(
            ", ".join(f"{name} {value:g}" for name, value in figures.items()) + f" at step {index + 1}", "finite numbers",
            f"the {index} good steps are in {run.out}/checkpoints/last; try a lower train.backbone_lr or train.expert_lr",
        )
    run.optimizer.step()
    if result.row is not None:
        run.ledger.append(index + 1, result.row.tt, result.row.ta, result.row.aa, result.row.w2)
    return figures["loss"]


def _figures(result: step.Gradients, norm: torch.Tensor) -> dict[str, float]:
    """What has to be finite before a step is taken, the ledger's row included: W2 can overflow before the loss does."""
    largest = {} if result.row is None else {f"largest {name}": x.abs().max() for name, x in vars(result.row).items()}
    return {name: x.item() for name, x in {"loss": result.loss, "gradient norm": norm, **largest}.items()}


def _log(run: _Run, finished: int, window: _Window, validate: bool) -> dict[str, float]:
    """Append one line to metrics.jsonl and return it."""
    line: dict[str, float] = {"step": finished, **window.means(run.recipe.train.batch_size)}
    line |= {f"lr_{group['name']}": group["lr"] for group in run.optimizer.param_groups}
    if run.method.combine is not None:
        recent = {name: t[-window.steps :] for name, t in run.ledger.tensors().items()}
        line |= {"energy_shed": energy_shed_mean(recent), "conflict": conflict_share(recent)}
    if validate:
        line["validation_loss"] = _validation_loss(run)
    folder.append_metrics(run.out, line)
    return line


@torch.no_grad()
def _validation_loss(run: _Run) -> float:
    """Flow-matching loss on frames of held-out episodes, spread evenly, with the same noise every time."""
    settings = run.recipe.train
    frames = run.demos.validation
    frames = frames[torch.linspace(0, len(frames) - 1, min(VALIDATION_FRAMES, len(frames))).long()]
    generator = _generator(run, 0, _VALIDATION)
    total = 0.0
    for part in frames.split(settings.batch_size):
        batch = run.demos.batch(part, settings.chunk)
        with devices.autocast(run.policy.backbone.device, settings.precision):
            encoding = run.policy.encode(batch.images, batch.instructions)
            total += len(part) * run.policy.flow_loss(batch, encoding, settings.flow_samples, generator).item()
    return total / len(frames)


def _report(run: _Run) -> TrainReport:
    lines = folder.read_metrics(run.out)
    times = sorted(line["step_s"] for line in lines)
    return TrainReport(
        method=run.method.name, steps=run.recipe.train.steps, loss=lines[-1]["loss"],
        validation_loss=lines[-1]["validation_loss"],
        energy_shed_mean=energy_shed_mean(run.ledger.tensors()) if run.method.combine else None,
        step_s=times[len(times) // 2], out=str(run.out),
    )
