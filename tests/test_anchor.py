"""The anchor: what is counted, and that how the samples are dealt does not show in the result."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from aegis_cli import artifacts
from aegis_cli.backbones.embedded import EmbeddedVLM
from aegis_cli.core.moments import Moments
from aegis_cli.errors import AegisError
from aegis_cli.stages import anchor
from aegis_cli.vqa.dataset import VQASet, load_scenes

SAMPLES = 60
TOLERANCE = 1e-6  # relative to the layer's larger of |mean| and deviation


@pytest.fixture(scope="module")
def asked() -> VQASet:
    return load_scenes("anchor", SAMPLES)


def reversed_set(asked: VQASet) -> VQASet:
    return VQASet(asked.images, asked.image_of[::-1].copy(), asked.questions[::-1])


def assert_same(a: list[Moments], b: list[Moments]) -> None:
    for one, other in zip(a, b, strict=True):
        assert one.count == other.count
        scale = torch.maximum(one.mean.abs(), one.var.sqrt())
        assert ((one.mean - other.mean).abs() <= TOLERANCE * scale).all()
        assert ((one.var - other.var).abs() <= TOLERANCE * scale.square()).all()


def test_batch_size_and_order_change_nothing(tiny: EmbeddedVLM, asked: VQASet) -> None:
    lengths = {len(q.text.split()) for q in asked.questions}
    assert len(lengths) > 3  # so every batch pads some of its questions
    sixteen = anchor.measure(tiny, asked.batches(16), SAMPLES)
    assert_same(sixteen, anchor.measure(tiny, asked.batches(7), SAMPLES))
    assert_same(sixteen, anchor.measure(tiny, asked.batches(SAMPLES), SAMPLES))
    assert_same(sixteen, anchor.measure(tiny, reversed_set(asked).batches(16), SAMPLES))


@torch.no_grad()
def one_by_one(model: EmbeddedVLM, asked: VQASet) -> list[Moments]:
    """Each question alone, so that nothing is ever padded; all tokens stacked, moments in float64."""
    rows: list[list[torch.Tensor]] = [[] for _ in range(model.depth)]
    for images, questions in asked.batches(1):
        encoding = model.encode(model.prepare(torch.from_numpy(images), [questions[0].text]))
        assert encoding.mask.all() and encoding.mask.shape[1] == 64 + len(questions[0].text.split()) + 1
        for layer, hidden in zip(rows, encoding.hidden, strict=True):
            layer.append(hidden[0].double())
    stacked = [torch.cat(layer) for layer in rows]
    return [Moments(len(x), x.mean(0), x.var(0, correction=0)) for x in stacked]


def test_padding_never_counts(tiny: EmbeddedVLM, asked: VQASet) -> None:
    alone = one_by_one(tiny, asked)
    assert alone[0].count == sum(64 + len(q.text.split()) + 1 for q in asked.questions)
    assert_same(alone, anchor.measure(tiny, asked.batches(16), SAMPLES))


def test_layers_differ_and_measure_what_the_model_does(tiny: EmbeddedVLM, asked: VQASet) -> None:
    first, last = anchor.measure(tiny, asked.batches(16), SAMPLES)
    assert not torch.allclose(first.var, last.var, rtol=1e-3)
    with torch.no_grad():
        tiny.layers[1].out.weight.mul_(20)
    again = anchor.measure(tiny, asked.batches(16), SAMPLES)
    assert torch.equal(again[0].var, first.var) and not torch.allclose(again[1].var, last.var, rtol=1e-3)


def test_artifact_and_report(tiny: EmbeddedVLM, tiny_folder: Path, asked: VQASet, tmp_path: Path) -> None:
    events: list = []
    report = anchor.run(str(tiny_folder), "scenes", SAMPLES, tmp_path / "a.safetensors", batch_size=16, on_event=events.append)
    artifact = artifacts.load(tmp_path / "a.safetensors", "anchor", fingerprint=tiny.fingerprint())
    assert set(artifact.tensors) == {"count", "layers.0.mean", "layers.0.var", "layers.1.mean", "layers.1.var"}
    assert artifact.header.seed == 0 and artifact.header.meta == {"vqa": "scenes", "samples": SAMPLES}
    for i, layer in enumerate(anchor.measure(tiny, asked.batches(16), SAMPLES)):
        assert torch.equal(artifact.tensors[f"layers.{i}.mean"], layer.mean)
        assert torch.equal(artifact.tensors[f"layers.{i}.var"], layer.var)
    assert report.samples == SAMPLES and report.layers == 2 and report.samples_per_s > 0
    assert report.tokens == int(artifact.tensors["count"]) == sum(65 + len(q.text.split()) for q in asked.questions)
    assert report.out == str(tmp_path / "a.safetensors") and report.sha256 == artifacts.sha256_file(report.out)
    assert [(e.done, e.total) for e in events if e.stage == "anchor"] == [(n, 60) for n in (16, 32, 48, 60)]


def test_load_gives_the_layers_in_order(tiny: EmbeddedVLM, anchor_file: Path) -> None:
    tensors = artifacts.load(anchor_file).tensors
    layers = anchor.load(anchor_file, tiny.fingerprint())
    assert [m.count for m in layers] == 2 * [int(tensors["count"])]
    assert all(torch.equal(m.var, tensors[f"layers.{i}.var"]) for i, m in enumerate(layers))


def test_same_arguments_same_bytes(tiny_folder: Path, tmp_path: Path) -> None:
    def digest(name: str, **change: int) -> str:
        return anchor.run(str(tiny_folder), "scenes", 14, tmp_path / name, **{"batch_size": 8, "seed": 0, **change}).sha256

    assert digest("a") == digest("b")
    assert digest("c", seed=1) != digest("a")


def test_another_question_set_is_refused_before_anything_is_loaded(tmp_path: Path) -> None:
    with pytest.raises(AegisError, match="question set 'vqav2'"):
        anchor.run("no such backbone", "vqav2", 10, tmp_path / "a.safetensors")
    assert not list(tmp_path.iterdir())
