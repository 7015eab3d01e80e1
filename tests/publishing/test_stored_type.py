"""A Hugging Face backbone is exported in its source's dtype, or in the one requested."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import transformers
from safetensors.torch import load_file
from samples.backbones import TEXTS, images
from samples.command import refused
from samples.hf import write
from samples.hub import Hub
from samples.small_run import recipe as small

from aegis_cli import load_policy
from aegis_cli.common import artifacts, files
from aegis_cli.common.errors import AegisError
from aegis_cli.evaluation import probe, rollout
from aegis_cli.merging import merge
from aegis_cli.merging.settings import MergeSettings
from aegis_cli.models import backbones, lerobot_folder
from aegis_cli.models.policy import Policy
from aegis_cli.publishing import card, export, push
from aegis_cli.training import checkpoint, train

Aegis = Callable[..., tuple[int, str, str]]
FORMATS = (card.AEGIS, card.LEROBOT)


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model that is stored in bfloat16."""
    return write("smolvlm", tmp_path_factory.mktemp("model"), dtype=torch.bfloat16)


@pytest.fixture(scope="module")
def run_folder(source: Path, demos_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "run"
    train.run(small(source, steps=2), "naive", demos_file, None, out)
    return out


def weight_files(folder: Path) -> list[Path]:
    return sorted(folder.rglob("model.safetensors"))


def backbone_types(folder: Path) -> set[torch.dtype]:
    """Types of the backbone's weights in a model's folder, or an exported one of either layout."""
    (path,) = weight_files(folder)
    tensors = load_file(path)
    # One file has the whole policy, and a model's folder has only the backbone.
    prefix = "model.backbone." if any(n.startswith("model.backbone.") for n in tensors) else ""
    kept = {name: t for name, t in tensors.items() if name.startswith(prefix)}
    # Rotary frequencies are not weights.
    return {t.dtype for name, t in kept.items() if "inv_freq" not in name}


def acts(policy: Policy) -> torch.Tensor:
    proprio = torch.zeros(2, len(policy.proprio_scale.mean))
    return policy.act(images(2), TEXTS[:2], proprio, torch.Generator().manual_seed(5))


def rounded(policy: Policy) -> Policy:
    for parameter in policy.backbone.parameters():
        parameter.data = parameter.data.bfloat16().float()
    return policy


def test_a_checkpoint_is_float32_and_says_what_the_source_was(run_folder: Path) -> None:
    at = checkpoint.last(run_folder)
    assert artifacts.read_header(at / checkpoint.EXPERT).meta["stored"] == "bfloat16"
    assert backbone_types(at / checkpoint.BACKBONE) == {torch.float32}


def test_a_run_that_begins_with_another_remembers_the_type_too(
    run_folder: Path, demos_file: Path, tmp_path: Path
) -> None:
    train.run(small(run_folder, steps=1), "naive", demos_file, None, tmp_path / "next")
    at = checkpoint.last(tmp_path / "next")
    assert artifacts.read_header(at / checkpoint.EXPERT).meta["stored"] == "bfloat16"


@pytest.mark.parametrize("form", FORMATS)
def test_an_export_has_the_sources_type_and_acts_like_the_rounded_policy(
    form: str, run_folder: Path, tmp_path: Path
) -> None:
    report = export.run(run_folder, tmp_path / "x", form)
    assert (report.format, report.dtype, report.rounded) == (form, "bfloat16", True)
    assert backbone_types(tmp_path / "x") == {torch.bfloat16}
    own, found = (checkpoint.load_policy(folder)[0] for folder in (run_folder, tmp_path / "x"))
    assert {p.dtype for p in found.parameters()} == {torch.float32}
    assert torch.equal(acts(rounded(own)), acts(found))
    said = (tmp_path / "x" / card.NAME).read_text()
    assert "stored in bfloat16. Any figures above are of the weights in float32" in said


@pytest.mark.parametrize("form", FORMATS)
def test_float32_is_every_digit_of_the_checkpoint(
    form: str, run_folder: Path, tmp_path: Path
) -> None:
    report = export.run(run_folder, tmp_path / "x", form, dtype="float32")
    assert (report.dtype, report.rounded) == ("float32", False)
    assert backbone_types(tmp_path / "x") == {torch.float32}
    own, found = (checkpoint.load_policy(folder) for folder in (run_folder, tmp_path / "x"))
    assert torch.equal(acts(own[0]), acts(found[0])) and "stored" not in found[1]
    assert "stored in float32.\n" in (tmp_path / "x" / card.NAME).read_text()


@pytest.mark.parametrize("form", FORMATS)
def test_probe_rollout_and_load_policy_take_it(
    form: str, aegis: Aegis, run_folder: Path, tmp_path: Path
) -> None:
    out = tmp_path / "x"
    code, said, _ = aegis("export", run_folder, "--out", out, "--format", form, "--json")
    assert code == 0 and json.loads(said)["dtype"] == "bfloat16"
    asked = probe.run(str(out), "scenes", 14, None, None, None)
    assert asked.questions == 14
    assert rollout.run(out, "reach", 1, "seen", None).episodes == 1
    assert load_policy(out).task == "reach"
    assert aegis("inspect", out)[0] == 0


def test_transformers_loads_the_exported_backbone_in_its_type(
    run_folder: Path, tmp_path: Path
) -> None:
    export.run(run_folder, tmp_path / "x", card.AEGIS)
    folder = tmp_path / "x" / checkpoint.BACKBONE
    model = transformers.AutoModelForImageTextToText.from_pretrained(folder, dtype="auto")
    assert model.dtype == torch.bfloat16
    ours = backbones.load(str(folder))
    assert ours.stored == "bfloat16"
    for name, parameter in model.named_parameters():
        assert torch.equal(parameter.float(), ours.vlm.get_parameter(name))  # type: ignore[union-attr]
    assert weight_files(folder)[0].stat().st_size < 0.6 * size_of(run_folder)


def size_of(run: Path) -> int:
    (path,) = weight_files(checkpoint.last(run) / checkpoint.BACKBONE)
    return path.stat().st_size


@pytest.mark.parametrize("form", FORMATS)
def test_an_export_can_be_exported_again(form: str, run_folder: Path, tmp_path: Path) -> None:
    one, other = tmp_path / "one", tmp_path / "other"
    export.run(run_folder, one, form)
    report = export.run(one, other, form)
    assert (report.dtype, report.rounded) == ("bfloat16", False)
    for first, second in zip(weight_files(one), weight_files(other), strict=True):
        assert first.read_bytes() == second.read_bytes()


def test_a_policy_that_was_trained_on_is_written_as_it_is(run_folder: Path, tmp_path: Path) -> None:
    """The dtype in which it was stored before says nothing about its present weights."""
    export.run(run_folder, tmp_path / "x")
    policy, meta = checkpoint.load_policy(tmp_path / "x")
    (tmp_path / "y").mkdir()
    lerobot_folder.write(tmp_path / "y", policy, meta)
    found, said = checkpoint.load_policy(tmp_path / "y")
    assert backbone_types(tmp_path / "y") == {torch.float32} and "stored" not in said
    assert torch.equal(acts(policy), acts(found))


def test_what_is_pushed_has_the_sources_type_too(run_folder: Path, hub: Hub) -> None:
    report = push.run(run_folder, "somebody/reach")
    assert report.dtype == "bfloat16"
    assert b"stored in bfloat16" in hub.committed[card.NAME]
    whole = push.run(run_folder, "somebody/reach", dtype="float32", dry_run=True)
    assert whole.megabytes > 1.4 * report.megabytes


def test_float32_sources_stay_float32(
    hf_folder: Callable[[str], Path], demos_file: Path, tmp_path: Path
) -> None:
    train.run(small(hf_folder("smolvlm"), steps=2), "naive", demos_file, None, tmp_path / "run")
    report = export.run(tmp_path / "run", tmp_path / "x")
    assert (report.dtype, report.rounded) == ("float32", False)
    half = export.run(tmp_path / "run", tmp_path / "half", dtype="bfloat16")
    assert (half.dtype, half.rounded) == ("bfloat16", True)


def test_a_run_in_bfloat16_stays_in_it(
    hf_folder: Callable[[str], Path], demos_file: Path, tmp_path: Path
) -> None:
    settings = small(hf_folder("smolvlm"), steps=2, weights="bf16", precision="bf16")
    train.run(settings, "naive", demos_file, None, tmp_path / "run")
    for form in FORMATS:
        report = export.run(tmp_path / "run", tmp_path / form, form)
        assert (report.dtype, report.rounded) == ("bfloat16", False)


def test_a_damaged_type_is_refused(run_folder: Path, tmp_path: Path) -> None:
    export.run(run_folder, tmp_path / "x")
    path = tmp_path / "x" / "model.safetensors"
    saved = artifacts.load(path, "policy")
    meta: dict[str, Any] = {**saved.header.meta, "stored": ["bfloat16"]}
    fingerprint = saved.header.fingerprint
    artifacts.save(path, "policy", saved.tensors, fingerprint=fingerprint, meta=meta)
    with pytest.raises(artifacts.AegisError, match="header of .* is damaged"):
        checkpoint.load_policy(tmp_path / "x")


def test_a_merged_model_has_the_type_of_the_fine_tuned_one(
    source: Path, run_folder: Path, tmp_path: Path
) -> None:
    export.run(run_folder, tmp_path / "x", card.AEGIS)
    tuned, settings = (
        tmp_path / "x" / checkpoint.BACKBONE,
        MergeSettings("linear", base=str(source)),
    )
    merge.run(str(tuned), settings, tmp_path / "merged", strength=0.5)
    assert backbone_types(tmp_path / "merged") == {torch.bfloat16}
    assert "stored in bfloat16" in (tmp_path / "merged" / "README.md").read_text()


def test_a_model_that_was_but_rounded_has_not_moved(tmp_path: Path) -> None:
    """The base is stored in float32, and the model fine-tuned from it in bfloat16."""
    base = write("smolvlm", tmp_path / "base")
    tuned = write("smolvlm", tmp_path / "tuned", dtype=torch.bfloat16)
    settings = MergeSettings("linear", base=str(base))
    with pytest.raises(AegisError, match="the same weights in the fine-tuned and the pre-trained"):
        merge.run(str(tuned), settings, tmp_path / "merged", strength=0.5)


def test_a_merged_run_is_exported_in_the_sources_type(
    run_folder: Path, demos_file: Path, tmp_path: Path
) -> None:
    merge.run(str(run_folder), MergeSettings("linear"), tmp_path / "merged", strength=0.5)
    assert backbone_types(checkpoint.last(tmp_path / "merged") / "backbone") == {torch.float32}
    assert export.run(tmp_path / "merged", tmp_path / "x").dtype == "bfloat16"


def test_the_embedded_backbone_is_float32(
    aegis: Aegis, tiny_folder: Path, demos_file: Path, tmp_path: Path
) -> None:
    train.run(small(tiny_folder, steps=2), "naive", demos_file, None, tmp_path / "run")
    assert export.run(tmp_path / "run", tmp_path / "x").dtype == "float32"
    again = export.run(tmp_path / "run", tmp_path / "y", card.AEGIS, dtype="float32")
    (one, other) = (
        folder / checkpoint.EXPERT for folder in (checkpoint.last(tmp_path / "run"), tmp_path / "y")
    )
    assert again.dtype == "float32" and files.sha256_file(one) == files.sha256_file(other)
    said = refused(
        aegis("export", tmp_path / "run", "--out", tmp_path / "z", "--dtype", "bfloat16")
    )
    assert "embedded" in said
    named = ("--format", "aegis", "--camera", "wrist")
    assert "--camera wrist" in refused(aegis("export", tmp_path / "run", "--out", "z", *named))
