"""A stream of robot tasks in memory: policies that share a backbone and an action expert, with
experts beside their maps.

The backbone's maps get experts with every task. The action expert learns whole with the first task
and is frozen then; from the second task on low-rank experts adapt it too. With the task told, what
served a learned task never changes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from aegis_cli.common import device as devices
from aegis_cli.continual.state import Base
from aegis_cli.core import routing
from aegis_cli.core.routing import Routed
from aegis_cli.data.batch import Normalizer, RobotBatch
from aegis_cli.data.demonstrations import Demonstrations
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.models.expert import ActionExpert, ExpertShape
from aegis_cli.models.policy import Policy
from aegis_cli.recipes import RobotStreamRecipe

GAUGE_FRAMES = (
    32  # training frames, evenly spaced, on which routers are measured, always with the same noise
)
ATTENTION_INPUTS = {
    "qkv",
    "qkv_proj",
    "q_proj",
    "k_proj",
    "v_proj",
}  # maps of a backbone that get no experts
NOISE, VALIDATION, GAUGE = 1, 2, 3  # streams of a step's generator

Scales = tuple[Normalizer, Normalizer]  # of positions and of actions


class Frames:
    """A task's demonstrations, learned by flow matching."""

    def __init__(
        self, number: int, recipe: RobotStreamRecipe, policy: Policy, demos: Demonstrations
    ) -> None:
        self.name, self.size = recipe.tasks[number], len(demos.train)
        self._first, self._settings, self._seed = (
            number * recipe.train.steps,
            recipe.train,
            recipe.seed,
        )
        self._policy, self._demos = policy, demos
        rows = torch.linspace(0, self.size - 1, min(GAUGE_FRAMES, self.size)).long()
        self._gauge = demos.batch(demos.train[rows], recipe.train.chunk)

    def fetch(self, rows: Tensor) -> RobotBatch:
        return self._demos.batch(self._demos.train[rows], self._settings.chunk)

    def loss(self, batch: RobotBatch, step: int) -> Tensor:
        return self._loss(batch, generator(self._seed, self._first + step, NOISE))

    def gauge(self) -> Tensor:
        return self._loss(self._gauge, generator(self._seed, self._first, GAUGE))

    def changed(self) -> None:
        """Nothing is kept from step to step."""

    def _loss(self, batch: RobotBatch, draws: torch.Generator) -> Tensor:
        encoding = self._policy.encode(batch.images, batch.instructions)
        return self._policy.flow_loss(batch, encoding, self._settings.flow_samples, draws)


def generator(seed: int, index: int, stream: int) -> torch.Generator:
    """Noise as a function of (seed, step of the whole stream): a resumed run draws what the
    uninterrupted one drew.
    """
    return torch.Generator().manual_seed((seed * 1_000_003 + index) * 4 + stream)


@dataclass(kw_only=True)
class RobotRun(Base):
    """A stream of robot tasks.

    Attributes:
        policies: one a task, which share backbone and action expert and have scales of their own.
        demos: one a task; none in a run that only acts.
        question_files: digests of the files that the questions come from; none of scenes.
    """

    recipe: RobotStreamRecipe
    policies: tuple[Policy, ...]
    demos: tuple[Demonstrations, ...] = ()
    question_files: Mapping[str, str] = field(default_factory=dict)

    @property
    def model(self) -> Policy:
        return self.policies[0]

    @property
    def names(self) -> tuple[str, ...]:
        return self.recipe.tasks

    def material(self, task: int) -> Frames:
        return Frames(task, self.recipe, self.policies[task], self.demos[task])

    def growing(self, task: int) -> Routed:
        """With the first task, the backbone's maps alone."""
        return {
            name: site
            for name, site in self.sites.items()
            if task or not name.startswith("expert.")
        }

    def begun(self) -> None:
        """With the first task the action expert learns whole."""
        if self.learner.trains == "experts" and self.place.task == 0:
            self.model.expert.requires_grad_(True)

    def parameters(self) -> dict[str, nn.Parameter]:
        if self.learner.trains == "model":
            return super().parameters()
        return super().parameters() | {
            f"expert.{name}": p for name, p in own_parameters(self.model.expert).items()
        }

    def rate_key(self, name: str) -> str:
        own = name.startswith("expert.") and not is_added(name)
        return "train.expert_lr" if own else super().rate_key(name)

    def stored(self) -> int:
        """Numbers kept beside the bare backbone; scales of the tasks so far."""
        scales = [
            s
            for p in self.policies[: self.place.task + 1]
            for s in (p.proprio_scale, p.action_scale)
        ]
        own = own_parameters(self.model.expert) if self.learner.trains == "experts" else {}
        return (
            super().stored()
            + sum(p.numel() for p in own.values())
            + sum(b.numel() for s in scales for b in s.buffers())
        )

    @property
    def inputs(self) -> dict[str, str]:
        digests = {
            f"demos of {task}": d.sha256 for task, d in zip(self.names, self.demos, strict=False)
        }
        return {**super().inputs, "backbone": self.fingerprint, **digests, **self.question_files}

    def activate(self, task: int | None) -> None:
        """Let every map compute for the task of that number; None: the bare backbone."""
        routing.activate(self.sites, None if task is None else self.learner.router(task))


def share(
    backbone: Backbone, shape: ExpertShape, scales: Sequence[Scales], seed: int
) -> tuple[Policy, ...]:
    """A policy a task, with one action expert that follows from the seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        expert = ActionExpert(shape)
    device = devices.pick()
    return tuple(
        Policy(backbone, expert, *both).to(device).eval().requires_grad_(False) for both in scales
    )


def route(policy: Policy) -> dict[str, routing.RoutedLinear]:
    """Let experts stand beside the maps of the backbone's language layers, but its attention's
    inputs, and of the expert.

    The last layer's are behind the last keys and values, which is all that the expert reads: no
    action depends on them.
    """
    last = {
        id(p) for p in policy.backbone.parameter_groups()[f"layers.{policy.backbone.depth - 1}"]
    }
    backbone = {
        f"backbone.{name}": linear
        for name, linear in policy.backbone.language_maps().items()
        if name.rpartition(".")[2] not in ATTENTION_INPUTS and id(linear.weight) not in last
    }
    expert = {
        f"expert.{n}": m for n, m in policy.expert.named_modules() if isinstance(m, nn.Linear)
    }
    return routing.route(policy, backbone | expert)


def is_added(name: str) -> bool:
    """Whether a parameter of that name stands beside a map."""
    return ".experts." in name or ".routers." in name


def own_parameters(expert: ActionExpert) -> dict[str, nn.Parameter]:
    """The action expert's without what stands beside its maps, named as if nothing did."""
    return {
        name.replace(".base.", "."): p
        for name, p in expert.named_parameters()
        if not is_added(name)
    }
