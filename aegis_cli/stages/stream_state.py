"""A stream's run in memory, and its state on disk from which it goes on to the same bytes."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from aegis_cli import artifacts, files
from aegis_cli import recipe as recipes
from aegis_cli.backbones.dual import DualEncoder
from aegis_cli.continual.base import Learner
from aegis_cli.core import routing
from aegis_cli.core.gaussians import Gaussian
from aegis_cli.core.routing import Routed
from aegis_cli.errors import AegisError
from aegis_cli.recipe import StreamRecipe
from aegis_cli.stages import state
from aegis_cli.streams.contract import StreamTask

STATE = "state.safetensors"


@dataclass
class Place:
    """Where a run stands: everything about it that is no tensor, as plain JSON.

    Attributes:
        task, step: of the next step; step 0 means that the task has not begun.
        phase: 1 while routers are being identified, else 2.
        phase1_steps: of this task, once phase 1 is over.
        trained_phase1: of each map, the parameters that learn in phase 1; None without one.
        quiet: checks on end at which the routers stood still; masses: each map's mean weights at the last check.
        pruned, dropped: of each map, the experts that left after phase 1.
        records, oracle, inferred: of the tasks learned so far.
    """

    task: int = 0
    step: int = 0
    phase: int = 2
    phase1_steps: int | None = None
    trained_phase1: dict[str, int] | None = None
    quiet: int = 0
    masses: dict[str, list[float]] = field(default_factory=dict)
    pruned: dict[str, list[int]] = field(default_factory=dict)
    dropped: dict[str, list[int]] = field(default_factory=dict)
    records: list[dict[str, Any]] = field(default_factory=list)
    oracle: list[list[float]] = field(default_factory=list)
    inferred: list[list[float]] = field(default_factory=list)

    def next_task(self) -> Place:
        """The beginning of the next task."""
        return Place(task=self.task + 1, records=self.records, oracle=self.oracle, inferred=self.inferred)


@dataclass
class Run:
    """Everything the loop needs, built once."""

    recipe: StreamRecipe
    learner: Learner
    encoder: DualEncoder
    sites: Routed
    tasks: tuple[StreamTask, ...]
    fingerprint: str
    out: Path
    place: Place = field(default_factory=Place)
    gaussians: list[Gaussian] = field(default_factory=list)

    @property
    def options(self) -> dict[str, Any]:
        return recipes.options(self.recipe)

    def parameters(self) -> dict[str, nn.Parameter]:
        """What the learner has changed or added, by name."""
        if self.learner.trains == "model":
            return dict(self.encoder.named_parameters())
        return routing.named_parameters(self.sites)

    def learning(self) -> dict[str, nn.Parameter]:
        return {name: p for name, p in self.parameters().items() if p.requires_grad}

    def stored(self) -> int:
        """Numbers kept beside the bare encoder."""
        if self.learner.trains == "model":
            return sum(p.numel() for p in self.encoder.parameters())
        return sum(site.count() for site in self.sites.values()) + sum(g.count() for g in self.gaussians)

    @property
    def inputs(self) -> dict[str, str]:
        part = files.canonical(recipes.training_part(self.recipe))
        return {"recipe": hashlib.sha256(part.encode()).hexdigest(), "encoder": self.fingerprint}


def optimizer(run: Run) -> torch.optim.Optimizer:
    """AdamW over what learns: routers and scales at a rate of their own and without weight decay."""
    settings, learning = run.recipe.train, run.learning()
    routers = [p for name, p in learning.items() if _of_router(run, name)]
    weights = [p for name, p in learning.items() if not _of_router(run, name)]
    rate = run.options["lr"] if run.learner.trains == "model" else settings.lr
    groups = [
        {"params": weights, "lr": rate, "peak": rate, "weight_decay": settings.weight_decay},
        {"params": routers, "lr": settings.router_lr, "peak": settings.router_lr, "weight_decay": 0.0},
    ]
    return torch.optim.AdamW([g for g in groups if g["params"]], fused=True)


def _of_router(run: Run, name: str) -> bool:
    return run.learner.trains == "experts" and ".routers." in name


def save(run: Run, optimizers: list[torch.optim.Optimizer]) -> None:
    """Write the run's state: experts, routers, scales, optimizer, phase and structure. Nothing random is in it."""
    tensors = state.to_tensors(run.parameters(), optimizers) | gaussian_tensors(run.gaussians)
    meta = {
        "place": dataclasses.asdict(run.place), "learning": sorted(run.learning()),
        "structure": {name: site.structure() for name, site in run.sites.items()},
    }  # fmt: skip
    artifacts.save(
        run.out / STATE, "training-state", tensors, seed=run.recipe.seed, inputs=run.inputs,
        fingerprint=run.fingerprint, meta=meta,
    )


def restore(run: Run) -> torch.optim.Optimizer | None:
    """Put the saved state back; the optimizer is that of the task being learned, if one is.

    Raises:
        AegisError: the state is damaged, or of another recipe or encoder.
    """
    saved = artifacts.load(run.out / STATE, "training-state")
    if saved.header.inputs != run.inputs:
        changed = sorted(k for k in run.inputs if saved.header.inputs.get(k) != run.inputs[k])
        raise AegisError(
            f"another {', '.join(changed)} than the run in '{run.out}' began with", "the same inputs",
            "give what the run began with, or start anew in another --out",
        )
    meta = saved.header.meta
    run.place = Place(**meta["place"])
    run.gaussians = gaussians_from(saved.tensors)
    rebuild(run.sites, meta["structure"])
    run.encoder.requires_grad_(False)
    parameters = run.parameters()
    for name in meta["learning"]:
        parameters[name].requires_grad_(True)
    if run.place.step == 0:
        state.from_tensors(saved.tensors, parameters, [])
        return None
    made = optimizer(run)
    state.from_tensors(saved.tensors, parameters, [made])
    return made


def rebuild(sites: Routed, structure: Mapping[str, Any]) -> None:
    """Give every map the experts and routers that `structure` lists."""
    for name, site in sites.items():
        site.rebuild(structure[name])


def gaussian_tensors(gaussians: list[Gaussian]) -> dict[str, Tensor]:
    """Means and variances [T, D] and thresholds [T]; nothing for no tasks."""
    names = ("mean", "variance", "threshold") if gaussians else ()
    return {f"tasks.{name}": torch.stack([getattr(g, name) for g in gaussians]) for name in names}


def gaussians_from(tensors: Mapping[str, Tensor]) -> list[Gaussian]:
    if "tasks.mean" not in tensors:
        return []
    parts = [tensors[f"tasks.{name}"] for name in ("mean", "variance", "threshold")]
    return [Gaussian(*(t.clone() for t in one)) for one in zip(*parts, strict=True)]
