"""Training on Hugging Face backbones: dual backward, checkpointing, bf16 weights, export."""

from __future__ import annotations

import dataclasses
import functools
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import transformers
from samples.backbones import TEXTS, encode, images
from samples.disk import disk
from samples.hf import load_processor
from samples.small_run import recipe as small
from samples.training import (
    INSTRUCTIONS,
    make_moments,
    of_all_tokens,
    options_of,
    policy_over,
    robot_batch,
    same_bits,
    snapshot_gradients,
)
from samples.training_runs import TIMES, assert_same_run, metrics, protected_shares
from torch import Tensor

from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.moments import masked_moments
from aegis_cli.core.projection import inner
from aegis_cli.methods import METHODS
from aegis_cli.methods.base import MethodContext, Pass
from aegis_cli.models import backbones
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.models.backbones.families import FAMILIES
from aegis_cli.models.backbones.hf import HFBackbone
from aegis_cli.models.expert import ActionExpert
from aegis_cli.models.policy import Policy
from aegis_cli.training import assemble, checkpoint, step, train

Made, Loaded = Callable[[str], Path], Callable[[str], Backbone]  # by a family's name


def gradients(
    policy: Policy,
    method: str = "aegis",
    precision: str = "float32",
    seed: int = 0,
    far: float = 1.0,
) -> step.StepGradients:
    """One step's gradients, from the dual backward if the method has one.

    The seed determines anchor and noise, and `far` scales the anchor's means.
    """
    backbone = policy.backbone
    image, text = (
        [
            dataclasses.replace(moments, mean=far * moments.mean)
            for moments in make_moments(backbone.depth, backbone.width, seed=own)
        ]
        for own in (seed, seed + 1)
    )
    measured = Anchor(image, text)
    chosen, options = METHODS[method], options_of(METHODS[method])
    chosen.adapt(backbone, backbone.language_maps(), options)
    context = MethodContext(
        backbone,
        backbone.parameter_groups(),
        {},
        options,
        measured,
        instructions=INSTRUCTIONS,
        targets=policy.targets,
        actions=len(policy.action_scale.mean),
    )
    parts = chosen.start(context)
    policy.train()
    generator = torch.Generator().manual_seed(seed)
    return step.compute_gradients(
        policy,
        METHODS[method],
        parts,
        robot_batch(3),
        generator,
        index=0,
        flow_samples=2,
        precision=precision,
    )


# These differ in the inputs of their layers: masks, windows and rotations.
# smolvlm's gradients are those of `test_a_run_with_compiled_layers_trains_alike`.
COMPILED = ("paligemma", "qwen2_5_vl", "gemma3")
# While tracing a graph, torch.compile accesses a field for which PyTorch warns.
tracing = pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")

# --- gradients ------------------------------------------------------------------------------------


@pytest.mark.parametrize("family", FAMILIES)
def test_checkpointing_gives_the_same_gradients_of_both_backwards(
    family: str, hf_backbone: Loaded
) -> None:
    """And each layer is computed again in each of them; otherwise nothing would be checkpointed."""
    found, runs = [], []
    for again in (False, True):
        policy = policy_over(hf_backbone(family))
        calls = [0]
        policy.backbone._layers[0].mlp.register_forward_pre_hook(
            lambda *_, calls=calls: calls.__setitem__(0, calls[0] + 1)
        )
        if again:
            policy.backbone.checkpoint_gradients()
        result = gradients(policy)
        assert result.row is not None
        found.append((snapshot_gradients(policy), vars(result.row)))
        runs.append(calls[0])
    (plain, row), (checkpointed, same_row) = found
    assert runs == [1, 3]
    assert any(g is not None and g.any() for name, g in plain.items() if ".layers.0." in name)
    for name, wanted in plain.items():
        assert (wanted is None) == (checkpointed[name] is None), name
        if wanted is not None:
            torch.testing.assert_close(checkpointed[name], wanted, rtol=1e-5, atol=1e-7, msg=name)
    for name in row:
        torch.testing.assert_close(same_row[name], row[name])


@pytest.mark.parametrize("family", ["paligemma", "smolvlm"])
def test_an_expert_that_recomputes_keeps_less_and_gives_the_same_gradients(
    family: str, hf_backbone: Loaded
) -> None:
    found, kept = [], []
    for again in (False, True):
        policy = policy_over(hf_backbone(family))
        policy.expert.recomputes = again
        own = [0]

        def keep(tensor: Tensor, own: list[int] = own) -> Tensor:
            own[0] += tensor.numel()
            return tensor

        with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
            gradients(policy)
        found.append(snapshot_gradients(policy))
        kept.append(own[0])
    plain, recomputed = found
    assert kept[1] < kept[0] and plain.keys() == recomputed.keys()
    for name, wanted in plain.items():
        assert (wanted is None) == (recomputed[name] is None), name
        if wanted is not None:
            torch.testing.assert_close(recomputed[name], wanted, rtol=0, atol=0, msg=name)


@tracing
@pytest.mark.parametrize("family", COMPILED)
def test_compiled_layers_give_the_same_gradients_of_both_backwards(
    family: str, hf_backbone: Loaded
) -> None:
    """And none where there was none. A backend without code generation keeps this test quick."""
    found = []
    for compiled in (False, True):
        policy = policy_over(hf_backbone(family))
        if compiled:
            policy.backbone.compile_passes("aot_eager")
        result = gradients(policy)
        assert result.row is not None
        found.append((snapshot_gradients(policy), vars(result.row)))
    (plain, row), (same, same_row) = found
    largest = max(g.abs().max() for g in plain.values() if g is not None).item()
    for name, wanted in plain.items():
        assert (wanted is None) == (same[name] is None), name
        if wanted is not None:
            torch.testing.assert_close(same[name], wanted, rtol=1e-4, atol=1e-6 * largest, msg=name)
    for name in row:
        torch.testing.assert_close(same_row[name], row[name], rtol=1e-4, atol=1e-6)


def test_all_layers_and_lengths_share_what_is_compiled_once(hf_backbone: Loaded) -> None:
    made: list[object] = []

    def counting(graph: torch.fx.GraphModule, _: object) -> Any:
        made.append(graph)
        return graph.forward

    torch.compiler.reset()
    backbone, plain = hf_backbone("paligemma"), hf_backbone("paligemma")
    backbone.compile_passes(counting)
    for texts in (TEXTS[:2], TEXTS[2:4]):
        passed, wanted = (encode(each, images(2), texts) for each in (backbone, plain))
        length = wanted.mask.shape[1]
        assert length < passed.mask.shape[1] == 32
        assert passed.mask.sum() == wanted.mask.sum()
        for one, other in zip(passed.hidden, wanted.hidden, strict=True):
            torch.testing.assert_close(one[:, :length], other, rtol=1e-4, atol=1e-5)
        for one, other in zip(passed.keys_values, wanted.keys_values, strict=True):
            torch.testing.assert_close(one.key[:, :, :length], other.key, rtol=1e-4, atol=1e-5)
    assert len(made) == 2  # one for the language layers, one for the vision tower's


@pytest.mark.parametrize("family", ["paligemma", "smolvlm"])
def test_compiled_layers_find_the_same_answers(family: str, hf_backbone: Loaded) -> None:
    backbone, plain = hf_backbone(family), hf_backbone(family)
    backbone.compile_passes("eager")
    asked = images(3), TEXTS[:3], ["red", "two", "yes"]
    with torch.no_grad():
        likely, wanted = (each.answer_log_likelihood(*asked) for each in (backbone, plain))
    torch.testing.assert_close(likely, wanted, rtol=1e-4, atol=1e-4)
    assert backbone.answer(*asked[:2]) == plain.answer(*asked[:2])


@tracing
def test_a_run_with_compiled_layers_trains_alike(
    hf_folder: Made, demos_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Validation has one batch, of the usual size: another size would be compiled again."""
    monkeypatch.setattr(train, "VALIDATION_FRAMES", 4)
    for owner, name in ((HFBackbone, "compile_passes"), (ActionExpert, "compile_layers")):
        quick = functools.partialmethod(getattr(owner, name), "aot_eager")
        monkeypatch.setattr(owner, name, quick)
    lines = []
    for compiled in (False, True):
        out = tmp_path / str(compiled)
        recipe = small(hf_folder("smolvlm"), steps=2, compile=compiled, weight_decay=0.1)
        train.run(recipe, "naive", demos_file, None, out)
        lines.append(metrics(out, TIMES))
    for one, other in zip(*lines, strict=True):
        assert one == pytest.approx(other, rel=1e-4)
    weights = [backbones.load(str(tmp_path / name)).state_dict() for name in ("True", "False")]
    for name, wanted in weights[1].items():
        torch.testing.assert_close(weights[0][name], wanted, rtol=1e-3, atol=1e-4, msg=name)


def test_attention_has_no_dense_mask_where_it_needs_none(
    hf_backbone: Loaded, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a GPU, PyTorch uses flash kernels for such calls."""
    attend, dense = torch.nn.functional.scaled_dot_product_attention, []

    def noting(*args: Any, **named: Any) -> torch.Tensor:
        dense.append(named.get("attn_mask") is not None)
        return attend(*args, **named)

    monkeypatch.setattr(torch.nn.functional, "scaled_dot_product_attention", noting)
    for texts, some in (([TEXTS[0]] * 3, False), (TEXTS[:3], True)):
        dense.clear()
        encode(hf_backbone("smolvlm"), images(3), texts)
        assert dense and any(dense) == some


@pytest.mark.parametrize("family", FAMILIES)
def test_insulation_teaches_actions_as_integers_and_leaves_the_expert_to_itself(
    family: str, hf_backbone: Loaded
) -> None:
    found = {}
    for method in ("insulate", "stop-gradient"):
        policy = policy_over(hf_backbone(family))
        gradients(policy, method)
        found[method] = snapshot_gradients(policy)
    for name, gradient in found["insulate"].items():
        if name.startswith("expert."):
            assert same_bits(gradient, found["stop-gradient"][name]), name
    learned = [n for n, g in found["insulate"].items() if g is not None and g.any()]
    assert any(".layers.0." in name for name in learned)


@pytest.mark.parametrize("family", FAMILIES)
def test_the_projected_gradient_of_each_group_is_orthogonal_to_the_anchors(
    family: str, hf_backbone: Loaded
) -> None:
    policy = policy_over(hf_backbone(family))
    # The first random anchor and noise that are in conflict anywhere will do. Far from what the
    # model does, anchors pull into directions of their own.
    for seed in range(20):
        policy.zero_grad()
        result = gradients(policy, seed=seed, far=10.0)
        if result.row is not None and (result.row.ta < 0).any():
            break
    names = {id(p): name for name, p in policy.backbone.named_parameters()}
    groups = policy.backbone.parameter_groups()
    assert (
        result.row is not None
        and result.row.tt.shape == (len(groups),)
        and result.row.w2.shape == (policy.backbone.depth,)
    )
    assert (result.row.ta < 0).any() and (result.row.tt[: policy.backbone.depth] > 0).all()
    for group, before in zip(groups.values(), result.row.ta.tolist(), strict=True):
        _, ta, aa = inner([p.grad for p in group], [result.anchor.get(names[id(p)]) for p in group])
        assert ta == pytest.approx(max(before, 0), rel=1e-3, abs=1e-6 * float(aa) + 1e-9)


@pytest.mark.parametrize("precision", ["float32", "bf16"])
def test_bf16_weights_are_measured_in_wider_numbers(precision: str, hf_backbone: Loaded) -> None:
    """The ledger's row with bf16 weights is close to that with the same weights in float32.

    Products in bf16 would give a larger error.
    """
    rows = []
    for half in (True, False):
        policy = policy_over(hf_backbone("paligemma"))
        policy.backbone.round_weights(torch.bfloat16)
        if not half:
            policy.backbone.float()
        result = gradients(policy, precision=precision)
        row = result.row
        assert row is not None and row.w2.dtype == torch.float32
        assert row.tt.dtype == row.ta.dtype == row.aa.dtype == torch.float64
        names = {id(p): name for name, p in policy.backbone.named_parameters()}
        group = policy.backbone.parameter_groups()["layers.0"]
        anchor_gradient = [result.anchor[names[id(p)]] for p in group]
        assert {t.dtype for t in (*(p.grad for p in group), *anchor_gradient)} == {
            torch.bfloat16 if half else torch.float32
        }
        assert row.aa[0] == pytest.approx(
            sum(a.double().square().sum().item() for a in anchor_gradient), rel=1e-12
        )
        rows.append(row)
    torch.testing.assert_close(rows[0].w2, rows[1].w2, rtol=0.02, atol=0.0)
    torch.testing.assert_close(rows[0].aa, rows[1].aa, rtol=0.1, atol=0.0)


def test_the_anchor_of_bf16_weights_is_not_rounded(hf_backbone: Loaded) -> None:
    """A pass has no distance from its own moments.

    If rounded to eight bits, they would be off by a thousandth of the mean.
    """
    backbone = hf_backbone("smolvlm")
    backbone.round_weights(torch.bfloat16)
    with torch.no_grad():
        seen = encode(backbone, images(3), TEXTS[:3])
    own = [masked_moments(h, seen.mask) for h in seen.hidden]
    context = MethodContext(
        backbone, backbone.parameter_groups(), {}, options_of(METHODS["aegis"]), of_all_tokens(own)
    )
    penalty = METHODS["aegis"].start(context).penalty
    assert penalty is not None
    _, w2 = penalty(Pass(0, None, seen.hidden, seen.mask, seen.image))
    size = torch.stack([m.mean.square().sum() + m.var.sum() for m in own])
    assert (w2 / size < 1e-9).all()


def test_every_method_moves_or_keeps_what_it_should(hf_backbone: Loaded) -> None:
    for method, learns in (
        ("naive", True),
        ("stop-gradient", False),
        ("lora", True),
        ("distill", True),
    ):
        policy = policy_over(hf_backbone("qwen2_5_vl"))
        gradients(policy, method)
        moved = {
            name
            for name, p in policy.backbone.named_parameters()
            if p.grad is not None and p.grad.any()
        }
        assert bool(moved) is learns, method
        if method == "lora":
            assert moved and all(name.endswith(".b") and ".layers." in name for name in moved)


# --- a run ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run(
    tmp_path_factory: pytest.TempPathFactory, hf_folder: Made, hf_anchor: Made, demos_file: Path
) -> Path:
    """A finished run of `aegis` on PaliGemma 2, with checkpointing; read-only."""
    out = tmp_path_factory.mktemp("runs") / "run"
    settings = small(hf_folder("paligemma"), gradient_checkpointing=True)
    train.run(settings, "aegis", demos_file, hf_anchor("paligemma"), out)
    return out


@pytest.mark.parametrize("wanted", [False, True])
def test_a_training_with_checkpointing_recomputes_its_expert_too(
    wanted: bool, hf_folder: Made, demos_file: Path, tmp_path: Path
) -> None:
    settings = small(hf_folder("paligemma"), gradient_checkpointing=wanted)
    naive = METHODS["naive"]
    begun = assemble.build(settings, naive, demos_file, None, tmp_path, lambda _: None)
    assert begun.policy.expert.recomputes == wanted


def test_the_trained_backbone_is_a_folder_that_from_pretrained_loads(
    run: Path, hf_folder: Made
) -> None:
    folder = checkpoint.last(run) / "backbone"
    model, report = transformers.AutoModelForImageTextToText.from_pretrained(
        folder, output_loading_info=True
    )
    assert not any(report[part] for part in ("missing_keys", "unexpected_keys", "mismatched_keys"))
    ours = backbones.load(str(run))
    assert isinstance(ours, HFBackbone) and not model.training
    for name, parameter in model.named_parameters():
        assert torch.equal(parameter, ours.vlm.get_parameter(name))
    original = backbones.load(str(hf_folder("paligemma")))
    moved = [n for n, p in original.named_parameters() if not torch.equal(p, ours.get_parameter(n))]
    assert len(moved) > 10
    first, second = (
        load_processor("paligemma", place).tokenizer for place in (folder, hf_folder("paligemma"))
    )
    assert first.get_vocab() == second.get_vocab()
    wanted = {
        "config.json",
        "model.safetensors",
        "processor_config.json",
        "tokenizer.json",
        "README.md",
    }
    assert {p.name for p in folder.iterdir()} >= wanted
    assert (folder.parent / "expert.safetensors").is_file()
    assert len({oct(p.stat().st_mode) for p in folder.iterdir()}) == 1


def test_it_answers_and_acts_as_the_policy_that_was_saved(run: Path, tmp_path: Path) -> None:
    policy, meta = checkpoint.load_policy(run)
    assert (
        policy.expert.shape.kv_heads == policy.backbone.kv_heads == 2 and meta["method"] == "aegis"
    )
    policy.backbone.save(tmp_path / "again")
    again = backbones.load(str(tmp_path / "again"))
    assert again.fingerprint() == policy.backbone.fingerprint()
    assert again.answer(images(4), TEXTS) == policy.backbone.answer(images(4), TEXTS)
    proprio = torch.zeros(4, policy.expert.shape.proprio)
    chunks = policy.act(images(4), TEXTS, proprio, torch.Generator().manual_seed(0))
    alone = policy.act(images(4)[3:], TEXTS[3:], proprio[3:], torch.Generator().manual_seed(0))
    assert chunks.isfinite().all() and alone.shape == chunks[3:].shape


def test_the_card_says_what_was_done(run: Path, hf_folder: Made) -> None:
    card = (checkpoint.last(run) / "backbone" / "README.md").read_text()
    ledger = artifacts.load(run / "ledger.safetensors").tensors
    inputs = artifacts.read_header(run / "ledger.safetensors").inputs
    assert f"`{hf_folder('paligemma').name}`" in card  # and not its path
    assert "4 of 4 steps" in card and "`aegis`" in card
    assert all(digest in card for digest in inputs.values()) and set(inputs) == {
        "anchor",
        "backbone",
        "demos",
    }
    assert f"{float(ledger['w2'][-1].mean()):.4g} in the last" in card
    assert "aegis probe RUN --baseline" in card


def test_a_resumed_run_ends_in_the_same_bytes(
    run: Path, hf_folder: Made, hf_anchor: Made, demos_file: Path, tmp_path: Path
) -> None:
    settings = small(hf_folder("paligemma"), gradient_checkpointing=True)

    class Stop(Exception):
        pass

    def stop(event: Any) -> None:
        if event.stage == "train" and event.done == 3:
            raise Stop

    with pytest.raises(Stop):
        train.run(
            settings, "aegis", demos_file, hf_anchor("paligemma"), tmp_path / "run", on_event=stop
        )
    train.run(settings, "aegis", demos_file, hf_anchor("paligemma"), tmp_path / "run", resume=True)
    assert_same_run(run, tmp_path / "run")


def test_a_run_may_begin_to_recompute_activations_when_it_resumes(
    run: Path, hf_folder: Made, hf_anchor: Made, demos_file: Path, tmp_path: Path
) -> None:
    settings = small(hf_folder("paligemma"))

    def stop(event: Any) -> None:
        if event.stage == "train" and event.done == 3:
            raise KeyboardInterrupt

    given = "aegis", demos_file, hf_anchor("paligemma"), tmp_path
    with pytest.raises(KeyboardInterrupt):
        train.run(settings, *given, on_event=stop)
    settings = small(hf_folder("paligemma"), gradient_checkpointing=True)
    train.run(settings, *given, resume=True)
    wanted, found = (backbones.load(str(out)).state_dict() for out in (run, tmp_path))
    for name, weight in wanted.items():
        torch.testing.assert_close(found[name], weight, rtol=1e-3, atol=1e-4, msg=name)


@pytest.mark.parametrize(
    ("method", "family"),
    [("lora", "paligemma"), ("nullspace", "paligemma"), ("nullspace", "llava_onevision")],
)
def test_methods_export_a_plain_folder(
    method: str, family: str, hf_folder: Made, hf_anchor: Made, demos_file: Path, tmp_path: Path
) -> None:
    """nullspace with a share of 1 leaves no movement along what VQA reads.

    Norms, patches, a tied head and a lone row are among the sites.
    """
    settings = small(hf_folder(family), weights="float32")
    settings = dataclasses.replace(
        settings, nullspace=dataclasses.replace(settings.nullspace, energy=1.0, every=1)
    )
    train.run(settings, method, demos_file, hf_anchor(family), tmp_path / "run")
    (*_, share) = protected_shares(tmp_path / "run", hf_anchor(family), 1.0)
    assert share < 1e-4 if method == "nullspace" else share > 0.01
    exported = backbones.load(str(tmp_path / "run"))
    original = backbones.load(str(hf_folder(family)))
    assert exported.state_dict().keys() == original.state_dict().keys()
    assert exported.fingerprint() != original.fingerprint()


@pytest.mark.parametrize("precision", ["float32", "bf16"])
def test_low_rank_terms_stay_wide_beside_bf16_weights(precision: str, hf_backbone: Loaded) -> None:
    backbone = hf_backbone("paligemma")
    backbone.round_weights(torch.bfloat16)
    result = gradients(policy_over(backbone), "lora", precision)
    learning = [p for p in backbone.parameters() if p.requires_grad]
    assert learning and {p.dtype for p in learning} == {torch.float32} and result.loss.isfinite()
    assert any(p.grad is not None and p.grad.abs().max() > 0 for p in learning)
    plain = checkpoint.plain_backbone(backbone, METHODS["lora"])
    assert {p.dtype for p in plain.parameters()} == {torch.bfloat16}


def test_an_update_cannot_be_constrained_in_bf16_weights(
    hf_folder: Made, hf_anchor: Made, demos_file: Path, tmp_path: Path
) -> None:
    settings = small(hf_folder("smolvlm"), weights="bf16", precision="bf16")
    with pytest.raises(AegisError, match=r"train\.weights: bf16 with method 'nullspace'"):
        train.run(settings, "nullspace", demos_file, hf_anchor("smolvlm"), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_run_in_bf16_weights(
    hf_folder: Made, hf_anchor: Made, demos_file: Path, tmp_path: Path
) -> None:
    settings = small(hf_folder("smolvlm"), weights="bf16", precision="bf16")
    train.run(settings, "aegis", demos_file, hf_anchor("smolvlm"), tmp_path / "run")
    exported = backbones.load(str(tmp_path / "run"))
    assert all(torch.equal(p, p.bfloat16().float()) for p in exported.parameters())
    folder = checkpoint.last(tmp_path / "run") / "backbone"
    stored = transformers.AutoModelForImageTextToText.from_pretrained(folder, dtype="auto")
    assert stored.dtype == torch.bfloat16


@pytest.mark.parametrize("family", FAMILIES)
def test_dropout_stays_off(family: str, hf_folder: Made, tmp_path: Path) -> None:
    """Training mode gives evaluation's keys and values, and the same exported configuration."""
    folder = Path(shutil.copytree(hf_folder(family), tmp_path / "model"))
    config = json.loads((folder / "config.json").read_text())
    for part in (config, *(section for section in config.values() if isinstance(section, dict))):
        part["attention_dropout"] = 0.5
    (folder / "config.json").write_text(json.dumps(config))
    backbone = backbones.load(str(folder))
    passes = [encode(backbone.train(training), images(2), TEXTS[:2]) for training in (False, True)]
    for calm, trained in zip(*(encoding.keys_values for encoding in passes), strict=True):
        assert torch.equal(calm.key, trained.key) and torch.equal(calm.value, trained.value)
    backbone.save(tmp_path / "saved")
    text = json.loads((tmp_path / "saved" / "config.json").read_text())
    assert text["text_config"]["attention_dropout"] == 0.5


def test_a_full_disk_is_one_error(hf_folder: Made, demos_file: Path, tmp_path: Path) -> None:
    settings = small(hf_folder("smolvlm"))
    with disk(20_000), pytest.raises(AegisError, match="cannot write to") as caught:
        train.run(settings, "naive", demos_file, None, tmp_path / "run")
    assert "free space" in caught.value.expected
    assert not list((tmp_path / "run" / "checkpoints").iterdir())


def test_a_checkpoint_is_on_the_disk_before_it_has_its_name(
    hf_folder: Made, demos_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """transformers leaves the weights that it writes in the page cache, which a power cut loses."""
    synced, rename, found = set[int](), os.rename, list[str]()
    monkeypatch.setattr(os, "fsync", lambda number: synced.add(os.fstat(number).st_ino))

    def renamed(aside: Path, target: Path) -> None:
        files = [aside, *aside.rglob("*")]
        assert not [path for path in files if path.stat().st_ino not in synced]
        found.extend(path.name for path in files)
        rename(aside, target)

    monkeypatch.setattr(os, "rename", renamed)
    train.run(small(hf_folder("smolvlm")), "naive", demos_file, None, tmp_path / "run")
    assert {"model.safetensors", "config.json", "state.safetensors"} <= set(found)


def test_probe_and_inspect_take_the_run_and_its_folder(
    run: Path, hf_folder: Made, hf_anchor: Made, aegis: Callable[..., Any]
) -> None:
    base = hf_folder("paligemma")
    code, out, err = aegis(
        "probe",
        run,
        "--baseline",
        base,
        "--anchor",
        hf_anchor("paligemma"),
        "--questions",
        14,
        "--json",
    )
    report = json.loads(out)
    assert code == 0, err
    assert len(report["layers"]) == 3 and all(layer["w2"] > 0 for layer in report["layers"])
    assert report["cross_entropy"] != report["baseline_cross_entropy"]
    code, out, _ = aegis("inspect", checkpoint.last(run) / "backbone", "--json")
    facts = json.loads(out)["facts"]
    unique = {p.data_ptr(): p.numel() for p in backbones.load(str(run)).parameters()}
    assert (
        code == 0 and facts["family"] == "paligemma" and facts["parameters"] == sum(unique.values())
    )
    assert json.loads(aegis("inspect", run, "--json")[1])["kind"] == "run"
