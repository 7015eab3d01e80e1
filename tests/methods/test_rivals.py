"""Methods that pull towards pre-trained weights, features or data, on a small float64 module."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor, nn

from aegis_cli.common.errors import AegisError
from aegis_cli.core.anchor import Anchor
from aegis_cli.methods import cotrain, distill, ewc, l2sp, maps
from aegis_cli.methods.base import Method, MethodContext, Parts, Pass, Update

RIVALS = (l2sp.METHOD, maps.METHOD, ewc.METHOD, distill.METHOD, cotrain.METHOD)
GROUPS = (
    "layers.0",
    "layers.1",
    "stem",
    "embeddings",
    "final_norm",
)  # in a backbone's order, which is not by depth
WIDTH, BATCH, TOKENS = 4, 3, 5


@pytest.fixture(autouse=True)
def fixed_draws() -> Iterator[None]:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        yield


class Toy(nn.Module):
    """Two layers on embedded tokens; `final_norm` does not affect the hidden states."""

    def __init__(self) -> None:
        super().__init__()
        self.stem, self.embeddings = nn.Linear(WIDTH, WIDTH), nn.Linear(WIDTH, WIDTH)
        self.layers = nn.ModuleList(nn.Linear(WIDTH, WIDTH) for _ in range(2))
        self.final_norm = nn.LayerNorm(WIDTH)
        self.double()

    def encode(self, x: Tensor) -> SimpleNamespace:
        """[B, T, D] -> `hidden`, 2 tensors [B, T, D]."""
        h, hidden = self.embeddings(self.stem(x).tanh()), []
        for layer in self.layers:
            h = h + layer(h).tanh()
            hidden.append(h)
        return SimpleNamespace(hidden=hidden)

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        return {name: list(self.get_submodule(name).parameters()) for name in GROUPS}


def make_setting(
    weight: float,
    anchor: Anchor | None = None,
    vqa_loss: Callable[[Pass], Tensor] | None = None,
    **changes: str,
) -> MethodContext:
    toy = Toy()
    options = {"weight": weight, "step": "gradient"} | changes
    return MethodContext(toy, toy.parameter_groups(), {}, options, anchor, vqa_loss)


def values(context: MethodContext) -> dict[str, Tensor]:
    return {name: p.detach().clone() for name, p in context.backbone.named_parameters()}


@torch.no_grad()
def move(context: MethodContext, scale: float = 0.3) -> None:
    for parameter in context.backbone.parameters():
        parameter += scale * torch.randn_like(parameter)


def set_gradients(context: MethodContext, gradients: Mapping[str, Tensor]) -> None:
    for name, parameter in context.backbone.named_parameters():
        parameter.grad = gradients[name].clone()


def draw_like(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name: torch.randn_like(t) for name, t in tensors.items()}


def make_fisher(context: MethodContext) -> dict[str, Tensor]:
    """Values that differ greatly in size between parameters, as in a Fisher information."""
    return {
        n: torch.rand_like(p.detach()) * 10.0**-i
        for i, (n, p) in enumerate(context.backbone.named_parameters())
    }


# --- all ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", RIVALS, ids=lambda method: method.name)
def test_without_weight_nothing_is_added(method: Method) -> None:
    assert method.start(make_setting(0.0)) == Parts()


@pytest.mark.parametrize("method", RIVALS, ids=lambda method: method.name)
def test_everything_learns(method: Method) -> None:
    toy = Toy().requires_grad_(False)
    method.adapt(toy, {}, {"weight": 1.0})
    assert all(p.requires_grad for p in toy.parameters())


def test_needs_and_ceiling_are_declared() -> None:
    needs = {method.name: set(method.needs) for method in RIVALS}
    assert needs == {
        "l2sp": set(),
        "maps": set(),
        "ewc": {"fisher"},
        "distill": set(),
        "cotrain": set(),
    }
    asking = [m.name for m in RIVALS if m.trains_on_questions({"weight": 0.1})]
    assert asking == ["cotrain"]
    assert not cotrain.METHOD.trains_on_questions({"weight": 0.0})
    assert not any(method.compares_layers or method.stop_gradient for method in RIVALS)


@pytest.mark.parametrize(
    ("method", "part"),
    [
        (l2sp.METHOD, "pull"),
        (maps.METHOD, "constrain"),
        (ewc.METHOD, "pull"),
        (distill.METHOD, "auxiliary"),
        (cotrain.METHOD, "auxiliary"),
    ],
    ids=lambda value: getattr(value, "name", value),
)
def test_each_adds_one_part(method: Method, part: str) -> None:
    context = make_setting(1.0, vqa_loss=lambda seen: torch.zeros(()))
    parts = method.start(replace(context, anchor=Anchor(fisher=make_fisher(context))))
    assert [name for name, value in vars(parts).items() if value != getattr(Parts(), name)] == [
        part
    ]


# --- l2sp and ewc: the pull is a penalty's gradient -----------------------------------------------


def assert_pull_is_gradient(
    method: Method, context: MethodContext, penalty: Callable[[dict[str, Tensor]], Tensor]
) -> None:
    """`pull` adds the gradient of a penalty of the parameters' distances from their start."""
    parts, origin = method.start(context), values(context)
    assert parts.pull is not None
    move(context)
    task = draw_like(origin)
    set_gradients(context, task)
    parts.pull()
    learning = context.learning()
    expected = torch.autograd.grad(
        penalty({n: p - origin[n] for n, p in learning.items()}), list(learning.values())
    )
    for (name, parameter), gradient in zip(learning.items(), expected, strict=True):
        torch.testing.assert_close(parameter.grad, task[name] + gradient, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("weight", [1e-3, 1.0, 70.0])
def test_l2sp_pulls_by_the_gradient_of_its_penalty(weight: float) -> None:
    assert_pull_is_gradient(
        l2sp.METHOD,
        make_setting(weight),
        lambda moved: weight / 2 * sum(d.square().sum() for d in moved.values()),
    )


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e6])
@pytest.mark.parametrize("weight", [1e-3, 70.0])
def test_ewc_pulls_by_the_gradient_of_its_penalty_whatever_the_scale_of_fisher(
    weight: float, scale: float
) -> None:
    context = make_setting(weight)
    fisher = make_fisher(context)
    mean = torch.cat([f.flatten() for f in fisher.values()]).mean()
    scaled = Anchor(fisher={name: f * scale for name, f in fisher.items()})
    assert_pull_is_gradient(
        ewc.METHOD,
        replace(context, anchor=scaled),
        lambda moved: (
            weight / 2 * sum((fisher[n] / mean * d.square()).sum() for n, d in moved.items())
        ),
    )


@pytest.mark.parametrize("method", [l2sp.METHOD, ewc.METHOD], ids=lambda method: method.name)
def test_a_parameter_without_a_gradient_gets_none(method: Method) -> None:
    context = make_setting(1.0)
    parts = method.start(replace(context, anchor=Anchor(fisher=make_fisher(context))))
    move(context)
    set_gradients(context, draw_like(values(context)))
    for parameter in context.groups["final_norm"]:
        parameter.grad = None
    parts.pull()
    assert all(p.grad is None for p in context.groups["final_norm"])


def test_ewc_leaves_what_has_no_fisher_information_alone() -> None:
    context = make_setting(5.0)
    fisher = make_fisher(context)
    fisher["layers.1.weight"].zero_()
    fisher["stem.weight"][1:].zero_()
    parts = ewc.METHOD.start(replace(context, anchor=Anchor(fisher=fisher)))
    move(context)
    task = draw_like(values(context))
    set_gradients(context, task)
    parts.pull()
    gradients = {name: p.grad for name, p in context.backbone.named_parameters()}
    assert torch.equal(gradients["layers.1.weight"], task["layers.1.weight"])
    assert torch.equal(gradients["stem.weight"][1:], task["stem.weight"][1:])
    assert not torch.isclose(gradients["stem.weight"][0], task["stem.weight"][0]).any()


@pytest.mark.parametrize("weight", [1e-3, 1.0, 70.0])
@pytest.mark.parametrize("steps", [1, 3])
def test_a_proximal_ewc_minimises_distance_and_penalty(weight: float, steps: int) -> None:
    """The closed form is where (theta - moved) + w F (theta - theta0) is 0."""
    context = make_setting(weight, step="proximal")
    fisher = make_fisher(context)
    parts = ewc.METHOD.start(replace(context, anchor=Anchor(fisher=fisher)))
    assert parts.constrain is not None and parts.pull is None and not parts.compares
    origin = values(context)
    move(context)
    moved = values(context)
    parts.constrain(Update({}, {}, steps))
    relative = ewc.relative_fisher(fisher, context.learning())
    for name, parameter in context.backbone.named_parameters():
        found = parameter.detach()
        pulled = steps * weight * relative[name] * (found - origin[name])
        torch.testing.assert_close(found - moved[name] + pulled, torch.zeros_like(found))
        wanted = (moved[name] - origin[name]) / (1 + steps * weight * relative[name])
        torch.testing.assert_close(found - origin[name], wanted)


def test_a_weight_past_float32_holds_what_has_fisher_information_and_frees_the_rest() -> None:
    context = make_setting(1e39, step="proximal")
    context.backbone.float()
    fisher = {name: torch.zeros_like(p) for name, p in context.backbone.named_parameters()}
    fisher["stem.weight"][0] = 1.0
    origin = values(context)
    parts = ewc.METHOD.start(replace(context, anchor=Anchor(fisher=fisher)))
    move(context)
    moved = values(context)
    parts.constrain(Update({}, {}))
    after = values(context)
    torch.testing.assert_close(after["stem.weight"][0], origin["stem.weight"][0])
    assert torch.equal(after["stem.weight"][1:], moved["stem.weight"][1:])
    assert torch.equal(after["layers.0.weight"], moved["layers.0.weight"])


def test_a_proximal_ewc_leaves_what_has_no_fisher_information_alone() -> None:
    context = make_setting(5.0, step="proximal")
    fisher = make_fisher(context)
    fisher["layers.1.weight"].zero_()
    parts = ewc.METHOD.start(replace(context, anchor=Anchor(fisher=fisher)))
    move(context)
    moved = values(context)
    parts.constrain(Update({}, {}))
    after = values(context)
    assert torch.equal(after["layers.1.weight"], moved["layers.1.weight"])
    assert not torch.isclose(after["stem.weight"], moved["stem.weight"]).any()


def test_ewc_averages_over_what_learns_alone() -> None:
    context = make_setting(1.0)
    fisher = make_fisher(context)
    for parameter in context.groups["stem"]:
        parameter.requires_grad_(False)
    relative = ewc.relative_fisher(fisher, context.learning())
    assert not any(name.startswith("stem.") for name in relative)
    torch.testing.assert_close(
        torch.cat([f.flatten() for f in relative.values()]).mean().item(), 1.0
    )


def test_ewc_names_a_parameter_that_the_anchor_lacks() -> None:
    context = make_setting(1.0)
    fisher = make_fisher(context)
    del fisher["layers.1.bias"]
    with pytest.raises(AegisError) as caught:
        ewc.METHOD.start(replace(context, anchor=Anchor(fisher=fisher)))
    assert "'layers.1.bias'" in caught.value.found


@pytest.mark.parametrize("value", [0.0, float("nan")])
def test_ewc_refuses_a_fisher_information_that_says_nothing(value: float) -> None:
    context = make_setting(1.0)
    fisher = {name: torch.full_like(f, value) for name, f in make_fisher(context).items()}
    with pytest.raises(AegisError) as caught:
        ewc.METHOD.start(replace(context, anchor=Anchor(fisher=fisher)))
    assert "0" in caught.value.found or "nan" in caught.value.found


# --- maps -----------------------------------------------------------------------------------------


class Stepped:
    """A step by hand from `before` to `free`, which MAPS changes into `after`.

    Gradients point outwards, times `sign`.

    Under an outward gradient, descent leads back to the origin, which is the direction SPD checks.
    """

    def __init__(self, weight: float, *, sign: float = 1.0, growth: float = 0.2) -> None:
        context = make_setting(weight)
        self.context, self.origin = context, values(context)
        parts = maps.METHOD.start(context)
        assert parts.constrain is not None
        move(context)
        self.before = values(context)
        outwards = {name: t - self.origin[name] for name, t in self.before.items()}
        with torch.no_grad():  # further by `growth`, and a little sideways
            for name, parameter in context.backbone.named_parameters():
                parameter += growth * outwards[name] + 0.02 * torch.randn_like(parameter)
        self.free = values(context)
        set_gradients(context, {name: sign * d for name, d in outwards.items()})
        parts.constrain(Update(self.before, {}))
        self.after = values(context)

    def distances(self, tensors: Mapping[str, Tensor]) -> dict[str, float]:
        return {name: (t - self.origin[name]).norm().item() for name, t in tensors.items()}

    def kept(self) -> dict[str, float]:
        """Share of the distance from the origin that is left of each parameter's step."""
        after, free = self.distances(self.after), self.distances(self.free)
        return {name: after[name] / free[name] for name in after}


def test_maps_schedule_falls_linearly_from_the_pixels_to_the_answer() -> None:
    strengths = maps.schedule(
        ["layers.0", "layers.10", "layers.2", "stem", "embeddings", "final_norm"], 3.0
    )
    assert list(strengths) == [
        "stem",
        "embeddings",
        "layers.0",
        "layers.2",
        "layers.10",
        "final_norm",
    ]
    torch.testing.assert_close(list(strengths.values()), [3.0, 2.4, 1.8, 1.2, 0.6, 0.0])


def test_maps_counts_groups_of_other_names_as_vision() -> None:
    assert list(
        maps.schedule(["layers.0", "vision.layers.3", "final_norm", "stem", "embeddings"], 1.0)
    ) == [
        "vision.layers.3",
        "stem",
        "embeddings",
        "layers.0",
        "final_norm",
    ]
    assert maps.schedule(["layers.0"], 0.7) == {"layers.0": 0.7}


def test_maps_leaves_the_first_step_alone() -> None:
    context = make_setting(1.0)
    parts, before = maps.METHOD.start(context), values(context)
    move(context)
    free = values(context)
    set_gradients(context, draw_like(before))
    parts.constrain(Update(before, {}))
    assert all(torch.equal(t, free[name]) for name, t in values(context).items())


@pytest.mark.parametrize("weight", [0.5, 1.0, 3.2])
def test_maps_never_projects_where_descent_leads_further_away(weight: float) -> None:
    stepped = Stepped(weight, sign=-1.0)
    assert all(torch.equal(t, stepped.free[name]) for name, t in stepped.after.items())


@pytest.mark.parametrize("weight", [0.5, 1.0, 3.2])
def test_maps_never_projects_a_step_that_comes_back(weight: float) -> None:
    stepped = Stepped(weight, growth=-0.5)
    assert all(torch.equal(t, stepped.free[name]) for name, t in stepped.after.items())


def test_maps_projects_each_parameter_by_its_own_gradient() -> None:
    context = make_setting(1.0)
    parts, origin = maps.METHOD.start(context), values(context)
    move(context)
    before = values(context)
    with torch.no_grad():
        for name, parameter in context.backbone.named_parameters():
            parameter += 0.2 * (before[name] - origin[name])
    free = values(context)
    signs = {name: -1.0 if name.endswith("bias") else 1.0 for name in before}
    set_gradients(
        context, {name: sign * (before[name] - origin[name]) for name, sign in signs.items()}
    )
    parts.constrain(Update(before, {}))
    moved = {name for name, t in values(context).items() if not torch.equal(t, free[name])}
    assert moved == {
        name for name in before if name.endswith("weight") and not name.startswith("final_norm")
    }


@pytest.mark.parametrize("weight", [0.3, 1.0])
def test_maps_ends_between_the_step_and_the_distance_before_it(weight: float) -> None:
    stepped = Stepped(weight)
    before, free, after = (
        stepped.distances(t) for t in (stepped.before, stepped.free, stepped.after)
    )
    assert all(before[name] < free[name] for name in free)
    assert all(before[name] - 1e-12 <= after[name] <= free[name] for name in free)
    # of the distance from the origin, each group keeps 1 - lambda_k
    strengths = maps.schedule(stepped.context.groups, weight)
    for name in free:
        kept = (after[name] - before[name]) / (free[name] - before[name])
        torch.testing.assert_close(
            kept, 1 - strengths[name.rpartition(".")[0]], rtol=1e-9, atol=1e-9
        )


def test_maps_holds_the_first_module_at_its_distance_and_lets_the_last_one_go() -> None:
    stepped = Stepped(1.0)
    before, after = stepped.distances(stepped.before), stepped.distances(stepped.after)
    for name in after:
        if name.startswith("stem."):
            torch.testing.assert_close(after[name], before[name])
        if name.startswith("final_norm."):
            assert torch.equal(stepped.after[name], stepped.free[name])


def test_maps_holds_a_module_the_less_the_later_it_is() -> None:
    kept = Stepped(1.0).kept()
    weights = [kept[f"{group}.weight"] for group in maps.schedule(GROUPS, 1.0)]
    assert weights == sorted(weights)
    assert weights[0] < weights[-1] == 1.0


@pytest.mark.parametrize("weight", [0.5, 3.2, 1e6])
def test_maps_stays_between_the_pre_trained_weights_and_the_step(weight: float) -> None:
    stepped = Stepped(weight)
    for name, share in stepped.kept().items():
        assert -1e-12 <= share <= 1 + 1e-12
        way = stepped.free[name] - stepped.origin[name]
        torch.testing.assert_close(
            stepped.after[name], stepped.origin[name] + share * way, rtol=1e-9, atol=1e-12
        )
    if weight == 1e6:  # so strong that the first module is back at its start, and not beyond
        assert stepped.kept()["stem.weight"] < 1e-12


def test_maps_leaves_a_parameter_without_a_gradient_alone() -> None:
    context = make_setting(1.0)
    parts = maps.METHOD.start(context)
    move(context)
    before = values(context)
    parts.constrain(Update(before, {}))
    assert all(torch.equal(t, before[name]) for name, t in values(context).items())


# --- distill --------------------------------------------------------------------------------------


def make_mask() -> Tensor:
    """[B, T]: the last tokens of all but the first row are padding."""
    mask = torch.ones(BATCH, TOKENS, dtype=torch.bool)
    mask[1:, -2:] = False
    return mask


def see(context: MethodContext, inputs: Tensor, step: int = 0) -> Pass:
    hidden = context.backbone.encode(inputs).hidden
    return Pass(step, inputs, hidden, make_mask(), torch.arange(TOKENS) < 2)


def draw_inputs() -> Tensor:
    return torch.randn(BATCH, TOKENS, WIDTH, dtype=torch.float64)


def started(weight: float) -> tuple[MethodContext, Callable[[Pass], Tensor]]:
    context = make_setting(weight)
    auxiliary = distill.METHOD.start(context).auxiliary
    assert auxiliary is not None
    return context, auxiliary


def test_distill_begins_at_zero_and_with_no_gradient() -> None:
    context, auxiliary = started(2.0)
    loss = auxiliary(see(context, draw_inputs()))
    loss.backward()
    assert loss.item() == 0
    gradients = [
        p.grad
        for name, p in context.backbone.named_parameters()
        if not name.startswith("final_norm.")
    ]
    assert all(gradient is not None and not gradient.any() for gradient in gradients)


def test_distill_falls_under_descent_and_its_teacher_does_not_move() -> None:
    context, auxiliary = started(2.0)
    inputs = draw_inputs()
    first = see(context, inputs)
    taught = [h.detach() for h in first.hidden]
    move(context)
    optimizer, losses = torch.optim.SGD(context.backbone.parameters(), lr=0.005), []
    for _ in range(20):
        optimizer.zero_grad()
        loss = auxiliary(see(context, inputs))
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert all(b < a for a, b in zip(losses, losses[1:]))
    assert 0 < losses[-1] < 0.5 * losses[0]
    # the teacher is unchanged: its hidden states are those from before
    assert auxiliary(replace(first, hidden=taught)).item() == 0


def test_distill_is_the_mean_over_layers_of_the_relative_squared_distance() -> None:
    context, auxiliary = started(3.0)
    inputs, mask = draw_inputs(), make_mask()
    taught = context.backbone.encode(inputs).hidden
    move(context)
    seen = see(context, inputs)
    layers = []
    for h, h0 in zip(seen.hidden, taught, strict=True):
        tokens = [(b, t) for b in range(BATCH) for t in range(TOKENS) if mask[b, t]]
        mean = torch.stack([h0[i] for i in tokens]).mean(0)
        off = sum((h[i] - h0[i]).square().sum() for i in tokens)
        layers.append(off / sum((h0[i] - mean).square().sum() for i in tokens))
    torch.testing.assert_close(auxiliary(seen), 3.0 * (layers[0] + layers[1]) / 2)


def test_distill_does_not_count_padding() -> None:
    context, auxiliary = started(1.0)
    inputs = draw_inputs()
    move(context)
    seen = see(context, inputs)
    pad = ~make_mask()[..., None]
    elsewhere = [torch.where(pad, 100 * torch.randn_like(h), h) for h in seen.hidden]
    assert torch.equal(auxiliary(replace(seen, hidden=elsewhere)), auxiliary(seen))
    other = torch.where(pad, torch.randn_like(inputs), inputs)
    assert torch.equal(auxiliary(see(context, other)), auxiliary(seen))
    valid = [torch.where(pad, h, h + 1) for h in seen.hidden]
    assert not torch.isclose(auxiliary(replace(seen, hidden=valid)), auxiliary(seen))


@pytest.mark.parametrize("factor", [1e-6, 1e4])
def test_distill_ignores_the_scale_of_a_layer(factor: float) -> None:
    student, teacher = ([draw_inputs() for _ in range(2)] for _ in range(2))
    expected = distill.relative_distance(student, teacher, make_mask())
    scaled = ([hs[0], factor * hs[1]] for hs in (student, teacher))
    torch.testing.assert_close(distill.relative_distance(*scaled, make_mask()), expected)


def test_distill_computes_half_precision_in_float32() -> None:
    student, teacher = ([draw_inputs().bfloat16() for _ in range(2)] for _ in range(2))
    loss = distill.relative_distance(student, teacher, make_mask())
    wide = ([h.double() for h in hs] for hs in (student, teacher))
    assert loss.dtype == torch.float32
    torch.testing.assert_close(
        loss.double(), distill.relative_distance(*wide, make_mask()), rtol=1e-6, atol=0
    )


def test_distill_teaches_what_the_backbone_was_when_it_started() -> None:
    context, auxiliary = started(1.0)
    parameters = list(context.backbone.parameters())
    move(context)
    auxiliary(see(context, draw_inputs())).backward()
    assert list(map(id, context.backbone.parameters())) == list(
        map(id, parameters)
    )  # the copy is neither trained nor saved
    assert all(p.requires_grad for p in parameters)


# --- cotrain --------------------------------------------------------------------------------------


def test_cotrain_adds_weight_times_the_gradient_of_the_questions_of_this_step() -> None:
    context = make_setting(0.25)
    inputs, asked = draw_inputs(), []

    def vqa_loss(seen: Pass) -> Tensor:
        asked.append(seen.step)
        return (seen.step + 1) * context.backbone.encode(inputs).hidden[-1].square().mean()

    auxiliary = cotrain.METHOD.start(replace(context, vqa_loss=vqa_loss)).auxiliary
    assert auxiliary is not None and asked == []
    parameters = [
        p for name, p in context.backbone.named_parameters() if not name.startswith("final_norm.")
    ]
    for step in (0, 7):
        seen = see(context, inputs, step)
        added = torch.autograd.grad(auxiliary(seen), parameters)
        expected = torch.autograd.grad(vqa_loss(seen), parameters)
        for gradient, of_questions in zip(added, expected, strict=True):
            torch.testing.assert_close(gradient, 0.25 * of_questions)
    assert asked == [0, 0, 7, 7]
