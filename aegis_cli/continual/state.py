"""A stream's run in memory, and its state on disk from which it goes on to the same bytes."""

from __future__ import annotations

import dataclasses
import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from aegis_cli import recipes
from aegis_cli.common import artifacts, files
from aegis_cli.common.errors import AegisError
from aegis_cli.continual.learners.base import Learner
from aegis_cli.continual.stream_classes import Classes
from aegis_cli.core import routing
from aegis_cli.core.gaussians import Gaussian
from aegis_cli.core.routing import Routed
from aegis_cli.data.streams.contract import StreamTask
from aegis_cli.models.backbones.dual import DualEncoder
from aegis_cli.recipes import RobotStreamRecipe, StreamRecipe
from aegis_cli.training import optimizer_state

STATE = "state.safetensors"
_GAUSSIAN = tuple(f.name for f in dataclasses.fields(Gaussian))


@dataclass
class Place:
    """Where a run stands: everything about it that is no tensor, as plain JSON.

    Attributes:
        task, step: of the next step; step 0 means that the task has not begun.
        phase: 1 while routers are being identified, else 2.
        phase1_steps: of this task, once phase 1 is over.
        trained_phase1: of each map, the parameters beside it that learn in phase 1, and
        learning_phase1: all that do; None without one.
        quiet: checks on end at which the routers stood still; masses: each map's mean weights at
            the last check.
        pruned, dropped: of each map, the experts that left after phase 1.
        records, oracle, inferred: of the tasks learned so far.
        vqa: of robot tasks, accuracy and cross-entropy on questions before the first and after
            each.
    """

    task: int = 0
    step: int = 0
    phase: int = 2
    phase1_steps: int | None = None
    trained_phase1: dict[str, int] | None = None
    learning_phase1: int | None = None
    quiet: int = 0
    masses: dict[str, list[float]] = field(default_factory=dict)
    pruned: dict[str, list[int]] = field(default_factory=dict)
    dropped: dict[str, list[int]] = field(default_factory=dict)
    records: list[dict[str, Any]] = field(default_factory=list)
    oracle: list[list[float]] = field(default_factory=list)
    inferred: list[list[float]] = field(default_factory=list)
    vqa: list[list[float]] = field(default_factory=list)

    def next_task(self) -> Place:
        """The beginning of the next task."""
        return Place(
            task=self.task + 1,
            records=self.records,
            oracle=self.oracle,
            inferred=self.inferred,
            vqa=self.vqa,
        )


class Material(Protocol):
    """What one task is learned from.

    Attributes:
        name: the task's.
        size: examples to train on.
    """

    name: str
    size: int

    def fetch(self, rows: Tensor) -> Any:
        """Examples [B] by number."""

    def loss(self, batch: Any, step: int) -> Tensor:
        """The task's own loss of a batch of `fetch`, with its graph; what is drawn follows from
        `step`.
        """

    def gauge(self) -> Tensor:
        """The loss of always the same inputs, on which routers are measured: where that
        reads them.
        """

    def changed(self) -> None:
        """Other parameters learn from now on."""


@dataclass(kw_only=True)
class Base(ABC):
    """What the loop over a task's steps needs, whatever the tasks are; built once.

    Attributes:
        model: all that a learner may train, maps with experts included.
        names: of the tasks, in order.
    """

    recipe: StreamRecipe | RobotStreamRecipe
    learner: Learner
    sites: Routed
    fingerprint: str
    out: Path
    place: Place = field(default_factory=Place)
    gaussians: list[Gaussian] = field(default_factory=list)

    @property
    @abstractmethod
    def model(self) -> nn.Module: ...

    @property
    @abstractmethod
    def names(self) -> Sequence[str]: ...

    @abstractmethod
    def material(self, task: int) -> Material: ...

    @property
    def options(self) -> dict[str, Any]:
        return recipes.options(self.recipe)

    @property
    def device(self) -> torch.device:
        return next(self.model.parameters()).device

    def growing(self, task: int) -> Routed:
        """The maps that get experts with that task."""
        return self.sites

    def begun(self) -> None:  # noqa: B027 (most have nothing more to do)
        """After the learner has begun a task."""

    def parameters(self) -> dict[str, nn.Parameter]:
        """What the learner has changed or added, by name."""
        if self.learner.trains == "model":
            return dict(self.model.named_parameters())
        return routing.named_parameters(self.sites)

    def learning(self) -> dict[str, nn.Parameter]:
        return {name: p for name, p in self.parameters().items() if p.requires_grad}

    def rate_key(self, name: str) -> str:
        """The recipe's key that holds the peak learning rate of a parameter."""
        own = self.recipe.train.method.replace("-", "_")
        if self.learner.trains == "model":
            return f"{own}.lr"
        if ".routers." in name:
            return f"{own if 'router_lr' in self.options else 'train'}.router_lr"
        return "train.lr"

    def rate(self, name: str) -> float:
        """Peak learning rate of a parameter."""
        section, key = self.rate_key(name).split(".")
        return getattr(getattr(self.recipe, section), key)

    def slower(self, names: Iterable[str]) -> str:
        """What to do where these parameters have diverged."""
        return f"try a lower {' or '.join(sorted({self.rate_key(name) for name in names}))}"

    def stored(self) -> int:
        """Numbers kept beside the bare model."""
        if self.learner.trains == "model":
            return sum(p.numel() for p in self.model.parameters())
        return sum(site.count() for site in self.sites.values()) + sum(
            g.count() for g in self.gaussians
        )

    @property
    def inputs(self) -> dict[str, str]:
        part = files.canonical(recipes.training_part(self.recipe))
        return {"recipe": hashlib.sha256(part.encode()).hexdigest()}


@dataclass(kw_only=True)
class Run(Base):
    """A stream of classification tasks and the dual encoder that learns it.

    Attributes:
        image_set: digest that tells the tasks' images from others.
    """

    encoder: DualEncoder
    tasks: tuple[StreamTask, ...]
    image_set: str

    @property
    def model(self) -> DualEncoder:
        return self.encoder

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(task.name for task in self.tasks)

    def material(self, task: int) -> Classes:
        return Classes(self.tasks[task], self.encoder, self.recipe.train.label_smoothing)

    @property
    def inputs(self) -> dict[str, str]:
        return {**super().inputs, "encoder": self.fingerprint, "image set": self.image_set}


def optimizer(run: Base, before: torch.optim.Optimizer | None = None) -> torch.optim.Optimizer:
    """AdamW over what learns, at the rates of the run; no weight decay on routers and scales.

    Args:
        before: what goes on learning has its moments from there. Without them Adam's first steps
            are as long as its rate whatever the gradient is, in the middle of a schedule and with
            no warm-up.
    """
    groups: dict[tuple[bool, float], list[nn.Parameter]] = {}
    for name, parameter in run.learning().items():
        routes = run.learner.trains == "experts" and ".routers." in name
        groups.setdefault((routes, run.rate(name)), []).append(parameter)
    decay = run.recipe.train.weight_decay
    made = torch.optim.AdamW(
        [
            {
                "params": parameters,
                "lr": rate,
                "peak": rate,
                "weight_decay": 0.0 if routes else decay,
            }
            for (routes, rate), parameters in sorted(groups.items(), key=lambda item: item[0])
        ],
        fused=True,
    )
    for parameter in run.learning().values():
        if before is not None and parameter in before.state:
            made.state[parameter] = before.state[parameter]
    return made


def save(run: Base, optimizers: list[torch.optim.Optimizer]) -> None:
    """Write the run's state: experts, routers, scales, optimizer, phase and structure. Nothing
    random is in it.
    """
    tensors = optimizer_state.to_tensors(run.parameters(), optimizers) | gaussian_tensors(
        run.gaussians
    )
    meta = {
        "place": dataclasses.asdict(run.place),
        "learning": sorted(run.learning()),
        "structure": {name: site.structure() for name, site in run.sites.items()},
    }
    artifacts.save(
        run.out / STATE,
        "training-state",
        tensors,
        seed=run.recipe.seed,
        inputs=run.inputs,
        fingerprint=run.fingerprint,
        meta=meta,
    )


def restore(run: Base) -> torch.optim.Optimizer | None:
    """Put the saved state back; the optimizer is that of the task being learned, if one is.

    Raises:
        AegisError: the state is damaged, or of another recipe or encoder.
    """
    saved = artifacts.load(run.out / STATE, "training-state")
    if saved.header.inputs != run.inputs:
        changed = sorted(k for k in run.inputs if saved.header.inputs.get(k) != run.inputs[k])
        raise AegisError(
            f"another {', '.join(changed)} than the run in '{run.out}' began with",
            "the same inputs",
            "give what the run began with, or start anew in another --out",
        )
    meta = saved.header.meta
    run.place = Place(**meta["place"])
    run.gaussians = gaussians_from(saved.tensors)
    rebuild(run.sites, meta["structure"])
    run.model.requires_grad_(False)
    parameters = run.parameters()
    for name in meta["learning"]:
        parameters[name].requires_grad_(True)
    if run.place.step == 0:
        optimizer_state.from_tensors(saved.tensors, parameters, [])
        return None
    made = optimizer(run)
    optimizer_state.from_tensors(saved.tensors, parameters, [made])
    return made


def rebuild(sites: Routed, structure: Mapping[str, Any]) -> None:
    """Give every map the experts and routers that `structure` lists."""
    for name, site in sites.items():
        site.rebuild(structure[name])


def gaussian_tensors(gaussians: list[Gaussian]) -> dict[str, Tensor]:
    """Means [T, D], directions [T, D, r], variances [T, r], noises and thresholds [T]; nothing for
    no tasks.
    """
    names = _GAUSSIAN if gaussians else ()
    return {f"tasks.{name}": torch.stack([getattr(g, name) for g in gaussians]) for name in names}


def gaussians_from(tensors: Mapping[str, Tensor]) -> list[Gaussian]:
    if "tasks.mean" not in tensors:
        return []
    parts = [tensors[f"tasks.{name}"] for name in _GAUSSIAN]
    return [Gaussian(*(t.clone() for t in one)) for one in zip(*parts, strict=True)]
