"""AdamW that protects a VLM whose parameters have no names: it is recognised by their values."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from samples.nullspace import size
from samples.tiny import make_tiny
from torch import Tensor, nn

from aegis_cli.anchors import anchor_file, measure
from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError
from aegis_cli.core import nullspace
from aegis_cli.core.nullspace import Strength
from aegis_cli.guard.optimizer import ProtectedAdamW
from aegis_cli.models import backbones
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.recipes import Anchor

ADAMW = {"lr": 3e-3, "weight_decay": 0.1}
PARTS = ("weight", "bias")


@pytest.fixture(scope="module")
def base(tiny_folder: Path) -> Backbone:
    return backbones.load(str(tiny_folder))


@pytest.fixture(scope="module")
def anchor(tiny_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return measured(tiny_folder, tmp_path_factory.mktemp("anchor") / "anchor.safetensors")


def measured(folder: Path, path: Path) -> Path:
    settings = Anchor(samples=14, batch_size=14, parts=("inputs", "curvature"), energy=1.0)
    measure.run(str(folder), settings, path)
    return path


class Foreign(nn.Module):
    """A policy of another program: the VLM somewhere inside, and an expert that reads from it."""

    def __init__(self, tiny_folder: Path) -> None:
        super().__init__()
        torch.manual_seed(1)
        self.before = nn.Linear(3, 3)
        self.inner = nn.ModuleDict({"vlm": backbones.load(str(tiny_folder))})
        self.after = nn.Linear(4, 2)


def gradients(model: nn.Module, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    for parameter in model.parameters():
        if parameter.requires_grad:
            drawn = torch.randn(parameter.shape, generator=generator)
            parameter.grad = drawn.to(parameter.dtype)


def values(model: nn.Module) -> dict[str, Tensor]:
    return {name: p.detach().clone() for name, p in model.named_parameters()}


def train(model: nn.Module, optimizer: torch.optim.Optimizer, steps: range) -> None:
    for seed in steps:
        gradients(model, seed)
        optimizer.step()
        optimizer.zero_grad()


def make(
    model: nn.Module, method: str, anchor: Path, base: Backbone, **options: Any
) -> ProtectedAdamW:
    return ProtectedAdamW(model.parameters(), method, anchor, base, options, **ADAMW)


def interrupted_and_whole(
    fresh: Callable[[], Foreign],
    teach: Callable[[nn.Module, torch.optim.Optimizer, range], None],
    made: Callable[[Foreign], ProtectedAdamW],
) -> tuple[ProtectedAdamW, ProtectedAdamW]:
    """The optimizers of a resumed training and of an uninterrupted one, with equal weights."""
    model = fresh()
    optimizer = made(model)
    teach(model, optimizer, range(2))
    weights, state = values(model), copy.deepcopy(optimizer.state_dict())
    teach(model, optimizer, range(2, 5))
    again = fresh()
    again.load_state_dict(weights, strict=False)
    resumed = made(again)
    resumed.load_state_dict(state)
    teach(again, resumed, range(2, 5))
    for one, other in zip(model.parameters(), again.parameters(), strict=True):
        assert torch.equal(one, other)
    return resumed, optimizer


@pytest.mark.parametrize(
    ("method", "options"),
    [("kfac", {"weight": 0.0, "balance": 0.0}), ("nullspace", {"energy": 0.0})],
)
def test_at_strength_0_it_is_adamw_bit_for_bit(
    method: str, options: dict[str, float], tiny_folder: Path, base: Backbone, anchor: Path
) -> None:
    ours, plain = Foreign(tiny_folder), Foreign(tiny_folder)
    optimizer = make(ours, method, anchor, base, **options)
    train(ours, optimizer, range(4))
    train(plain, torch.optim.AdamW(plain.parameters(), **ADAMW), range(4))
    for mine, other in zip(ours.parameters(), plain.parameters(), strict=True):
        assert torch.equal(mine, other)


def test_the_applied_update_is_orthogonal_to_what_questions_span(
    tiny_folder: Path, base: Backbone, anchor: Path
) -> None:
    model = Foreign(tiny_folder)
    before = values(model)
    train(model, make(model, "nullspace", anchor, base, energy=0.9), range(3))
    after = values(model)
    vlm = model.inner["vlm"]
    sites = vlm.sites()
    likes = {site: vlm.get_submodule(site).weight for site in sites}
    found = nullspace.protections(
        anchor_file.from_artifact(artifacts.load(anchor, "anchor")), likes, Strength(0.9)
    )
    moved = {n: (after[n] - before[n]) for n in before}
    for site, protection in found.items():
        update = [moved.get(f"inner.vlm.{site}.{part}") for part in PARTS]
        inside = size(protection.removed(*update))
        assert inside <= 1e-10 * size(tuple(update)), site
    assert moved["after.weight"].abs().min() > 0  # the expert is free


def test_kfac_holds_the_vlm_closer_and_leaves_the_expert_alone(
    tiny_folder: Path, base: Backbone, anchor: Path
) -> None:
    far, near = Foreign(tiny_folder), Foreign(tiny_folder)
    start = values(far)
    train(far, make(far, "kfac", anchor, base, weight=1e-6, balance=0.0), range(6))
    train(near, make(near, "kfac", anchor, base, weight=10.0, balance=0.0), range(6))
    name = "inner.vlm.layers.0.up.weight"
    distance = [(values(m)[name] - start[name]).norm() for m in (far, near)]
    assert distance[1] < 0.9 * distance[0]  # directions without curvature stay free
    assert torch.equal(far.after.weight, near.after.weight)


def test_with_kfac_normalisations_and_tables_of_the_vlm_do_not_learn(
    tiny_folder: Path, base: Backbone, anchor: Path
) -> None:
    model = Foreign(tiny_folder)
    gradients(model, 0)  # from a pass before the optimizer was made
    optimizer = make(model, "kfac", anchor, base)
    still = {name for name, p in model.named_parameters() if not p.requires_grad}
    assert still == {
        f"inner.vlm.{name}"
        for name, _ in base.named_parameters()
        if "norm" in name or name.startswith(("words", "text_position", "stem.position"))
    }
    maps = {site for site, kind in base.sites().items() if kind in ("maps", "stem")}
    assert set(optimizer.protected) == maps - {"stem.position"}
    before = values(model)
    optimizer.step()
    assert all(torch.equal(before[name], model.get_parameter(name)) for name in still)


@pytest.mark.parametrize("decays_apart", [False, True])
@pytest.mark.parametrize("place", ["before", "after"])
def test_an_experts_new_norms_learn_with_kfac(
    place: str, decays_apart: bool, tiny_folder: Path, base: Backbone, anchor: Path
) -> None:
    """They have the same values as the norms of this untrained VLM, which stay frozen."""
    model = Foreign(tiny_folder)
    expert = make_tiny(9).layers[0]
    setattr(model, place, expert)
    ProtectedAdamW(in_groups(model, decays_apart), "kfac", anchor, base, {}, **ADAMW)
    assert all(p.requires_grad for p in expert.parameters())
    still = {name for name, p in model.inner["vlm"].named_parameters() if not p.requires_grad}
    assert {f"layers.{i}.norm{n}.{part}" for i in (0, 1) for n in (1, 2) for part in PARTS} <= still
    assert not any(part in name for name in still for part in ("qkv", "out", "up", "down"))


def in_groups(model: nn.Module, decays_apart: bool) -> list[dict[str, Any]]:
    """The optimizer's groups: one, or as is common two, one of which decays."""
    parameters = list(model.parameters())
    if not decays_apart:
        return [{"params": parameters}]
    matrices = [p for p in parameters if p.ndim > 1]
    rest = [p for p in parameters if p.ndim <= 1]
    return [{"params": matrices}, {"params": rest, "weight_decay": 0.0}]


@pytest.mark.parametrize("method", ["kfac", "nullspace"])
def test_a_resumed_training_is_the_uninterrupted_one(
    method: str, tiny_folder: Path, base: Backbone, anchor: Path
) -> None:
    one, other = interrupted_and_whole(
        lambda: Foreign(tiny_folder), train, lambda model: make(model, method, anchor, base)
    )
    assert set(one.protected) == set(other.protected)


def test_a_truncated_vlm_is_protected_as_far_as_it_is_there(
    tiny_folder: Path, base: Backbone, anchor: Path, caplog: pytest.LogCaptureFixture
) -> None:
    model = Foreign(tiny_folder)
    del model.inner["vlm"].layers[-1]
    optimizer = make(model, "kfac", anchor, base)
    train(model, optimizer, range(1))
    assert not any(site.startswith("layers.1.") for site in optimizer.protected)
    assert any(site.startswith("layers.0.") for site in optimizer.protected)
    assert "not in the policy: layers.1." in caplog.text


@pytest.mark.parametrize(("weight", "strong"), [(1.6, True), (1.4, False)])
def test_a_pull_that_leaves_nothing_to_learn_at_the_rate_is_warned_of(
    weight: float,
    strong: bool,
    tiny_folder: Path,
    base: Backbone,
    anchor: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    make(Foreign(tiny_folder), "kfac", anchor, base, weight=weight)
    assert ("--optimizer.weight=0.045" in caplog.text) == strong  # 15 times the rate of 3e-3


def test_a_vlm_that_has_learned_before_is_refused_before_anything_moves(
    tiny_folder: Path, base: Backbone, anchor: Path
) -> None:
    model = Foreign(tiny_folder)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.mul_(1.01)
    optimizer = make(model, "kfac", anchor, base)
    before = values(model)
    gradients(model, 0)
    with pytest.raises(AegisError, match="none of the .* maps of the base model"):
        optimizer.step()
    assert all(torch.equal(before[name], p) for name, p in model.named_parameters())


def learned(module: nn.Module) -> None:
    """Moves a module's weights as training would, by about a tenth of their size."""
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for parameter in module.parameters():
            noise = torch.randn(parameter.shape, generator=generator)
            parameter.add_(noise, alpha=0.1 * float(parameter.std(correction=0) + 0.1))


def refused_at_the_first_step(model: nn.Module, optimizer: ProtectedAdamW, match: str) -> None:
    """Nothing has moved then."""
    before = values(model)
    gradients(model, 0)
    with pytest.raises(AegisError, match=match):
        optimizer.step()
    assert all(torch.equal(before[name], p) for name, p in model.named_parameters())


@pytest.mark.parametrize("part", ["layers", "layers.1", "stem", "layers.0.up"])
@pytest.mark.parametrize("method", ["kfac", "nullspace"])
def test_a_vlm_of_which_a_part_has_learned_is_refused(
    method: str, part: str, tiny_folder: Path, base: Backbone, anchor: Path
) -> None:
    """As after a training with the rest frozen: the moved part would be unprotected."""
    model = Foreign(tiny_folder)
    learned(model.inner["vlm"].get_submodule(part))
    optimizer = make(model, method, anchor, base)
    refused_at_the_first_step(model, optimizer, f"near {part}|with the values of layers.0.norm1")


@pytest.fixture(scope="module")
def trained_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A VLM whose normalisations have distinct values, and its anchor."""
    folder = tmp_path_factory.mktemp("trained")
    trained = make_tiny()
    for number, module in enumerate(trained.modules()):
        if isinstance(module, nn.LayerNorm):
            nn.init.normal_(module.weight, 1.0, 0.1 + number / 1000)
    trained.save(folder)
    measured(folder, folder / "anchor.safetensors")
    return folder


def made_of(folder: Path, model: nn.Module, method: str) -> ProtectedAdamW:
    return make(model, method, folder / "anchor.safetensors", backbones.load(str(folder)))


@pytest.mark.parametrize("method", ["kfac", "nullspace"])
@pytest.mark.parametrize("part", ["layers.0.norm1", "final_norm", "words", "text_position"])
def test_norms_and_tables_that_have_learned_are_refused(
    part: str, method: str, trained_folder: Path
) -> None:
    """This holds even if all maps are unchanged: nothing would protect the part that has moved."""
    model = Foreign(trained_folder)
    train(model, made_of(trained_folder, model, method), range(1))
    model = Foreign(trained_folder)
    with torch.no_grad():
        for parameter in model.inner["vlm"].get_submodule(part).parameters():
            parameter.mul_(1.01).add_(0.001)
    optimizer = made_of(trained_folder, model, method)
    refused_at_the_first_step(model, optimizer, f"near {part}")
    model.inner["vlm"].get_submodule(part).requires_grad_(False)
    optimizer = made_of(trained_folder, model, method)
    train(model, optimizer, range(1))  # they stay unchanged


def test_the_norms_of_missing_layers_are_not_looked_for(trained_folder: Path) -> None:
    """An expert's norms of the same size may be close to them."""
    model = Foreign(trained_folder)
    layer = model.inner["vlm"].layers[-1]
    del model.inner["vlm"].layers[-1]
    model.expert_norm = copy.deepcopy(layer.norm1)
    with torch.no_grad():
        model.expert_norm.weight.mul_(1.01)
    optimizer = made_of(trained_folder, model, "kfac")
    before = values(model)
    train(model, optimizer, range(1))
    assert not torch.equal(before["expert_norm.weight"], model.expert_norm.weight)


@pytest.mark.parametrize("method", ["kfac", "nullspace"])
def test_a_resized_table_is_refused_unless_it_is_frozen(method: str, trained_folder: Path) -> None:
    """As after resize_token_embeddings: no method can find its old rows in the larger table."""
    model = Foreign(trained_folder)
    vlm = model.inner["vlm"]
    larger = nn.Embedding(len(vlm.words.weight) + 5, vlm.words.weight.shape[1])
    with torch.no_grad():
        larger.weight[: len(vlm.words.weight)] = vlm.words.weight
    vlm.words = larger
    optimizer = made_of(trained_folder, model, method)
    refused_at_the_first_step(model, optimizer, "whose first rows are near words")
    larger.requires_grad_(False)
    model.zero_grad()
    before = larger.weight.clone()
    train(model, made_of(trained_folder, model, method), range(2))
    assert torch.equal(larger.weight, before)


def test_what_kfac_has_frozen_may_not_learn_again(
    tiny_folder: Path, base: Backbone, anchor: Path
) -> None:
    model = Foreign(tiny_folder)
    optimizer = make(model, "kfac", anchor, base)
    train(model, optimizer, range(1))
    model.requires_grad_(True)
    refused_at_the_first_step(model, optimizer, "13 parameters .* were frozen and learn again")


@pytest.mark.parametrize("method", ["kfac", "nullspace"])
def test_maps_that_learn_later_are_refused(method: str, trained_folder: Path) -> None:
    """Nothing would protect them: the method has started without them."""
    model = Foreign(trained_folder)
    layer = model.inner["vlm"].layers[1].requires_grad_(False)
    optimizer = made_of(trained_folder, model, method)
    train(model, optimizer, range(1))
    layer.up.requires_grad_(True)
    refused_at_the_first_step(model, optimizer, "learn again, first 'layers.1.up'")
    layer.up.requires_grad_(False)
    with pytest.raises(AegisError, match="added after the first step"):
        optimizer.add_param_group({"params": [nn.Parameter(torch.zeros(2))]})


def test_a_resumed_training_may_let_more_maps_learn(trained_folder: Path) -> None:
    model = Foreign(trained_folder)
    layer = model.inner["vlm"].layers[1].requires_grad_(False)
    optimizer = made_of(trained_folder, model, "nullspace")
    train(model, optimizer, range(1))
    layer.requires_grad_(True)
    further = made_of(trained_folder, model, "nullspace")
    further.load_state_dict(optimizer.state_dict())
    train(model, further, range(1, 3))
    assert {"layers.0.up", "layers.1.up"} <= set(further.protected)


@pytest.mark.parametrize("method", ["kfac", "nullspace"])
def test_what_is_missing_or_frozen_or_the_experts_own_is_no_vlm_that_has_learned(
    method: str, tiny_folder: Path, base: Backbone, anchor: Path
) -> None:
    """The optimizer lacks a tower, a frozen layer has learned, an expert has the same shapes."""
    model = Foreign(tiny_folder)
    vlm = model.inner["vlm"]
    learned(vlm.layers[1])
    vlm.layers[1].requires_grad_(False)
    model.expert = make_tiny(9).layers[1]
    stem = {id(p) for p in vlm.stem.parameters()}
    parameters = [p for p in model.parameters() if id(p) not in stem]
    protect = ("maps",)  # the expert's norms are as new as those of this untrained VLM
    optimizer = ProtectedAdamW(parameters, method, anchor, base, {"protect": protect}, **ADAMW)
    before = values(model)
    train(model, optimizer, range(2))
    assert optimizer.protected and all(s.startswith("layers.0.") for s in optimizer.protected)
    assert not torch.equal(before["expert.up.weight"], model.expert.up.weight)


@pytest.mark.parametrize("method", ["kfac", "nullspace"])
@pytest.mark.parametrize("half", ["weight", "bias"])
@pytest.mark.parametrize("given", [True, False])
def test_a_map_that_is_half_frozen_is_refused(
    given: bool, half: str, method: str, tiny_folder: Path, base: Backbone, anchor: Path
) -> None:
    """This holds whether or not the optimizer receives the frozen half."""
    model = Foreign(tiny_folder)
    frozen = getattr(model.inner["vlm"].layers[0].up, half)
    frozen.requires_grad_(False)
    parameters = [p for p in model.parameters() if given or p is not frozen]
    optimizer = ProtectedAdamW(parameters, method, anchor, base, {}, **ADAMW)
    refused_at_the_first_step(model, optimizer, "layers.0.up")


@pytest.mark.parametrize("method", ["kfac", "nullspace"])
@pytest.mark.parametrize("decays_apart", [False, True])
@pytest.mark.parametrize("part", ["weight", "bias"])
def test_a_training_resumes_where_a_half_of_a_map_never_had_a_gradient(
    part: str,
    decays_apart: bool,
    method: str,
    tiny_folder: Path,
    base: Backbone,
    anchor: Path,
) -> None:
    """It has no AdamW state, but the protection of the other half has moved it."""

    def teach(model: nn.Module, optimizer: torch.optim.Optimizer, steps: range) -> None:
        for seed in steps:
            gradients(model, seed)
            getattr(model.inner["vlm"].layers[0].up, part).grad = None
            model.inner["vlm"].layers[0].norm2.weight.grad = None
            optimizer.step()
            optimizer.zero_grad()

    def made(model: Foreign) -> ProtectedAdamW:
        groups = in_groups(model, decays_apart)
        return ProtectedAdamW(groups, method, anchor, base, {}, **ADAMW)

    one, other = interrupted_and_whole(lambda: Foreign(tiny_folder), teach, made)
    assert set(one.protected) == set(other.protected) and "layers.0.up" in one.protected


def test_weights_stay_where_a_method_cannot_start(
    tiny_folder: Path, base: Backbone, tmp_path: Path
) -> None:
    """It starts from the base model's weights, which those of a resumed training are not."""
    path = tmp_path / "anchor.safetensors"
    measure.run(
        str(tiny_folder), Anchor(samples=14, batch_size=14, parts=("inputs",), energy=0.5), path
    )
    model = Foreign(tiny_folder)
    optimizer = make(model, "nullspace", path, base, energy=0.3)
    train(model, optimizer, range(2))
    again = make(model, "nullspace", path, base, energy=0.999)
    again.load_state_dict(optimizer.state_dict())
    refused_at_the_first_step(model, again, "eigenvectors of a map's inputs")


def test_the_anchor_of_another_model_is_refused(tiny_folder: Path, anchor: Path) -> None:
    with pytest.raises(AegisError, match="was not measured on the base model's weights"):
        make(Foreign(tiny_folder), "kfac", anchor, make_tiny(7))


@pytest.mark.parametrize("method", ["kfac", "nullspace"])
def test_a_scaler_skips_the_step_of_an_overflow(
    method: str, tiny_folder: Path, base: Backbone, anchor: Path
) -> None:
    """The scaler calls a fused optimizer even so."""
    model = Foreign(tiny_folder)
    parameters = model.parameters()
    optimizer = ProtectedAdamW(parameters, method, anchor, base, {}, fused=True, **ADAMW)
    train(model, optimizer, range(3))
    before = values(model)
    scaler = torch.amp.GradScaler("cpu", init_scale=8.0)
    scaler.scale(torch.zeros(()))  # like a loss, which initializes it
    gradients(model, 5)
    model.after.weight.grad.mul_(torch.inf)
    scaler.step(optimizer)
    scaler.update()
    assert scaler.get_scale() == 4.0
    assert all(torch.equal(before[name], p) for name, p in model.named_parameters())
    gradients(model, 5)
    scaler.step(optimizer)
    for name in ("after.weight", "inner.vlm.layers.0.up.weight"):
        assert not torch.equal(before[name], model.get_parameter(name))


# --- half precision -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def half_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A VLM with weights representable in bfloat16, like one that was published in it."""
    folder = tmp_path_factory.mktemp("half")
    make_tiny().bfloat16().float().save(folder)
    return folder


@pytest.fixture(scope="module")
def half_base(half_folder: Path) -> Backbone:
    return backbones.load(str(half_folder))


@pytest.fixture(scope="module")
def half_anchor(half_folder: Path) -> Path:
    return measured(half_folder, half_folder / "anchor.safetensors")


def half(folder: Path) -> Foreign:
    """A policy with its VLM in bfloat16, but not its expert."""
    model = Foreign(folder)
    model.inner.to(torch.bfloat16)
    return model


def train_rounded(model: nn.Module, optimizer: torch.optim.Optimizer, steps: range) -> None:
    """Like `train`, with gradients representable in bfloat16."""
    for seed in steps:
        gradients(model, seed)
        for parameter in model.parameters():
            if parameter.grad is not None:
                parameter.grad.copy_(parameter.grad.bfloat16())
        optimizer.step()
        optimizer.zero_grad()


@pytest.mark.parametrize("wide", [True, False])
@pytest.mark.parametrize("method", ["kfac", "nullspace"])
def test_a_vlm_that_the_program_has_rounded_is_known_as_the_bases(
    method: str, wide: bool, trained_folder: Path
) -> None:
    """Its base is stored in float32, and LeRobot loads it in bfloat16."""
    model = Foreign(trained_folder)
    whole = made_of(trained_folder, model, method)
    train(model, whole, range(1))
    model = Foreign(trained_folder)
    model.inner.to(torch.bfloat16)
    if wide:
        model.inner.float()
    optimizer = made_of(trained_folder, model, method)
    still = {name for name, p in model.named_parameters() if not p.requires_grad}
    before = values(model)
    train(model, optimizer, range(3))
    assert optimizer.protected == whole.protected and len(optimizer.protected) > 10
    assert all(torch.equal(before[name], model.get_parameter(name)) for name in still)
    assert bool(still) == (method == "kfac")
    assert not torch.equal(
        before["inner.vlm.layers.0.up.weight"], model.inner.vlm.layers[0].up.weight
    )


@pytest.mark.parametrize("method", ["kfac", "nullspace"])
def test_half_precise_weights_are_the_rounded_ones_of_a_float32_training(
    method: str, half_folder: Path, half_base: Backbone, half_anchor: Path
) -> None:
    """The step is that of float32 weights, bit for bit; the parameters are their rounded values."""
    narrow, wide = half(half_folder), Foreign(half_folder)
    optimizer = make(narrow, method, half_anchor, half_base)
    train_rounded(narrow, optimizer, range(4))
    train_rounded(wide, make(wide, method, half_anchor, half_base), range(4))
    assert optimizer.protected
    protected = {id(p) for p, state in optimizer.state.items() if "aegis_master" in state}
    assert protected
    for mine, other in zip(narrow.parameters(), wide.parameters(), strict=True):
        if id(mine) in protected:
            assert mine.dtype == torch.bfloat16 and torch.equal(mine, other.bfloat16())
            assert torch.equal(optimizer.state[mine]["aegis_master"], other)


@pytest.mark.parametrize("method", ["kfac", "nullspace"])
def test_a_resumed_training_has_its_masters(
    method: str, half_folder: Path, half_base: Backbone, half_anchor: Path
) -> None:
    def made(model: Foreign) -> ProtectedAdamW:
        return make(model, method, half_anchor, half_base)

    one, other = interrupted_and_whole(lambda: half(half_folder), train_rounded, made)
    states = [list(optimizer.state.values()) for optimizer in (one, other)]
    for mine, whole in zip(*states, strict=True):
        assert mine.keys() == whole.keys()
        for name, value in whole.items():
            kept = mine[name]
            assert value.dtype == kept.dtype and torch.equal(value, kept), name


def test_steps_that_rounding_would_lose_move_half_precise_weights(
    half_folder: Path, half_base: Backbone, half_anchor: Path
) -> None:
    model = half(half_folder)
    weight = model.inner["vlm"].layers[0].up.weight
    before = weight.detach().clone()
    options = {"weight": 1e-9, "balance": 0.0}
    optimizer = ProtectedAdamW(
        model.parameters(), "kfac", half_anchor, half_base, options, lr=1e-5, weight_decay=0.0
    )
    for _ in range(60):
        weight.grad = torch.ones_like(weight)
        optimizer.step()
    # Each step is 1e-5, and for most weights the next bfloat16 is more than twice that away.
    assert (weight != before).float().mean() > 0.5
    moved = optimizer.state[weight]["aegis_master"] - before.float()
    torch.testing.assert_close(moved, torch.full_like(moved, -60e-5), rtol=1e-2, atol=0.0)


def test_weights_that_somebody_has_changed_begin_anew(
    half_folder: Path, half_base: Backbone, half_anchor: Path
) -> None:
    model = half(half_folder)
    optimizer = make(model, "nullspace", half_anchor, half_base, energy=0.0)
    train_rounded(model, optimizer, range(1))
    weight = model.inner["vlm"].layers[0].up.weight
    with torch.no_grad():
        weight.zero_()
    weight.grad = torch.ones_like(weight)
    optimizer.step()
    assert 0 < weight.abs().max() < 2 * ADAMW["lr"]


def test_a_closure_sees_the_programs_own_weights(
    half_folder: Path, half_base: Backbone, half_anchor: Path
) -> None:
    model = half(half_folder)
    optimizer = make(model, "nullspace", half_anchor, half_base)
    weight = model.inner["vlm"].layers[0].up.weight

    def closure() -> float:
        assert weight.dtype == torch.bfloat16 and torch.is_grad_enabled()
        gradients(model, 0)
        return 0.5

    before = weight.detach().clone()
    assert optimizer.step(closure) == 0.5 and not torch.equal(weight, before)


def test_unknown_options_are_refused(tiny_folder: Path, base: Backbone, anchor: Path) -> None:
    with pytest.raises(AegisError, match="wieght"):
        make(Foreign(tiny_folder), "kfac", anchor, base, wieght=1.0)
