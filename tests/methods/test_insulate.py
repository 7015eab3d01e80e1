"""Knowledge insulation: what reaches the backbone, and how actions are written as text."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch
from samples.tiny import make_tiny
from samples.training import (
    ASKED,
    CHUNK,
    INSTRUCTIONS,
    adapt,
    double_policy,
    gradients,
    images,
    make_policy,
    options_of,
    robot_batch,
    same_bits,
    snapshot,
    snapshot_gradients,
    start,
)
from torch import Tensor
from torch.nn import functional as F

from aegis_cli.common.errors import AegisError
from aegis_cli.data.vqa import questions
from aegis_cli.methods import METHODS, insulate
from aegis_cli.methods.base import Parts, Pass
from aegis_cli.models.backbones import embedded
from aegis_cli.models.policy import Policy

INSULATE, STOP = METHODS["insulate"], METHODS["stop-gradient"]


@pytest.fixture(autouse=True)
def fixed_draws() -> Iterator[None]:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        yield


def steps(policy: Policy, method: str, count: int = 3) -> None:
    """AdamW steps with weight decay, which move whatever has a gradient."""
    learning = [p for p in policy.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(learning, lr=1e-2, weight_decay=0.1)
    for index in range(count):
        gradients(policy, METHODS[method], index=index)
        optimizer.step()


# --- what reaches what ----------------------------------------------------------------------------


def test_the_experts_loss_gives_the_backbone_no_gradient() -> None:
    policy = adapt(INSULATE, make_policy(), weight=0.0)
    gradients(policy, INSULATE)
    assert all(p.requires_grad and p.grad is None for p in policy.backbone.parameters())
    assert all(p.grad is not None for p in policy.expert.parameters())


def test_the_backbones_gradient_is_that_of_its_actions_as_text() -> None:
    """Twice the weight gives twice the gradient, and the expert's is as under stop-gradient."""
    found = {}
    for weight in (1.0, 2.0):
        policy = adapt(INSULATE, double_policy(), weight=weight)
        gradients(policy, INSULATE)
        found[weight] = snapshot_gradients(policy)
    stopped = adapt(STOP, double_policy())
    gradients(stopped, STOP)
    expert = snapshot_gradients(stopped, "expert.")
    for name, gradient in found[1.0].items():
        if name.startswith("expert."):
            assert same_bits(gradient, expert[name]) and same_bits(gradient, found[2.0][name])
        elif gradient is not None:
            torch.testing.assert_close(found[2.0][name], 2 * gradient)
    moved = [n for n, g in found[1.0].items() if n.startswith("backbone.") and g is not None]
    assert any(name.endswith("words.weight") for name in moved)


@pytest.fixture
def graphless_casts_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """Autocast as before torch 2.11: a weight's cast is cached even if made without a graph."""
    casts: dict[int, Tensor] = {}
    linear, clear = F.linear, torch.clear_autocast_cache

    def cast(parameter: Tensor) -> Tensor:
        if id(parameter) not in casts:
            casts[id(parameter)] = parameter.to(torch.bfloat16)
        return casts[id(parameter)]

    def of_casts(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
        if not torch.is_autocast_enabled("cpu"):
            return linear(x, weight, bias)
        return linear(x, cast(weight), None if bias is None else cast(bias))

    def cleared() -> None:
        casts.clear()
        clear()

    monkeypatch.setattr(F, "linear", of_casts)
    monkeypatch.setattr(torch, "clear_autocast_cache", cleared)


def test_weights_that_a_pass_without_a_graph_has_rounded_get_their_gradient(
    graphless_casts_are_kept: None,
) -> None:
    found = []
    for precision in ("float32", "bf16"):
        policy = adapt(INSULATE, make_policy())
        gradients(policy, INSULATE, precision=precision)
        learned = snapshot_gradients(policy, "backbone.").items()
        found.append({name for name, gradient in learned if gradient is not None})
    assert any("layers.0" in name for name in found[0])
    assert found[0] == found[1]


def test_without_weight_it_is_stop_gradient_bit_for_bit() -> None:
    insulated, stopped = adapt(INSULATE, make_policy(), weight=0.0), adapt(STOP, make_policy())
    before = snapshot(insulated.backbone.named_parameters())
    assert insulated.parts == Parts()
    steps(insulated, "insulate")
    steps(stopped, "stop-gradient")
    wanted = dict(stopped.named_parameters())
    assert all(same_bits(p.data, wanted[name].data) for name, p in insulated.named_parameters())
    assert all(same_bits(p.data, before[n]) for n, p in insulated.backbone.named_parameters())


def test_the_backbone_learns_to_say_what_is_done() -> None:
    policy = adapt(INSULATE, make_policy())
    auxiliary = policy.parts.auxiliary
    batch = robot_batch()
    seen = Pass(0, None, (), torch.ones(1), torch.ones(1), batch)
    first = auxiliary(seen).item()
    # An untrained model guesses: about the log of the vocabulary size per word, two words a number.
    assert first == pytest.approx(2 * math.log(len(policy.backbone.tokenizer.vocabulary)), rel=0.5)
    steps(policy, "insulate", count=20)
    assert auxiliary(seen).item() < 0.7 * first


# --- questions beside it --------------------------------------------------------------------------


def test_with_a_weight_on_questions_it_is_a_ceiling() -> None:
    assert not INSULATE.trains_on_questions(options_of(INSULATE))
    assert INSULATE.trains_on_questions(options_of(INSULATE, vqa_weight=0.1))


def test_questions_add_their_weight_times_their_gradient() -> None:
    policy = adapt(INSULATE, double_policy(), weight=0.0, vqa_weight=0.25)
    gradients(policy, INSULATE, index=1)
    found = snapshot_gradients(policy, "backbone.")
    policy.zero_grad()
    text, answer = ASKED[1]
    said = policy.backbone.answer_log_likelihood(images(1), [text], [answer])
    (-0.25 * said.mean()).backward()
    for name, gradient in snapshot_gradients(policy, "backbone.").items():
        assert (gradient is None) == (found[name] is None)
        if gradient is not None:
            torch.testing.assert_close(found[name], gradient)


# --- actions as text ------------------------------------------------------------------------------


@pytest.mark.parametrize(("count", "limit"), [(2, 1.0), (8, 2.0), (64, 2.5), (256, 1.0)])
def test_bins_are_equal_and_the_outer_ones_open(count: int, limit: float) -> None:
    width = 2 * limit / count
    middles = torch.arange(count, dtype=torch.float64) * width - limit + width / 2
    assert insulate.binned(middles, limit, count).tolist() == list(range(count))
    near = insulate.binned(middles + 0.49 * width, limit, count)
    assert near.tolist() == list(range(count))
    beyond = torch.tensor([-100.0, -limit, limit, 100.0])
    assert insulate.binned(beyond, limit, count).tolist() == [0, 0, count - 1, count - 1]


@pytest.mark.parametrize(
    ("chunk", "horizon", "wanted"),
    [(8, 1, [0]), (8, 2, [0, 7]), (8, 3, [0, 4, 7]), (4, 4, [0, 1, 2, 3]), (1, 2, [0])],
)
def test_the_steps_that_are_written_are_spread_over_the_chunk(
    chunk: int, horizon: int, wanted: list[int]
) -> None:
    assert insulate.spread(chunk, horizon).tolist() == wanted


def test_a_text_has_a_number_for_each_action_up_to_the_episodes_end() -> None:
    bins = torch.tensor([[[0, 1], [2, 3]], [[3, 2], [1, 0]]])
    shown = torch.tensor([[True, True], [True, False]])
    assert insulate.as_texts(bins, shown, "abcd") == ["a b c d", "d c"]


def test_the_loss_is_in_nats_per_number_that_is_written() -> None:
    policy = double_policy()
    batch = robot_batch()
    assert batch.is_pad[:, -1].any() and not batch.is_pad[:, 0].any()
    auxiliary = start(INSULATE, policy, horizon=2, bins=8, weight=3.0).auxiliary
    assert auxiliary is not None
    actions = policy.targets(batch)[:, [0, CHUNK - 1]]
    total, numbers = torch.zeros((), dtype=torch.float64), 0
    for i, instruction in enumerate(batch.instructions):
        rows = actions[i][~batch.is_pad[i, [0, CHUNK - 1]]]
        words = [f"x{b}" for b in insulate.binned(rows, 2.0, 8).flatten().tolist()]
        said = policy.backbone.answer_log_likelihood(
            batch.images[i : i + 1], [instruction], [" ".join(words)]
        )
        total, numbers = total - said.sum(), numbers + len(words)
    seen = Pass(0, None, (), torch.ones(1), torch.ones(1), batch)
    torch.testing.assert_close(auxiliary(seen).double(), 3 * total / numbers, rtol=1e-5, atol=1e-6)


def test_actions_are_asked_for_by_the_prompt() -> None:
    """A prompt around the instruction equals the instruction with those words."""
    policy, batch = make_policy(), robot_batch()
    asked = replace(batch, instructions=[f"arm {text}" for text in batch.instructions])
    losses = []
    for prompt, frames in (("arm {}", batch), ("{}", asked), ("{}", batch)):
        auxiliary = start(INSULATE, policy, prompt=prompt).auxiliary
        assert auxiliary is not None
        losses.append(auxiliary(Pass(0, None, (), torch.ones(1), torch.ones(1), frames)).item())
    assert losses[0] == losses[1] != losses[2]


@pytest.mark.parametrize("count", [2, 8, 9, 64])
def test_the_embedded_vlm_knows_a_text_for_each_number(count: int) -> None:
    model = make_tiny()
    texts = model.number_texts(count)
    lengths = {len(model.tokenizer.encode(text)) for text in texts}
    assert len(set(texts)) == count and lengths == {1 if count <= 8 else 2}
    assert model.numbers == 64
    assert (embedded.X_WORDS, embedded.Y_WORDS) == (questions.X_WORDS, questions.Y_WORDS)


# --- refusals -------------------------------------------------------------------------------------


def test_more_bins_than_numbers_are_refused() -> None:
    with pytest.raises(AegisError) as caught:
        start(INSULATE, make_policy(), bins=65)
    assert "65" in caught.value.found and "insulate.bins=64" in caught.value.fix


def test_a_text_too_long_for_the_longest_instruction_is_refused_before_any_step() -> None:
    with pytest.raises(AegisError) as caught:
        start(INSULATE, make_policy(), horizon=CHUNK)
    assert any(instruction in caught.value.found for instruction in INSTRUCTIONS)
    assert "insulate.horizon=1" in caught.value.fix
    start(INSULATE, make_policy(), horizon=CHUNK, bins=8)


def test_an_action_gives_the_same_text_wherever_it_lies() -> None:
    batch: Tensor = torch.randn(3, 2, 2)
    bins = insulate.binned(batch, 2.0, 64)
    numbers = make_tiny().number_texts(64)
    whole = insulate.as_texts(bins, torch.ones(3, 2, dtype=torch.bool), numbers)
    for i in range(3):
        alone = insulate.as_texts(bins[i : i + 1], torch.ones(1, 2, dtype=torch.bool), numbers)
        assert alone == [whole[i]]
