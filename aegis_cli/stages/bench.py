"""`aegis bench`: what each part costs, as ratios of times taken in turn on this machine."""

from __future__ import annotations

import copy
import dataclasses
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import torch

from aegis_cli import backbones, methods
from aegis_cli.backbones.base import Backbone
from aegis_cli.core.moments import Moments
from aegis_cli.events import OnEvent, Progress, ignore
from aegis_cli.expert import ActionExpert, ExpertShape
from aegis_cli.methods.base import Method
from aegis_cli.policy import Normalizer, Policy, RobotBatch
from aegis_cli.recipe import Lora, Train
from aegis_cli.stages import anchor as anchors
from aegis_cli.stages import device as devices
from aegis_cli.stages import step
from aegis_cli.vqa.questions import Question

_ACTIONS, _PROPRIO = 2, 6
_INSTRUCTION = "move the finger to the red target"


@dataclass(frozen=True)
class BenchReport:
    """Medians of `repeats` rounds; each round times every part once, so that a busy machine slows all alike.

    `anchor_throughput` is the anchor pass's share of a bare forward's throughput; `step_time` each method's
    training step over naive's; `step_s` their seconds.
    """

    anchor_throughput: float
    step_time: dict[str, float]
    step_s: dict[str, float]
    batch_size: int
    repeats: int

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def run(backbone: str, batch_size: int = 32, repeats: int = 9, on_event: OnEvent = ignore) -> BenchReport:
    """Time the anchor pass against a bare forward, and each method's training step against naive's."""
    model = backbones.load(backbone).to(devices.pick())
    batch = _batch(batch_size)
    anchor = _anchor(model, batch)
    parts: dict[str, Callable[[], object]] = {
        "forward": lambda: _forward(model, batch), "anchor": lambda: _anchor(model, batch),
    }
    parts |= {name: _stepper(copy.deepcopy(model), method, batch, anchor) for name, method in methods.METHODS.items()}
    times: dict[str, list[float]] = {name: [] for name in parts}
    for i in range(repeats + 1):
        for name, part in parts.items():
            start = time.perf_counter()
            part()
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            times[name].append(time.perf_counter() - start)
        on_event(Progress("bench", i + 1, repeats + 1, "rounds"))
    median = {name: statistics.median(taken[1:]) for name, taken in times.items()}  # the first round warms up
    return BenchReport(
        anchor_throughput=median["forward"] / median["anchor"],
        step_time={name: median[name] / median["naive"] for name in methods.METHODS},
        step_s={name: median[name] for name in methods.METHODS}, batch_size=batch_size, repeats=repeats,
    )


def _batch(size: int) -> RobotBatch:
    generator = torch.Generator().manual_seed(0)
    chunk = Train().chunk
    return RobotBatch(
        images=torch.randint(0, 256, (size, 64, 64, 3), dtype=torch.uint8, generator=generator),
        instructions=[_INSTRUCTION] * size, proprio=torch.randn(size, _PROPRIO, generator=generator),
        actions=torch.randn(size, chunk, _ACTIONS, generator=generator), is_pad=torch.zeros(size, chunk, dtype=torch.bool),
    )


@torch.inference_mode()
def _forward(model: Backbone, batch: RobotBatch) -> object:
    return model.encode(model.prepare(batch.images, batch.instructions))


def _anchor(model: Backbone, batch: RobotBatch) -> list[Moments]:
    """What `aegis anchor` does with a batch."""
    questions = [Question("", text, "") for text in batch.instructions]
    return anchors.measure(model, [(batch.images.numpy(), questions)], len(questions))


def _stepper(model: Backbone, method: Method, batch: RobotBatch, anchor: list[Moments]) -> Callable[[], None]:
    """One training step of a method, with the sizes of a recipe's defaults."""
    shape = ExpertShape(model.depth, model.heads, model.head_dim, _PROPRIO, _ACTIONS, Train().chunk)
    unit = [Normalizer(torch.zeros(n), torch.ones(n)) for n in (_PROPRIO, _ACTIONS)]
    policy = Policy(model, ActionExpert(shape), *unit).to(model.device)
    method.adapt(model, model.language_maps(), dataclasses.asdict(Lora()))
    optimizer = torch.optim.AdamW([p for p in policy.parameters() if p.requires_grad], lr=1e-5, fused=True)
    target = [Moments(m.count, m.mean.float().clone(), m.var.float().clone()) for m in anchor]
    generator = torch.Generator().manual_seed(0)

    def once() -> None:
        optimizer.zero_grad()
        step.compute_gradients(
            policy, method, batch, generator, flow_samples=Train().flow_samples, precision=Train().precision, anchor=target
        )
        optimizer.step()

    return once
