"""A policy, a robot batch and an anchor made without a simulator."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from aegis_cli import recipes
from aegis_cli.anchors import curvature, fisher, inputs
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.moments import Moments, empty
from aegis_cli.data.batch import Normalizer, RobotBatch
from aegis_cli.data.vqa.dataset import VQASet
from aegis_cli.data.vqa.questions import Question
from aegis_cli.methods.base import Method, MethodContext, Parts, Pass
from aegis_cli.models.backbones.base import Backbone, Batch
from aegis_cli.models.expert import ActionExpert, ExpertShape
from aegis_cli.models.policy import Policy
from aegis_cli.recipes import Lora, Recipe, Train
from aegis_cli.training import step
from samples.tiny import make_tiny

CHUNK = 4
INSTRUCTIONS = (
    "move the finger to the red target",
    "touch the blue ball",
    "go to the green pad on the left",
)
LORA = {"rank": 3, "alpha": 6.0}
ASKED = (
    ("what color is the cube", "red"),
    ("how many objects are there", "two"),
    ("is there a red cube", "yes"),
)


def images(count: int, seed: int = 0) -> Tensor:
    """[count, 64, 64, 3] uint8 noise."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(256, (count, 64, 64, 3), generator=generator, dtype=torch.uint8)


def robot_batch(size: int = 5, seed: int = 0) -> RobotBatch:
    """Frames; every third chunk extends past its episode's end."""
    generator = torch.Generator().manual_seed(seed)
    is_pad = torch.zeros(size, CHUNK, dtype=torch.bool)
    is_pad[::3, -2:] = True
    return RobotBatch(
        images(size, seed),
        [INSTRUCTIONS[i % 3] for i in range(size)],
        torch.randn(size, 3, generator=generator),
        torch.randn(size, CHUNK, 2, generator=generator),
        is_pad,
    )


def narrow_expert(backbone: Backbone) -> ActionExpert:
    """An action expert over a backbone, with three proprioceptive inputs and two actions."""
    shape = ExpertShape(
        depth=backbone.depth,
        heads=backbone.heads,
        head_dim=backbone.head_dim,
        proprio=3,
        actions=2,
        chunk=CHUNK,
        width=16,
        kv_heads=backbone.kv_heads,
    )
    return ActionExpert(shape)


def make_policy(seed: int = 0) -> Policy:
    """The tiny backbone with a narrower expert."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        backbone = make_tiny(seed)
        expert = narrow_expert(backbone)
        proprio = Normalizer(torch.tensor([0.1, -0.2, 0.3]), torch.tensor([1.5, 0.5, 1.0]))
        action = Normalizer(torch.tensor([0.2, 0.1]), torch.tensor([0.7, 1.3]))
        return Policy(backbone, expert, proprio, action)


def policy_over(backbone: Backbone) -> Policy:
    """A Hugging Face backbone under a narrow expert, with identity scales."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        expert = narrow_expert(backbone)
        scales = [Normalizer(torch.zeros(n), torch.ones(n)) for n in (3, 2)]
        return Policy(backbone, expert, *scales)


def double_policy(seed: int = 0) -> Policy:
    """The same in float64, pixels included."""
    policy = make_policy(seed).double()
    backbone = policy.backbone
    backbone.pixels = lambda frames: type(backbone).pixels(backbone, frames).double()  # type: ignore[method-assign]
    return policy


def double_batch(size: int = 4) -> Batch:
    """Inputs for a float64 backbone; the texts differ in length."""
    prepared = make_tiny().prepare(images(size), [INSTRUCTIONS[i % 3] for i in range(size)])
    return Batch(prepared.pixels.double(), prepared.ids, prepared.mask)


def make_moments(depth: int = 2, width: int = 32, seed: int = 0) -> list[Moments]:
    """Gaussians that differ from the tiny backbone's activations."""
    generator = torch.Generator().manual_seed(seed)
    draw = [torch.randn(2, width, generator=generator, dtype=torch.float64) for _ in range(depth)]
    return [Moments(100, mean * 0.3, std.square() * 0.2 + 0.01) for mean, std in draw]


def make_questions(count: int = 6) -> VQASet:
    """Questions about noise, two per image."""
    asked = [Question("color", *ASKED[i % len(ASKED)]) for i in range(count)]
    return VQASet(images(count // 2, seed=5).numpy(), np.arange(count) // 2, tuple(asked))


@cache
def make_anchor(energy: float = 1.0) -> Anchor:
    """An anchor of the tiny backbone with all its parts.

    Its moments are invented; its inputs and Fisher information are measured.
    """
    model, asked = make_tiny(), make_questions()
    return Anchor(
        make_moments(),
        make_moments(seed=1),
        inputs.measure(model, asked, energy),
        fisher.measure(model, asked, len(asked.questions)),
        curvature.measure(model, asked, energy, seed=0),
    )


def options_of(method: Method, **changes: Any) -> dict[str, Any]:
    """The method's options as a recipe gives them."""
    recipe = Recipe(
        name="sample", lora=Lora(**LORA), train=dataclasses.replace(Train(), method=method.name)
    )
    return recipes.options(recipe) | changes


def of_all_tokens(moments: list[Moments]) -> Anchor:
    """An anchor whose Gaussian over all tokens is exactly this one."""
    return Anchor(moments, [empty(len(m.mean)) for m in moments])


def start(method: Method, policy: Policy, anchor: Anchor | None = None, **changes: Any) -> Parts:
    """Adapt the policy's backbone and start the method on it."""
    backbone, options = policy.backbone, options_of(method, **changes)
    sites = backbone.sites()
    method.adapt(backbone, backbone.language_maps(), options)

    def vqa_loss(seen: Pass) -> Tensor:
        text, answer = ASKED[seen.step % len(ASKED)]
        return -backbone.answer_log_likelihood(images(1), [text], [answer]).mean()

    return method.start(
        MethodContext(
            backbone,
            backbone.learning_groups(),
            sites,
            options,
            anchor or make_anchor(),
            vqa_loss,
            INSTRUCTIONS,
            policy.targets,
            len(policy.action_scale.mean),
        )
    )


def adapt(method: Method, policy: Policy, anchor: Anchor | None = None, **changes: Any) -> Policy:
    """The policy with the method started on it; `gradients` finds the parts there."""
    policy.parts = start(method, policy, anchor, **changes)  # type: ignore[assignment]
    return policy


def gradients(
    policy: Policy, method: Method, batch: RobotBatch | None = None, **options: Any
) -> step.StepGradients:
    """Put one step's gradients into `.grad` of an adapted policy, with the same noise each time.

    Args:
        batch: instead of the usual one.
    """
    policy.zero_grad()
    settings = {"index": 0, "flow_samples": 2, "precision": "float32"} | options
    shown, noise = batch or robot_batch(), torch.Generator().manual_seed(0)
    return step.compute_gradients(policy, method, policy.parts, shown, noise, **settings)


def snapshot(named: Iterator[tuple[str, Tensor]]) -> dict[str, Tensor]:
    return {name: tensor.detach().clone() for name, tensor in named}


def snapshot_gradients(policy: Policy, part: str = "") -> dict[str, Tensor | None]:
    """Copies of `.grad` of the parameters whose name begins with `part`."""
    named = policy.named_parameters()
    return {
        name: None if p.grad is None else p.grad.clone()
        for name, p in named
        if name.startswith(part)
    }


def same_bits(x: Tensor | None, y: Tensor | None) -> bool:
    if x is None or y is None:
        return x is y
    return x.dtype == y.dtype and torch.equal(
        x.reshape(-1).view(torch.uint8), y.reshape(-1).view(torch.uint8)
    )
