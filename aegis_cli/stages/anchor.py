"""`aegis anchor`: one Gaussian a layer of what the pre-trained VLM's activations look like on questions."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from aegis_cli import artifacts, backbones, files
from aegis_cli.backbones.base import Backbone
from aegis_cli.core.moments import Moments, empty, masked_moments, merge
from aegis_cli.errors import AegisError
from aegis_cli.events import OnEvent, Progress, ignore
from aegis_cli.stages import device as devices
from aegis_cli.vqa.dataset import load_scenes
from aegis_cli.vqa.questions import Question


@dataclass(frozen=True)
class AnchorReport:
    """What was measured: `tokens` valid tokens of `samples` questions, at `layers` layers."""

    samples: int
    tokens: int
    layers: int
    samples_per_s: float
    out: str
    sha256: str

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def run(
    backbone: str, vqa: str, samples: int, out: Path, batch_size: int = 64, seed: int = 0, on_event: OnEvent = ignore
) -> AnchorReport:
    """Pass `samples` (image, question) pairs through the backbone, write the moments of each layer.

    Runs in float32, so that neither batch size nor order shows in the result.
    """
    check_set(vqa)
    files.check_writable(Path(out))
    model = backbones.load(backbone).to(devices.pick())
    questions = load_scenes("anchor", samples, seed, on_event=on_event)
    start = time.perf_counter()
    moments = measure(model, questions.batches(batch_size), samples, on_event)
    seconds = time.perf_counter() - start
    tensors = {"count": torch.tensor([moments[0].count])}
    for i, layer in enumerate(moments):
        tensors |= {f"layers.{i}.mean": layer.mean, f"layers.{i}.var": layer.var}
    artifacts.save(
        out, "anchor", tensors, seed=seed, fingerprint=model.fingerprint(),
        units={"count": "tokens", "*.var": "activation^2", "*.mean": "activation"}, meta={"vqa": vqa, "samples": samples},
    )
    return AnchorReport(
        samples, moments[0].count, len(moments), samples / seconds, str(out), artifacts.sha256_file(out)
    )


@torch.inference_mode()
def measure(
    model: Backbone, batches: Iterable[tuple[np.ndarray, Sequence[Question]]], total: int, on_event: OnEvent = ignore
) -> list[Moments]:
    """Moments of each layer's hidden states over the valid tokens of image and question."""
    moments = [empty(model.width) for _ in range(model.depth)]
    done = 0
    for images, questions in batches:
        encoding = model.encode(model.prepare(torch.from_numpy(images), [q.text for q in questions]))
        taken = [masked_moments(hidden, encoding.mask) for hidden in encoding.hidden]
        moments = [merge(a, b) for a, b in zip(moments, taken, strict=True)]
        done += len(questions)
        on_event(Progress("anchor", done, total, "samples"))
    return moments


def load(path: Path, fingerprint: str) -> list[Moments]:
    """The anchor of the backbone with this fingerprint, one Gaussian a layer."""
    tensors = artifacts.load(path, "anchor", fingerprint=fingerprint).tensors
    count = int(tensors["count"])
    layers = sum(name.endswith(".mean") for name in tensors)
    return [Moments(count, tensors[f"layers.{i}.mean"], tensors[f"layers.{i}.var"]) for i in range(layers)]


def check_set(vqa: str) -> None:
    """Raise AegisError unless `vqa` names a question set."""
    if vqa != "scenes":
        raise AegisError(f"question set '{vqa}'", "'scenes'", "use --vqa scenes")
