"""Null space on a whole policy: VQA answers stay while the backbone learns to act."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from samples.nullspace import share_of_displacement
from samples.training import (
    INSTRUCTIONS,
    adapt,
    double_policy,
    gradients,
    make_anchor,
    robot_batch,
    snapshot,
)
from torch import Tensor, nn

from aegis_cli.anchors import inputs
from aegis_cli.core.anchor import Anchor
from aegis_cli.data.batch import Normalizer, RobotBatch
from aegis_cli.data.vqa.dataset import VQASet
from aegis_cli.data.vqa.questions import Question, vocabulary
from aegis_cli.methods import METHODS
from aegis_cli.methods.base import MethodContext, Parts, Update
from aegis_cli.models.backbones.embedded import EmbeddedVLM, Shape
from aegis_cli.models.backbones.tokenizer import SPECIAL
from aegis_cli.models.expert import ActionExpert, ExpertShape
from aegis_cli.models.policy import Policy
from aegis_cli.training import step

STEPS = 16
KINDS = ("maps", "norms", "embeddings", "stem")
PIXELS = 16  # four image tokens, so that two questions do not span all possible inputs of the maps
ASKED = (
    Question("color", "what color is the cube", "red"),
    Question("count", "count the objects", "two"),
)


# --- a policy whose VQA inputs leave room ---------------------------------------------------------


def small_images(count: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(256, (count, PIXELS, PIXELS, 3), generator=generator, dtype=torch.uint8)


def small_policy() -> Policy:
    """In float64, pixels included."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        shape = Shape(width=32, depth=2, heads=2, stem_width=8, image_size=PIXELS)
        backbone = EmbeddedVLM(shape, (*SPECIAL, *vocabulary()))
        expert = ActionExpert(
            ExpertShape(depth=2, heads=2, head_dim=16, proprio=3, actions=2, chunk=4, width=16)
        )
        scales = [Normalizer(torch.zeros(size), torch.ones(size)) for size in (3, 2)]
        policy = Policy(backbone, expert, *scales).double()
    backbone.pixels = lambda frames: EmbeddedVLM.pixels(backbone, frames).double()  # type: ignore[method-assign]
    return policy


def small_batch() -> RobotBatch:
    batch = robot_batch()
    return RobotBatch(
        small_images(5, seed=1), batch.instructions, batch.proprio, batch.actions, batch.is_pad
    )


def small_set() -> VQASet:
    return VQASet(small_images(1, seed=2).numpy(), np.zeros(2, int), ASKED)


@torch.no_grad()
def scores(policy: Policy) -> Tensor:
    """Scores of all answer words, one question at a time."""
    backbone, asked = policy.backbone, small_set()
    image = torch.from_numpy(asked.images)
    parts = [
        part.scores
        for q in ASKED
        for part in backbone.read_vqa(
            image, torch.zeros(1, dtype=torch.int64), [q.text], [q.answer]
        )
    ]
    return torch.cat(parts)


def constrain(parts: Parts, policy: Policy, optimizer: torch.optim.Optimizer) -> None:
    """The optimizer's step under the constraint of `parts`."""
    before = snapshot((n, p) for n, p in policy.backbone.named_parameters() if p.requires_grad)
    if parts.begin is not None:
        parts.begin()
    optimizer.step()
    if parts.constrain is not None:
        parts.constrain(Update({} if parts.begin else before, {}))


def fit(policy: Policy, parts: Parts) -> list[float]:
    """Action losses while only the backbone learns, on one batch with the same noise.

    The steps use weight decay and clipping.
    """
    learning = list(policy.backbone.parameters())
    optimizer = torch.optim.AdamW(learning, lr=3e-3, weight_decay=0.3)
    losses = []
    for _ in range(STEPS):
        policy.zero_grad()
        found = step.compute_gradients(
            policy,
            METHODS["naive"],
            parts,
            small_batch(),
            torch.Generator().manual_seed(0),
            index=0,
            flow_samples=2,
            precision="float32",
        )
        nn.utils.clip_grad_norm_(learning, 0.1)
        constrain(parts, policy, optimizer)
        losses.append(found.loss.item())
    return losses


def change_under(**options: float | tuple[str, ...]) -> float:
    """The largest change of an answer's score after `fit` with these options of `nullspace`."""
    policy = small_policy()
    before = scores(policy)
    fit(policy, protected(policy, **options))
    return (scores(policy) - before).abs().max().item()


def protected(policy: Policy, **options: float | tuple[str, ...]) -> Parts:
    backbone = policy.backbone
    anchor = Anchor(inputs=inputs.measure(backbone, small_set(), 1.0))
    chosen = {
        "energy": 1.0,
        "soft": 0.0,
        "every": 1,
        "protect": KINDS,
        "keeps": "weights",
    } | options
    return METHODS["nullspace"].start(
        MethodContext(backbone, backbone.parameter_groups(), backbone.sites(), chosen, anchor)
    )


def test_answers_keep_their_scores_while_the_backbone_learns_to_act() -> None:
    policy = small_policy()
    before, origin = scores(policy), snapshot(policy.backbone.named_parameters())
    losses = fit(policy, protected(policy))
    assert (scores(policy) - before).abs().max() < 1e-6
    assert losses[-1] < 0.9 * losses[0]
    moved = {
        n
        for n, p in policy.backbone.named_parameters()
        if (p - origin[n]).norm() > 1e-2 * origin[n].norm()
    }
    assert {
        "words.weight",
        "layers.0.qkv.weight",
        "layers.0.down.weight",
        "stem.mix.1.weight",
    } <= moved


@pytest.mark.parametrize("options", [{"energy": 0.99}, {"soft": 1e-3}])
def test_coordinates_of_the_weights_before_serve_as_well_as_the_weights(
    options: dict[str, float],
) -> None:
    one, other = small_policy(), small_policy()
    fit(one, protected(one, **options))
    parts = protected(other, **options, keeps="coordinates")
    fit(other, parts)
    assert not parts.copies
    learnt = dict(other.backbone.named_parameters())
    for name, parameter in one.backbone.named_parameters():
        torch.testing.assert_close(learnt[name], parameter, rtol=1e-6, atol=1e-9)


def test_without_protection_they_change() -> None:
    policy = small_policy()
    before = scores(policy)
    losses = fit(policy, Parts())
    assert losses[-1] < 0.9 * losses[0]
    assert (scores(policy) - before).abs().max() > 0.1


def test_the_more_energy_is_protected_the_less_they_change() -> None:
    changes = [change_under(energy=energy) for energy in (0.5, 0.99, 1.0)]
    assert changes == sorted(changes, reverse=True)


def test_the_lower_the_soft_threshold_the_less_they_change() -> None:
    changes = [change_under(soft=soft) for soft in (1e2, 1e-2, 1e-5)]
    assert changes == sorted(changes, reverse=True)


@pytest.mark.parametrize("kind", KINDS)
def test_one_kind_left_out_is_enough_to_change_them(kind: str) -> None:
    assert change_under(protect=tuple(k for k in KINDS if k != kind)) > 1e-3


# --- where the applied updates of methods lie -----------------------------------------------------


def share_after(name: str, energy: float, steps: int = 2) -> tuple[Policy, float]:
    """A float64 policy after some steps of a method, and the protected share of its movement."""
    policy = double_policy()
    adapt(METHODS[name], policy, **({"energy": energy} if name == "nullspace" else {}))
    learning = [p for p in policy.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(learning, lr=1e-3, weight_decay=0.1)
    for _ in range(steps):
        gradients(policy, METHODS[name])
        constrain(policy.parts, policy, optimizer)
    origin = double_policy().backbone
    return policy, share_of_displacement(policy.backbone, origin, make_anchor(), energy)


@pytest.mark.parametrize("energy", [0.5, 0.9, 0.999])
def test_the_null_space_is_left_alone_at_its_own_energy(energy: float) -> None:
    policy, share = share_after("nullspace", energy)
    assert 0 <= share < 1e-12
    origin = double_policy().backbone.state_dict()
    assert any(not torch.equal(t, origin[name]) for name, t in policy.backbone.state_dict().items())


def test_naive_moves_there_and_the_more_the_wider_the_directions() -> None:
    shares = [share_after("naive", energy)[1] for energy in (0.1, 0.5, 0.9, 0.999)]
    assert shares == sorted(shares) and 0.01 < shares[0] < shares[-1] < 1


def test_the_instructions_of_these_tests_differ_from_the_questions() -> None:
    assert not {q.text for q in ASKED} & set(INSTRUCTIONS)
