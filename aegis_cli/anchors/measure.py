"""`aegis anchor`: measure the pre-trained VLM on questions, once."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from aegis_cli.anchors import anchor_file, curvature, fisher, inputs, moments
from aegis_cli.common import artifacts, devices, files
from aegis_cli.common.events import OnEvent, ignore
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.moments import Moments
from aegis_cli.core.spectrum import Spectrum
from aegis_cli.data.vqa import sets
from aegis_cli.data.vqa.dataset import VQASet
from aegis_cli.models import backbones
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.recipes import Anchor as Settings


@dataclass(frozen=True)
class AnchorReport:
    """What was measured, and what it cost.

    Attributes:
        samples: questions; of files, at most as many as were asked for.
        skipped: bad questions that were left out.
        image_tokens, text_tokens: valid tokens in the moments (0 where those were not measured).
        layers: layers in the moments.
        directions: share of the directions of all maps' inputs whose eigenvectors were kept; None
            without inputs.
        seconds: wall time by part, without rendering the questions.
        megabytes: size of the file, in 10^6 bytes.
    """

    samples: int
    skipped: int
    image_tokens: int
    text_tokens: int
    layers: int
    directions: float | None
    seconds: dict[str, float]
    megabytes: float
    out: str
    sha256: str

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def run(backbone: str, settings: Settings, out: Path, on_event: OnEvent = ignore) -> AnchorReport:
    """Measure the parts asked for on `settings.samples` questions with images and answers.

    Files give at most as many as they hold. It runs in float32, so that neither batch size nor
    order shows in the result.
    """
    source = sets.read(settings.vqa, settings.skip_bad, on_event)
    files.check_writable(Path(out))
    files.check_apart("--out", Path(out), [*source.files, *backbones.model_files(backbone)])
    model = backbones.load(backbone).to(devices.pick())
    asked = source.choose(
        "anchor", settings.samples, settings.seed, [model.check_text], on_event
    ).sized(model.image_size)
    samples = len(asked.questions)
    anchor, seconds = _measure_parts(model, asked, settings, on_event)
    anchor_file.save(
        out,
        anchor,
        seed=settings.seed,
        inputs=source.sha256,
        fingerprint=model.fingerprint(),
        meta={
            "vqa": source.name,
            "samples": samples,
            "parts": sorted(set(settings.parts)),
            "energy": settings.energy,
        },
    )
    # Every layer sees the same tokens, so the first one's count is that of all.
    counts = [found[0].count if found else 0 for found in (anchor.image, anchor.text)]
    return AnchorReport(
        samples,
        asked.skipped,
        *counts,
        len(anchor.image),
        inputs.kept_share(anchor.inputs),
        seconds,
        Path(out).stat().st_size / 1e6,
        str(out),
        artifacts.sha256_file(out),
    )


def _measure_parts(
    model: Backbone, asked: VQASet, settings: Settings, on_event: OnEvent
) -> tuple[Anchor, dict[str, float]]:
    """The parts, always in one order, and the seconds each took."""
    image: Sequence[Moments] = ()
    text: Sequence[Moments] = ()
    spectra: dict[str, dict[str, Spectrum]] = {"inputs": {}, "curvature": {}}
    information: dict[str, Tensor] = {}
    seconds: dict[str, float] = {}
    for part in sorted(set(settings.parts)):
        start = time.perf_counter()
        if part == "moments":
            image, text = moments.measure(
                model, asked.batches(settings.batch_size), len(asked.questions), on_event
            )
        elif part == "inputs":
            spectra[part] = inputs.measure(
                model, asked, settings.energy, settings.batch_size, on_event
            )
        elif part == "curvature":
            spectra[part] = curvature.measure(
                model, asked, settings.energy, settings.seed, settings.batch_size, on_event
            )
        else:
            information = fisher.measure(
                model, asked, min(settings.fisher_samples, len(asked.questions)), on_event
            )
        seconds[part] = time.perf_counter() - start
    anchor = Anchor(image, text, spectra["inputs"], information, spectra["curvature"])
    return anchor, seconds
