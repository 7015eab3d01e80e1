"""`train.freeze`: what it names stays frozen under every method, and costs nothing."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from samples.command import refused
from samples.merges import QUESTIONS, SAMPLES, Place, parameters
from samples.small_run import recipe as small
from samples.small_run import write
from samples.tiny import make_tiny
from samples.training import (
    double_policy,
    gradients,
    make_anchor,
    options_of,
    policy_over,
    robot_batch,
    same_bits,
)
from samples.training_runs import SETTINGS, Start, assert_resumes, metrics
from torch import nn

from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, Warned
from aegis_cli.core.ledger import conflict_share
from aegis_cli.methods import METHODS
from aegis_cli.methods.base import MethodContext
from aegis_cli.models import backbones
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.models.backbones.hf import HFBackbone
from aegis_cli.models.policy import Policy
from aegis_cli.recipes import Aegis, Nullspace, Recipe
from aegis_cli.training import dry_run, freezing, train

Loaded = Callable[[str], HFBackbone]  # by a family's name
Made = Callable[[str], Path]
PARTS = ("stem", "words", "layers.0")  # of the tiny VLM
MOVES = "layers.1.qkv.weight"  # under every method that trains the backbone


def heard() -> tuple[list[str], Callable[[Event], None]]:
    """The texts of warnings, and the listener that collects them."""
    texts: list[str] = []

    def listen(event: Event) -> None:
        if isinstance(event, Warned):
            texts.append(event.text)

    return texts, listen


def frozen(backbone: Backbone, freeze: str | Sequence[str], method: str = "naive") -> list[str]:
    """Freeze parts of a backbone under a method; returns the names of what is frozen."""
    chosen = METHODS[method]
    freezing.adapt(chosen, backbone, options_of(chosen), freeze, heard()[1])
    return [name for name, p in backbone.named_parameters() if not p.requires_grad]


def below(backbone: Backbone, *parts: str) -> list[str]:
    """Names of the parameters in parts of a backbone."""
    starts = tuple(f"{part}." for part in parts)
    return [name for name, _ in backbone.named_parameters() if f"{name}.".startswith(starts)]


def changed(recipe: Recipe, **settings: Any) -> Recipe:
    return replace(recipe, train=replace(recipe.train, **settings))


# --- a run from first step to last ----------------------------------------------------------------


@pytest.fixture(scope="session", params=sorted(METHODS))
def frozen_run(
    request: pytest.FixtureRequest,
    start: Start,
    recipe: Recipe,
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[str, Path]:
    """A method and a run of it with parts of the backbone frozen."""
    out = tmp_path_factory.mktemp("frozen") / request.param
    start(request.param, out, recipe=changed(recipe, freeze=PARTS))
    return request.param, out


def test_what_is_frozen_stays_bit_for_bit_and_the_rest_learns(
    frozen_run: tuple[str, Path], tiny_folder: Path
) -> None:
    method, out = frozen_run
    before, after = (dict(backbones.load(str(at)).named_parameters()) for at in (tiny_folder, out))
    held = below(make_tiny(), *PARTS)
    assert len(held) > 20 and all(same_bits(before[name], after[name]) for name in held)
    assert same_bits(before[MOVES], after[MOVES]) == (method == "stop-gradient")


def test_a_ledger_has_the_groups_that_learn_and_every_layer(
    frozen_run: tuple[str, Path],
) -> None:
    method, out = frozen_run
    if not METHODS[method].compares_layers:
        return
    kept = artifacts.load(out / "ledger.safetensors", "ledger")
    assert kept.header.meta["groups"] == ["layers.1", "embeddings", "final_norm"]
    assert kept.header.meta["layers"] == ["layers.0", "layers.1"]
    assert (kept.tensors["aa"][:, 0] > 0).all() and (kept.tensors["w2"] > 0).all()
    assert metrics(out)[-1]["conflict"] == conflict_share(
        {name: values[-1:] for name, values in kept.tensors.items()}
    )


@pytest.mark.parametrize("method", ["aegis", "kfac", "lora", "nullspace"])
def test_a_resumed_run_ends_in_the_same_bytes(
    method: str, start: Start, recipe: Recipe, tmp_path: Path
) -> None:
    averaged = changed(recipe, freeze=PARTS, ema_decay=0.6)
    assert_resumes(start, method, averaged, tmp_path)
    after, before = parameters(tmp_path / "whole"), parameters(recipe.backbone)
    assert all(same_bits(after[name], before[name]) for name in below(make_tiny(), *PARTS))
    assert not same_bits(after[MOVES], before[MOVES])


def test_a_run_does_not_go_on_with_other_parts_frozen(
    start: Start, recipe: Recipe, tmp_path: Path
) -> None:
    start("naive", tmp_path, recipe=changed(recipe, freeze="stem", steps=2))
    for other in (None, ("stem", "words")):
        with pytest.raises(AegisError, match=r"train\.freeze"):
            start("naive", tmp_path, recipe=changed(recipe, freeze=other, steps=2), resume=True)


def test_updates_are_projected_where_everything_is_optional(
    start: Start, recipe: Recipe, tmp_path: Path, tiny_folder: Path
) -> None:
    """AEGIS on the applied update, with anchor gradients shared, from part of the batch."""
    options = Aegis(projects="both", restoration=0.1, refresh=2, fraction=0.5)
    chosen = replace(changed(recipe, freeze=PARTS), aegis=options)
    start("aegis", tmp_path, recipe=chosen)
    before, after = parameters(tiny_folder), parameters(tmp_path)
    assert all(same_bits(before[name], after[name]) for name in below(make_tiny(), *PARTS))
    assert not same_bits(before[MOVES], after[MOVES])


# --- gradients ------------------------------------------------------------------------------------


def _with_frozen(method: str, freeze: str | Sequence[str]) -> Policy:
    policy, chosen = double_policy(), METHODS[method]
    backbone, options = policy.backbone, options_of(chosen)
    freezing.adapt(chosen, backbone, options, freeze, heard()[1])
    groups = backbone.learning_groups()
    policy.parts = chosen.start(  # type: ignore[assignment]
        MethodContext(
            backbone, groups, {}, options, make_anchor(), None, (), policy.targets_on_cpu(), 2
        )
    )
    return policy


@pytest.mark.parametrize("method", ["naive", "aegis", "distill", "maps"])
@pytest.mark.parametrize("part", ["stem", "layers.0", "layers.1"])
def test_the_rest_gets_the_gradient_that_it_gets_beside_what_learns(method: str, part: str) -> None:
    """A frozen layer's activations count as before in the loss and in the transport cost."""
    whole, less = _with_frozen(method, ()), _with_frozen(method, part)
    row, same = gradients(whole, METHODS[method]).row, gradients(less, METHODS[method]).row
    wanted = dict(whole.named_parameters())
    for name, parameter in less.named_parameters():
        if not parameter.requires_grad or wanted[name].grad is None:
            assert parameter.grad is None
        else:
            torch.testing.assert_close(parameter.grad, wanted[name].grad)
    assert (row is None) == (same is None) == (method != "aegis")
    if row is not None and same is not None:
        learn = [name != part for name in whole.backbone.parameter_groups()]
        for column in ("tt", "ta", "aa"):
            torch.testing.assert_close(getattr(row, column)[learn], getattr(same, column))
        torch.testing.assert_close(row.w2, same.w2)


@pytest.mark.parametrize("checkpointing", [False, True])
@pytest.mark.parametrize("family", ["smolvlm", "paligemma"])
def test_no_graph_is_kept_of_a_frozen_tower(
    family: str, checkpointing: bool, hf_backbone: Loaded
) -> None:
    policy = policy_over(hf_backbone(family))
    backbone = policy.backbone
    frozen(backbone, "vision")
    if checkpointing:
        backbone.checkpoint_gradients()
    with_graph: set[str] = set()

    def note(name: str) -> Callable[..., None]:
        def hook(_: nn.Module, __: Any, output: Any) -> None:
            leaving = output if isinstance(output, tuple) else (output,)
            if any(isinstance(t, torch.Tensor) and t.requires_grad for t in leaving):
                with_graph.add(name)

        return hook

    for name, module in backbone.named_modules():
        module.register_forward_hook(note(name))
    batch = robot_batch(2)
    encoding = policy.train().encode(batch.images, batch.instructions)
    seen = {name for name in with_graph if backbone.in_vision(name) and name.count(".") > 1}
    assert not seen
    assert all(pair.key.requires_grad for pair in encoding.keys_values)
    policy.flow_loss(batch, encoding, 2, torch.Generator().manual_seed(0)).backward()
    learns = backbone.language_maps().values()
    assert sum(linear.weight.grad is not None for linear in learns) > len(learns) // 2
    assert not any(p.grad is not None for p in backbone.parameters() if not p.requires_grad)


# --- names ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("family", "freeze", "parts"),
    [
        ("smolvlm", "vision", ("model.vision_model", "model.connector")),
        ("smolvlm", "model.vision_model", ("model.vision_model",)),
        ("smolvlm", ("embeddings", "head"), ("model.text_model.embed_tokens", "lm_head")),
        ("smolvlm", "layers.0", ("model.text_model.layers.0",)),
        ("smolvlm", "model.text_model.layers.0-1", ("model.text_model.layers",)),
        ("smolvlm", "*.layers.1.*.q_proj", ("model.text_model.layers.1.self_attn.q_proj",)),
        ("paligemma", "vision", ("model.vision_tower", "model.multi_modal_projector")),
        ("paligemma", "model.language_model.layers.0.mlp", ("model.language_model.layers.0.mlp",)),
    ],
)
def test_names_are_those_of_groups_and_those_of_the_model(
    family: str, freeze: str | Sequence[str], parts: Sequence[str], hf_backbone: Loaded
) -> None:
    backbone = hf_backbone(family)
    found, wanted = frozen(backbone, freeze), below(backbone, *(f"vlm.{part}" for part in parts))
    if "*" in freeze:
        wanted += [name for name in found if ".vision_" in name and ".layers.1." in name]
    assert sorted(found) == sorted(wanted) and found


def test_a_pattern_may_name_parameters() -> None:
    assert frozen(make_tiny(), "*.bias") == [
        name for name, _ in make_tiny().named_parameters() if name.endswith(".bias")
    ]


@pytest.mark.parametrize(
    ("freeze", "found", "fix"),
    [
        ("vision_model", "'vision_model', but no part", "did you mean 'model.vision_model'?"),
        ("vlm.model.vision_model", "but no part", "did you mean 'model.vision_model'?"),
        ("visoin", "'visoin', but no part", "did you mean 'vision'?"),
        ("layers.0-7", r"'layers.7' (of layers.0-7), but no part", "let the range end"),
        ("zzz*", "'zzz*', but no part", "--set train.freeze=vision"),
        (("vision", "nothing.at.all"), "'nothing.at.all', but no part", "--set train.freeze="),
    ],
)
def test_a_name_that_no_part_has_is_refused_with_those_that_there_are(
    freeze: str | Sequence[str], found: str, fix: str, hf_backbone: Loaded
) -> None:
    with pytest.raises(AegisError) as caught:
        frozen(hf_backbone("smolvlm"), freeze)
    assert found in caught.value.found and fix in caught.value.fix
    for name in ("vision, embeddings, final_norm, head", "layers.0 to layers.1", "model.connector"):
        assert name in caught.value.expected


def test_a_wrong_name_ends_a_command_before_anything_is_written(
    aegis: Callable[..., tuple[int, str, str]], demos_file: Path, tmp_path: Path
) -> None:
    written = write(tmp_path, "embedded", freeze="vision")
    words = ("train", written, "--method", "naive", "--demos", demos_file)
    for more in ((), ("--dry-run",)):
        said = refused(aegis(*words, "--out", tmp_path / "run", *more))
        assert "train.freeze: 'vision'" in said and "--set train.freeze=stem" in said
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("method", "freeze"),
    [
        ("naive", "*"),
        ("naive", ("stem", "embeddings", "layers.0-1")),
        ("lora", "layers.0-1"),
        ("kfac", ("stem", "layers.*")),
        ("cotrain", ("stem", "words", "text_position", "layers.0-1")),
    ],
)
def test_something_that_the_expert_reads_has_to_learn(
    method: str, freeze: str | Sequence[str]
) -> None:
    with pytest.raises(AegisError, match="nothing of the backbone is left to learn") as caught:
        frozen(make_tiny(), freeze, method)
    assert "--method stop-gradient" in caught.value.fix and method in caught.value.found


@pytest.mark.parametrize(
    ("method", "freeze"), [("stop-gradient", "*"), ("lora", "stem"), ("kfac", "words")]
)
def test_where_nothing_of_it_would_learn_that_is_said(method: str, freeze: str) -> None:
    texts, listen = heard()
    chosen, backbone, same = METHODS[method], make_tiny(), make_tiny()
    freezing.adapt(chosen, backbone, options_of(chosen), freeze, listen)
    chosen.adapt(same, same.language_maps(), options_of(chosen))
    assert texts == [
        f"train.freeze: {freeze} changes nothing: method '{method}' trains none of it anyway"
    ]
    learns = [[p.requires_grad for p in model.parameters()] for model in (backbone, same)]
    assert learns[0] == learns[1]


def test_a_tied_weight_is_frozen_under_all_its_names_and_that_is_said(
    hf_backbone: Loaded,
) -> None:
    chosen, table, head = METHODS["naive"], "model.language_model.embed_tokens", "lm_head"
    for freeze, other in ((table, head), (head, table), ("embeddings", head)):
        texts, listen = heard()
        backbone = hf_backbone("paligemma")
        assert backbone.tied_heads
        freezing.adapt(chosen, backbone, {}, freeze, listen)
        (text,) = texts
        assert f"freezes {other}.weight too, the same weight as" in text
    texts, listen = heard()
    freezing.adapt(chosen, hf_backbone("paligemma"), {}, (table, head), listen)
    assert not texts


@pytest.mark.parametrize("method", ["nullspace", "kfac"])
def test_half_a_map_is_not_frozen_where_maps_are_constrained(
    method: str, start: Start, recipe: Recipe, tmp_path: Path
) -> None:
    half = changed(recipe, freeze="layers.0.qkv.bias")
    with pytest.raises(AegisError, match=r"layers.0.qkv, a Linear, .* only the bias is frozen"):
        start(method, tmp_path / "run", recipe=half)
    assert not (tmp_path / "run").exists()


def test_options_that_leave_nothing_to_hold_are_refused(
    start: Start, recipe: Recipe, tmp_path: Path
) -> None:
    stem = replace(changed(recipe, freeze="stem"), nullspace=Nullspace(protect=("stem",)))
    with pytest.raises(AegisError, match="nothing that learns is of the kinds stem"):
        start("nullspace", tmp_path / "run", recipe=stem)
    layers = replace(changed(recipe, freeze="layers.*"), aegis=Aegis(groups="language"))
    with pytest.raises(AegisError, match="aegis.groups: language with no language layer"):
        start("aegis", tmp_path / "run", recipe=layers)


# --- what goes with it ----------------------------------------------------------------------------


def test_low_rank_terms_are_beside_maps_that_may_change() -> None:
    backbone = make_tiny()
    frozen(backbone, ("layers.0", "layers.1.down"), "lora")
    added = {name.rpartition(".")[0] for name, p in backbone.named_parameters() if p.requires_grad}
    assert added == {"layers.1.qkv", "layers.1.out", "layers.1.up"}


def test_running_averages_of_what_is_frozen_stand_still() -> None:
    backbone = make_tiny()
    backbone.stem.norm, backbone.late = nn.BatchNorm1d(4), nn.BatchNorm1d(4)
    backbone.parameter_groups = lambda: {  # type: ignore[method-assign]
        "stem": list(backbone.stem.parameters()),
        "layers.0": list(backbone.late.parameters()),
    }
    frozen(backbone, "stem")
    backbone.train()
    assert backbone.late.training and backbone.stem.training and not backbone.stem.norm.training
    backbone.eval()
    assert not backbone.late.training


def test_masters_are_of_what_learns_and_the_rest_is_rounded_once(
    hf_folder: Made, demos_file: Path, tmp_path: Path
) -> None:
    settings = small(hf_folder("smolvlm"), weights="bf16-master", freeze="vision", steps=2)
    train.run(settings, "naive", demos_file, None, tmp_path)
    before, after = parameters(hf_folder("smolvlm")), parameters(tmp_path)
    held = [name for name in before if "vision_model" in name or "connector" in name]
    assert held and all(same_bits(after[n], before[n].bfloat16().float()) for n in held)
    moved = [name for name in before if not same_bits(after[name], before[name].bfloat16().float())]
    assert any("text_model.layers.0" in name for name in moved)


def test_a_dry_run_counts_no_gradient_of_what_is_frozen(
    hf_folder: Made, hf_anchor: Made, demos_file: Path, tmp_path: Path
) -> None:
    plain = small(hf_folder("smolvlm"), ema_decay=0.9)
    held = changed(plain, freeze="vision")
    for method in ("naive", "aegis", "nullspace", "l2sp"):
        whole, less = (
            dry_run.run(each, method, demos_file, hf_anchor("smolvlm"), tmp_path / "out")
            for each in (plain, held)
        )
        still = whole.groups["vision"]
        assert whole.groups == less.groups and whole.trainable - less.trainable == still
        for part in ("gradients", "optimizer", "average"):
            assert less.memory_mb[part] == pytest.approx(
                whole.memory_mb[part] * less.trainable / whole.trainable
            )
        assert less.memory_mb["weights"] == whole.memory_mb["weights"]
        assert less.memory_mb["activations"] < 0.95 * whole.memory_mb["activations"]
        for part in ("anchor gradient", "weights before the step"):
            saved = whole.memory_mb[part] - less.memory_mb[part]
            assert saved == pytest.approx(4e-6 * still if whole.memory_mb[part] else 0)
        if method in ("nullspace", "l2sp"):
            assert less.memory_mb["method"] < whole.memory_mb["method"]
        assert less.disk_mb < whole.disk_mb


def test_distill_copies_what_learns_alone(
    hf_folder: Made, demos_file: Path, tmp_path: Path
) -> None:
    plain = small(hf_folder("smolvlm"))
    whole, less = (
        dry_run.run(recipe, "distill", demos_file, None, tmp_path / "out")
        for recipe in (plain, changed(plain, freeze="vision"))
    )
    saved = whole.memory_mb["method"] - less.memory_mb["method"]
    assert saved == pytest.approx(4e-6 * whole.groups["vision"])
    assert less.memory_mb["method"] > 0


def test_what_distill_shares_with_its_teacher_is_what_it_would_have_copied() -> None:
    found = []
    for shares in (False, True):
        policy, chosen = double_policy(), METHODS["distill"]
        backbone = policy.backbone
        freezing.adapt(chosen, backbone, options_of(chosen), ("stem", "layers.0"), heard()[1])
        if not shares:
            backbone.requires_grad_(True)  # so that everything is copied
        policy.parts = chosen.start(  # type: ignore[assignment]
            MethodContext(backbone, backbone.learning_groups(), {}, options_of(chosen))
        )
        freezing.adapt(chosen, backbone, options_of(chosen), ("stem", "layers.0"), heard()[1])
        with torch.no_grad():
            backbone.layers[1].up.weight.mul_(1.5)
        gradients(policy, chosen)
        found.append(dict(policy.named_parameters()))
    for name, parameter in found[0].items():
        same = found[1][name]
        assert parameter.requires_grad == same.requires_grad
        assert same_bits(parameter, same) and same_bits(parameter.grad, same.grad), name


@pytest.mark.parametrize("method", ["linear", "kfac-shrink", "factors"])
def test_a_merge_leaves_what_was_frozen_where_it_is(
    method: str, merge_place: Place, aegis: Callable[..., Any], tmp_path: Path
) -> None:
    steps = {"steps": 4, "backbone_lr": 1e-2, "checkpoint_every": 4}
    run, out = tmp_path / "run", tmp_path / "merged"
    trained = small(merge_place.base, freeze=PARTS, **steps)
    train.run(trained, "naive", merge_place.demos, None, run)
    words = ("--method", method, "--strength", 0.5, "--demos", merge_place.demos)
    sizes = ("--samples", SAMPLES, "--frames", 40, "--questions", QUESTIONS)
    code, _, err = aegis("merge", run, *words, *sizes, "--out", out)
    assert code == 0, err
    origin, tuned, merged = (parameters(at) for at in (merge_place.base, run, out))
    for name in below(make_tiny(), *PARTS):
        assert same_bits(origin[name], tuned[name]) and same_bits(origin[name], merged[name])
    assert not same_bits(merged[MOVES], tuned[MOVES])
    assert not same_bits(merged[MOVES], origin[MOVES])


def test_the_defaults_freeze_nothing() -> None:
    assert SETTINGS.freeze is None
    assert frozen(make_tiny(), ()) == []
    assert dataclasses.replace(SETTINGS, freeze="stem") != SETTINGS
