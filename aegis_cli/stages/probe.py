"""`aegis probe`: what the VLM still knows, on questions over scenes that no training seed touches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from aegis_cli import backbones
from aegis_cli.backbones.base import Backbone
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.moments import merge
from aegis_cli.core.transport import w2_diag
from aegis_cli.errors import AegisError
from aegis_cli.events import OnEvent, ignore
from aegis_cli.stages import anchor as anchors
from aegis_cli.stages import device as devices
from aegis_cli.vqa.dataset import VQASet, load_scenes
from aegis_cli.vqa.metrics import Graded, by_family, grade, score

PROBE_SEED = 0
W2_QUESTIONS = 1000  # moments of about 75,000 tokens; more change the third digit


@dataclass(frozen=True)
class FamilyReport:
    """One family of questions; shares in [0, 1]."""

    accuracy: float
    interval: tuple[float, float]
    questions: int
    majority: float
    baseline_accuracy: float | None


@dataclass(frozen=True)
class LayerW2:
    """Squared Wasserstein-2 distance between the anchor and this model's activations on probe questions."""

    layer: str
    w2: float


@dataclass(frozen=True)
class ProbeReport:
    """Accuracy in [0, 1] with its 95 % interval; cross-entropy in nats an answer; drop in percentage points."""

    accuracy: float
    interval: tuple[float, float]
    cross_entropy: float
    majority: float
    baseline_accuracy: float | None
    baseline_cross_entropy: float | None
    drop_points: float | None
    drop_interval: tuple[float, float] | None
    families: dict[str, FamilyReport]
    layers: list[LayerW2]
    questions: int
    passed: bool | None

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def run(
    target: str, vqa: str, questions: int, baseline: str | None, anchor: Path | None, max_drop: float | None,
    batch_size: int = 64, on_event: OnEvent = ignore,
) -> ProbeReport:
    """Ask `questions` probe questions of `target` and, to measure the drop, of `baseline`.

    Raises:
        AegisError: nothing to load, or an anchor that does not belong to the baseline.
    """
    anchors.check_set(vqa)
    model = backbones.load(target).to(devices.pick())
    before = None if baseline is None else backbones.load(baseline).to(devices.pick())
    measured = None if anchor is None else anchors.load(anchor, _owner(model, before).fingerprint())
    asked = load_scenes("probe", questions, PROBE_SEED, on_event=on_event)
    after = ask(model, asked, batch_size, on_event)
    reference = None if before is None else ask(before, asked, batch_size, on_event)
    layers = [] if measured is None else drift(model, asked, measured, batch_size)
    return compare(after, reference, layers, max_drop)


def _owner(model: Backbone, before: Backbone | None) -> Backbone:
    """The pre-trained backbone, whose anchor it has to be."""
    return model if before is None else before


def ask(model: Backbone, asked: VQASet, batch_size: int, on_event: OnEvent = ignore) -> list[Graded]:
    """Every question's answer, graded; float32, so that the batch size does not show in the result."""
    with torch.inference_mode():
        return grade(model.answer, model.answer_log_likelihood, asked, batch_size, on_event)


def drift(model: Backbone, asked: VQASet, anchor: Anchor, batch_size: int) -> list[LayerW2]:
    """W2^2 a layer between the anchor and the model's activations on the first probe questions, all tokens in one."""
    if not anchor.image:
        raise AegisError("an anchor without moments", "one to measure the drift from", "measure it: aegis anchor --parts moments")
    head = VQASet(asked.images, asked.image_of[:W2_QUESTIONS], asked.questions[:W2_QUESTIONS])
    now = zip(*anchors.measure(model, head.batches(batch_size), len(head.questions)), strict=True)
    then = zip(anchor.image, anchor.text, strict=True)
    pairs = [(merge(*n), merge(*a)) for n, a in zip(now, then, strict=True)]
    return [
        LayerW2(f"layers.{i}", float(w2_diag(n.mean.cpu(), n.var.cpu(), a.mean, a.var))) for i, (n, a) in enumerate(pairs)
    ]


def compare(
    after: Sequence[Graded], before: Sequence[Graded] | None, layers: list[LayerW2], max_drop: float | None
) -> ProbeReport:
    """The report of two sets of answers to the same questions."""
    total, families = score(after), by_family(after)
    reference = None if before is None else score(before)
    earlier = {} if before is None else by_family(before)
    drop = None if reference is None else 100 * (reference.accuracy - total.accuracy)
    if max_drop is not None and drop is None:
        raise AegisError("--max-drop without --baseline", "something to measure the drop against", "add --baseline embedded")
    return ProbeReport(
        accuracy=total.accuracy, interval=total.interval, cross_entropy=total.cross_entropy, majority=total.majority,
        baseline_accuracy=reference and reference.accuracy, baseline_cross_entropy=reference and reference.cross_entropy,
        drop_points=drop, drop_interval=None if before is None else _paired_interval(after, before),
        families={
            name: FamilyReport(s.accuracy, s.interval, s.questions, s.majority, earlier[name].accuracy if earlier else None)
            for name, s in families.items()
        },
        layers=layers, questions=total.questions, passed=None if max_drop is None or drop is None else drop <= max_drop,
    )


def _paired_interval(after: Sequence[Graded], before: Sequence[Graded]) -> tuple[float, float]:
    """95 % normal interval of the drop in points, from the per-question differences: the questions are the same."""
    lost = torch.tensor([float(b.correct) - float(a.correct) for a, b in zip(after, before, strict=True)], dtype=torch.float64)
    half = 1.959964 * float(lost.std(correction=0)) / len(lost) ** 0.5
    mean = float(lost.mean())
    return 100 * (mean - half), 100 * (mean + half)
