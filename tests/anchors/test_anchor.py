"""The anchor: what it counts, and that the order and batching of samples do not affect it."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from samples.graphs import outputs_kept
from samples.vqa_files import write_jsonl

from aegis_cli.anchors import anchor_file, measure, moments
from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, Progress, Warned
from aegis_cli.common.ranks import Ranks
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.moments import Moments, merge
from aegis_cli.data import demonstrations
from aegis_cli.data.selection import Selection
from aegis_cli.data.vqa.dataset import VQASet, load_scenes
from aegis_cli.models.backbones.embedded import EmbeddedVLM
from aegis_cli.recipes import ANCHOR_PARTS
from aegis_cli.recipes import Anchor as Settings

SAMPLES = 60
TOLERANCE = 1e-6  # relative to the layer's larger of |mean| and deviation


@pytest.fixture(scope="module")
def asked() -> VQASet:
    return load_scenes("anchor", SAMPLES)


def measured(model: EmbeddedVLM, asked: VQASet, size: int) -> list[Moments]:
    """Moments of each layer over all tokens."""
    image, text = moments.measure(model, asked.batches(size), SAMPLES)
    return [merge(i, t) for i, t in zip(image, text, strict=True)]


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
    assert len(lengths) > 3  # so every batch pads some questions
    for kind in range(2):
        sixteen = moments.measure(tiny, asked.batches(16), SAMPLES)[kind]
        assert_same(sixteen, moments.measure(tiny, asked.batches(7), SAMPLES)[kind])
        assert_same(sixteen, moments.measure(tiny, asked.batches(SAMPLES), SAMPLES)[kind])
        assert_same(sixteen, moments.measure(tiny, reversed_set(asked).batches(16), SAMPLES)[kind])


@torch.no_grad()
def one_by_one(model: EmbeddedVLM, asked: VQASet) -> list[Moments]:
    """Each question alone, so that nothing is ever padded.

    All tokens are stacked, and moments are taken in float64.
    """
    rows: list[list[torch.Tensor]] = [[] for _ in range(model.depth)]
    for images, questions in asked.batches(1):
        encoding = model.encode(model.prepare(torch.from_numpy(images), [questions[0].text]))
        assert (
            encoding.mask.all()
            and encoding.mask.shape[1] == 64 + len(questions[0].text.split()) + 1
        )
        for layer, hidden in zip(rows, encoding.hidden, strict=True):
            layer.append(hidden[0].double())
    stacked = [torch.cat(layer) for layer in rows]
    return [Moments(len(x), x.mean(0), x.var(0, correction=0)) for x in stacked]


def test_padding_never_counts(tiny: EmbeddedVLM, asked: VQASet) -> None:
    alone = one_by_one(tiny, asked)
    assert alone[0].count == sum(64 + len(q.text.split()) + 1 for q in asked.questions)
    assert_same(alone, measured(tiny, asked, 16))


def test_image_and_text_tokens_are_measured_apart(tiny: EmbeddedVLM, asked: VQASet) -> None:
    image, text = moments.measure(tiny, asked.batches(16), SAMPLES)
    assert image[0].count == 64 * SAMPLES
    assert text[0].count == sum(len(q.text.split()) + 1 for q in asked.questions)
    assert not torch.allclose(image[0].mean, text[0].mean, rtol=1e-3)


def test_layers_differ_and_measure_what_the_model_does(tiny: EmbeddedVLM, asked: VQASet) -> None:
    first, last = measured(tiny, asked, 16)
    assert not torch.allclose(first.var, last.var, rtol=1e-3)
    with torch.no_grad():
        tiny.layers[1].out.weight.mul_(20)
    again = measured(tiny, asked, 16)
    assert torch.equal(again[0].var, first.var) and not torch.allclose(
        again[1].var, last.var, rtol=1e-3
    )


def wanted(model: EmbeddedVLM) -> anchor_file.Wanted:
    return anchor_file.Wanted(model.fingerprint(), "tiny", "--backbone ")


def test_artifact_and_report(
    tiny: EmbeddedVLM, tiny_folder: Path, asked: VQASet, tmp_path: Path
) -> None:
    events: list = []
    settings = Settings(
        samples=SAMPLES,
        batch_size=16,
        parts=("fisher", "moments", "inputs"),
        energy=0.99,
        fisher_samples=5,
    )
    report = measure.run(
        str(tiny_folder), settings, tmp_path / "a.safetensors", on_event=events.append
    )
    artifact = artifacts.load(tmp_path / "a.safetensors", "anchor")
    assert artifact.header.fingerprint == tiny.fingerprint()
    meta = {
        "backbone": str(tiny_folder),
        "vqa": "scenes",
        "samples": SAMPLES,
        "parts": ["fisher", "inputs", "moments"],
        "energy": 0.99,
    }
    assert artifact.header.seed == 0 and artifact.header.meta == meta
    found = anchor_file.from_artifact(artifact)
    for layers, again in zip(
        (found.image, found.text), moments.measure(tiny, asked.batches(16), SAMPLES), strict=True
    ):
        assert [m.count for m in layers] == [m.count for m in again]
        assert all(
            torch.equal(a.mean, b.mean) and torch.equal(a.var, b.var)
            for a, b in zip(layers, again, strict=True)
        )
    assert found.inputs.keys() == tiny.sites().keys() | {"words.scores"}
    assert found.fisher.keys() == dict(tiny.named_parameters()).keys()
    assert (
        report.samples == SAMPLES
        and report.layers == 2
        and report.seconds.keys() == set(settings.parts)
    )
    assert [report.image_tokens, report.text_tokens] == artifact.tensors["count"].tolist()
    assert 0 < report.directions < 1 and report.megabytes * 1e6 == Path(report.out).stat().st_size
    assert report.out == str(tmp_path / "a.safetensors") and report.sha256 == artifacts.sha256_file(
        report.out
    )
    for stage in ("anchor", "anchor inputs", "anchor inputs spectra", "anchor fisher"):
        told = [e for e in events if e.stage == stage and isinstance(e, Progress)]
        # A large model's first batch takes minutes and counts, so the stage is shown before it.
        assert (told[0].done, told[-1].done) == (0, told[-1].total), stage
    passes = [e for e in events if e.stage == "anchor" and isinstance(e, Progress)]
    assert [(e.done, e.total) for e in passes] == [(n, 60) for n in (0, 16, 32, 48, 60)]


def held(found: Anchor) -> list[str]:
    parts = {
        "moments": found.image,
        "inputs": found.inputs,
        "curvature": found.curvature,
        "fisher": found.fisher,
    }
    return [name for name, value in parts.items() if value]


@pytest.mark.parametrize("part", ANCHOR_PARTS)
def test_a_part_alone(tiny_folder: Path, tmp_path: Path, part: str) -> None:
    settings = Settings(samples=21, parts=(part,), fisher_samples=3)
    report = measure.run(str(tiny_folder), settings, tmp_path / "a.safetensors")
    found = anchor_file.from_artifact(artifacts.load(tmp_path / "a.safetensors", "anchor"))
    assert held(found) == held(anchor_file.only(found, [part, "moments"])) == [part]
    assert held(anchor_file.only(found, set(ANCHOR_PARTS) - {part})) == []
    assert (report.directions is None) == (part != "inputs")
    of_moments = (report.image_tokens, report.text_tokens, report.layers)
    assert all(n is not None and n > 0 for n in of_moments) == (part == "moments")
    assert part == "moments" or of_moments == (None, None, None)
    assert (report.entropy is None) == (part != "curvature")


@pytest.mark.parametrize(
    ("own", "parts", "warned"),
    [
        ({"temperature": 4.0}, ("moments", "inputs"), True),
        ({"temperature": 4.0}, ("curvature",), False),
        ({"tokens": 0.5}, ("curvature",), True),
        ({"energy": 0.9}, ("moments",), True),
        ({"energy": 0.9}, ("curvature",), False),
        ({"memory": 9}, ("inputs",), False),
        ({"fisher_samples": 9}, ("inputs",), True),
    ],
)
def test_a_setting_of_a_part_that_is_not_measured_is_warned_of(
    own: dict[str, Any], parts: tuple[str, ...], warned: bool
) -> None:
    seen: list[Event] = []
    measure._warn_of_unread(Settings(parts=parts, **own), seen.append)
    (name,) = own
    said = [event.text for event in seen if isinstance(event, Warned)]
    assert len(said) == warned
    assert all(f"anchor.{name}: {own[name]:g} changes nothing without" in text for text in said)


@pytest.mark.parametrize(
    ("samples", "parts", "warns"),
    [
        (4, ("moments",), "moments need at least 30"),
        (30, ("moments",), ""),
        (299, ("moments", "inputs"), "inputs need at least 300"),
        (300, ("moments", "inputs"), ""),
    ],
)
def test_an_anchor_of_few_samples_is_warned_of(
    samples: int, parts: tuple[str, ...], warns: str, tiny_folder: Path, tmp_path: Path
) -> None:
    seen: list[Event] = []
    settings = Settings(samples=samples, parts=parts)
    measure.run(str(tiny_folder), settings, tmp_path / "a.safetensors", on_event=seen.append)
    said = [event.text for event in seen if isinstance(event, Warned)]
    assert len(said) == bool(warns) and all(warns in text for text in said)


def test_where_questions_run_out_more_samples_are_not_advised(
    tiny_folder: Path, tmp_path: Path
) -> None:
    path = write_jsonl(tmp_path, 12)
    seen: list[Event] = []
    settings = Settings(samples=24, vqa=str(path))
    measure.run(str(tiny_folder), settings, tmp_path / "a.safetensors", on_event=seen.append)
    (said,) = [event.text for event in seen if isinstance(event, Warned)]
    assert "about four of ten images are for anchors" in said and "--samples" not in said


@pytest.mark.parametrize("part", ["curvature", "fisher"])
def test_no_graph_outlives_its_pass(tiny_folder: Path, tmp_path: Path, part: str) -> None:
    settings = Settings(samples=21, parts=(part,), fisher_samples=3)
    made, kept = outputs_kept(
        lambda: measure.run(str(tiny_folder), settings, tmp_path / "a.safetensors")
    )
    assert made > 0 == kept


def test_same_arguments_same_bytes(tiny_folder: Path, tmp_path: Path) -> None:
    def digest(name: str, **change: int) -> str:
        settings = Settings(
            **{"samples": 21, "batch_size": 8, "fisher_samples": 4, "parts": ANCHOR_PARTS, **change}
        )
        return measure.run(str(tiny_folder), settings, tmp_path / name).sha256

    assert digest("a") == digest("b")
    assert digest("c", seed=1) != digest("a")


# --- robot frames ---------------------------------------------------------------------------------

FRAMES = Settings(samples=30, batch_size=7, source="demos", parts=("moments",))


def test_frames_are_read_with_their_instructions(
    tiny: EmbeddedVLM, tiny_folder: Path, demos_file: Path, tmp_path: Path
) -> None:
    out = tmp_path / "a.safetensors"
    whole = dataclasses.replace(FRAMES, samples=10_000)
    report = measure.run(str(tiny_folder), whole, out, demos=demos_file)
    shown = demonstrations.load(demos_file, 0.5, 0)
    frames = torch.arange(len(shown.episode_of))
    assert report.samples == len(frames)
    texts = [shown.instructions[i] for i in shown.instruction_of.tolist()]
    image, text = moments.measure_passes(
        tiny, [frames], lambda rows: (shown.images(rows), texts), len(frames)
    )
    found = anchor_file.load(out, wanted(tiny))
    assert_same(list(found.image), image)
    assert_same(list(found.text), text)
    assert report.text_tokens == sum(len(t.split()) + 1 for t in texts)


@pytest.mark.parametrize("rank", [0, 1])
def test_a_process_reads_the_batches_of_its_own_turn_alone(
    rank: int, tiny: EmbeddedVLM, demos_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames in videos are decoded only when they are read."""
    shown, read = demonstrations.load(demos_file, 0.5, 0), list[int]()
    monkeypatch.setattr(Ranks, "gathered", lambda _, value: [value])

    def noting(rows: torch.Tensor) -> moments.Read:
        read.append(int(rows[0]))
        return shown.images(rows), [shown.instructions[0]] * len(rows)

    batches = torch.arange(10).split(2)
    moments.measure_passes(tiny, batches, noting, 10, ranks=Ranks(rank, 2))
    assert read == [[0, 4, 8], [2, 6]][rank]


def test_only_frames_of_the_chosen_episodes_are_read(
    tiny: EmbeddedVLM, tiny_folder: Path, demos_file: Path, tmp_path: Path
) -> None:
    out = tmp_path / "a.safetensors"
    whole = dataclasses.replace(FRAMES, samples=10_000)
    report = measure.run(
        str(tiny_folder), whole, out, demos=demos_file, selection=Selection(only="0,2-3")
    )
    shown = demonstrations.load(demos_file, 0.5, 0)
    frames = torch.isin(shown.episode_of, torch.tensor([0, 2, 3])).nonzero().squeeze(1)
    assert 0 < report.samples == len(frames) < len(shown.episode_of)
    texts = [shown.instructions[i] for i in shown.instruction_of[frames].tolist()]
    image, _ = moments.measure_passes(
        tiny, [frames], lambda rows: (shown.images(rows), texts), len(frames)
    )
    assert_same(list(anchor_file.load(out, wanted(tiny)).image), image)
    assert artifacts.read_header(out).meta["only"] == "0,2-3"


def test_fewer_frames_are_drawn_by_the_seed(
    tiny_folder: Path, demos_file: Path, tmp_path: Path
) -> None:
    def digest(name: str, **change: int) -> str:
        settings = dataclasses.replace(FRAMES, **change)
        return measure.run(str(tiny_folder), settings, tmp_path / name, demos=demos_file).sha256

    assert digest("a") == digest("b")
    assert digest("c", seed=1) != digest("a")


def test_the_header_says_what_was_read(tiny_folder: Path, demos_file: Path, tmp_path: Path) -> None:
    headers = []
    for settings, demos in ((FRAMES, demos_file), (Settings(samples=21, parts=("moments",)), None)):
        measure.run(str(tiny_folder), settings, tmp_path / "a.safetensors", demos=demos)
        headers.append(artifacts.read_header(tmp_path / "a.safetensors"))
    frames, questions = headers
    assert frames.meta["demos"] == demos_file.name and "vqa" not in frames.meta
    assert frames.inputs == {"demos": artifacts.sha256_file(demos_file)}
    assert questions.meta["vqa"] == "scenes" and "demos" not in questions.meta


@pytest.mark.parametrize("part", sorted(set(ANCHOR_PARTS) - {"moments"}))
def test_parts_that_need_answers_are_refused_of_frames(
    demos_file: Path, tmp_path: Path, part: str
) -> None:
    settings = dataclasses.replace(FRAMES, parts=("moments", part))
    with pytest.raises(AegisError, match=f"{part} of robot frames") as caught:
        measure.run("no such backbone", settings, tmp_path / "a.safetensors", demos=demos_file)
    assert "answers" in caught.value.expected and not list(tmp_path.iterdir())


def test_frames_of_no_demonstrations_are_refused(tmp_path: Path) -> None:
    with pytest.raises(AegisError, match="without demonstrations") as caught:
        measure.run("no such backbone", FRAMES, tmp_path / "a.safetensors")
    assert "--demos" in caught.value.fix


def test_the_command_measures_moments_of_frames(
    aegis: Callable[..., tuple[int, str, str]],
    tiny_folder: Path,
    demos_file: Path,
    tmp_path: Path,
) -> None:
    out = tmp_path / "a.safetensors"
    model = ["anchor", "--backbone", tiny_folder, "--out", out, "--samples", 20]
    code, shown, err = aegis(*model, "--demos", demos_file, "--json")
    assert code == 0, err
    assert json.loads(shown)["directions"] is None
    code, shown, _ = aegis("inspect", out, "--json")
    assert code == 0 and json.loads(shown)["facts"]["demos"] == demos_file.name
    refused = {
        ("--demos", demos_file, "--parts", "moments,fisher"): "fisher of robot frames",
        ("--demos", demos_file, "--vqa", "scenes"): "--vqa with --demos",
        ("--camera", "top"): "--camera without --demos",
        ("--only", "0-3"): "--only without --demos",
        ("--demos", demos_file, "--only", "0-999"): "which has",
        ("--demos", tmp_path / "none"): "no file or folder",
    }
    for options, found in refused.items():
        code, _, err = aegis(*model, *options)
        assert code == 2 and found in " ".join(err.split()), options


def test_another_question_set_is_refused_before_anything_is_loaded(tmp_path: Path) -> None:
    with pytest.raises(AegisError, match="question set 'vqav2'"):
        measure.run("no such backbone", Settings(vqa="vqav2"), tmp_path / "a.safetensors")
    assert not list(tmp_path.iterdir())
