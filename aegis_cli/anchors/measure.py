"""`aegis anchor`: measure the pre-trained VLM once, on questions or on robot frames."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from aegis_cli.anchors import anchor_file, curvature, fisher, inputs, moments
from aegis_cli.anchors.kept_work import Work
from aegis_cli.common import artifacts, circumstances, devices, files, machine
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Warned, ignore, loading_told
from aegis_cli.common.ranks import Ranks, joined
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.moments import Moments
from aegis_cli.core.spectrum import Spectrum
from aegis_cli.data import demonstrations, mixture
from aegis_cli.data.selection import ALL, Selection
from aegis_cli.data.vqa import digests, sets
from aegis_cli.data.vqa.dataset import VQASet
from aegis_cli.data.vqa.images import tensors
from aegis_cli.models import backbones
from aegis_cli.models.backbones import preparation
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.recipes import Anchor as Settings

# The fewest samples with which `aegis`, which reads only moments, and `nullspace`, which reads
# directions, kept about as much as with 3,000 (docs/results/ablations.md). `kfac` lost more with
# 300.
FEWEST_FOR_MOMENTS, FEWEST = 30, 300


@dataclass(frozen=True)
class AnchorReport:
    """What was measured, and what it cost.

    Attributes:
        samples: questions or frames; fewer than requested if the files hold fewer.
        skipped: bad questions that were left out.
        image_tokens, text_tokens: valid tokens in the moments; None without moments.
        layers: layers in the moments; None without moments.
        directions: share of the directions of all maps' inputs whose eigenvectors were kept; None
            without inputs.
        entropy: entropy of the backbone's own distribution over the answers' words, in nats per
            word; None without curvature.
        seconds: wall time by part, without rendering the questions; includes the time before an
            interruption if its work was kept.
        megabytes: size of the file, in 10^6 bytes.
    """

    samples: int
    skipped: int
    image_tokens: int | None
    text_tokens: int | None
    layers: int | None
    directions: float | None
    entropy: float | None
    seconds: dict[str, float]
    megabytes: float
    out: str
    sha256: str

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def run(
    backbone: str,
    settings: Settings,
    out: Path,
    on_event: OnEvent = ignore,
    demos: Path | None = None,
    selection: Selection = ALL,
    keep: bool = True,
) -> AnchorReport:
    """Measure the requested parts on `settings.samples` questions with images and answers.

    If files hold fewer questions, all of them are used. Passes run in float32, so the result
    depends neither on the batch size nor on the number of processes; if only a share of the tokens
    is read (`settings.tokens`), which tokens are drawn depends on both.

    If torchrun has started several processes, each calls this, and they share the passes.

    Progress is saved in the cache until the anchor is written. A call with the same inputs after an
    interruption resumes, and on a CPU gives the same bytes.

    Args:
        demos: with the source `demos`, the demonstrations whose frames are read instead, each with
            its instruction.
        selection: which of their frames; only images and instructions are read.
        keep: whether progress is saved, and saved progress is used.

    Raises:
        AegisError: inputs that cannot be read, or parts that cannot be measured on frames.
    """
    with joined() as ranks:
        _warn_of_unread(settings, on_event)
        if settings.source == "demos":
            shown = replace(selection, state=(), action=())
            measured = _on_frames(
                backbone, settings, Path(out), demos, shown, on_event, ranks, keep
            )
        else:
            measured = _on_questions(backbone, settings, Path(out), on_event, ranks, keep)
        if measured.entropy is not None:
            curvature.warn_of_sure_answers(
                measured.entropy,
                settings.temperature,
                "anchor",
                "kfac may lose the others: measure again with anchor.temperature 4 (--temperature "
                "4), or on harder questions",
                on_event,
            )
        _warn_of_few(measured.samples, settings, on_event)
        report = ranks.by_first(lambda: _written(measured, backbone, settings, Path(out)))
        measured.work.remove()
        return report


# Setting -> the part that reads it, for settings that only one part reads.
_READ_BY = {
    "energy": ("inputs", "curvature"),
    "exact_width": ("inputs", "curvature"),
    "memory": ("inputs", "curvature"),
    "tokens": ("inputs",),
    "temperature": ("curvature",),
    "fisher_samples": ("fisher",),
}


def _warn_of_unread(settings: Settings, on_event: OnEvent) -> None:
    """Warn about settings of parts that are not measured."""
    for name, parts in _READ_BY.items():
        value = getattr(settings, name)
        if value != getattr(Settings(), name) and not set(parts) & set(settings.parts):
            text = (
                f"anchor.{name}: {value:g} changes nothing without {' or '.join(parts)} among the "
                f"parts that are measured: {', '.join(settings.parts)}"
            )
            on_event(Warned("anchor", text))


def _warn_of_few(samples: int, settings: Settings, on_event: OnEvent) -> None:
    """Warn about an anchor measured on too few samples."""
    others = sorted(set(settings.parts) - {"moments"})
    fewest = FEWEST if others else FEWEST_FOR_MOMENTS
    if samples >= fewest:
        return
    of = "robot frames" if settings.source == "demos" else "questions"
    more = "Raise --samples (anchor.samples of a recipe), or give more data"
    if samples < settings.samples:
        more = "Give more data"
        if settings.source != "demos":
            more += ": the questions about four of ten images are for anchors"
    text = (
        f"measured on {samples:,} {of}, and {', '.join(others or ['moments'])} need at least "
        f"{fewest} to tell what the backbone knows: methods that read them may protect less. {more}"
    )
    on_event(Warned("anchor", text))


def _written(measured: _Measured, backbone: str, settings: Settings, out: Path) -> AnchorReport:
    """Write the anchor of the backbone of this name."""
    anchor = measured.anchor
    anchor_file.save(
        out,
        anchor,
        seed=settings.seed,
        inputs=measured.inputs,
        fingerprint=measured.fingerprint,
        meta={
            artifacts.BACKBONE: backbone,
            **measured.meta,
            **({preparation.META: dict(measured.prepares)} if measured.prepares else {}),
            "samples": measured.samples,
            "parts": sorted(set(settings.parts)),
            "energy": settings.energy,
            **({} if settings.tokens == 1 else {"tokens": settings.tokens}),
            **({} if settings.temperature == 1 else {"temperature": settings.temperature}),
        },
    )
    # Every layer sees the same tokens, so the first layer's count holds for all.
    image, text = (found[0].count if found else None for found in (anchor.image, anchor.text))
    return AnchorReport(
        samples=measured.samples,
        skipped=measured.skipped,
        image_tokens=image,
        text_tokens=text,
        layers=len(anchor.image) or None,
        directions=inputs.kept_share(anchor.inputs),
        entropy=measured.entropy,
        seconds=measured.seconds,
        megabytes=out.stat().st_size / 1e6,
        out=str(out),
        sha256=artifacts.sha256_file(out),
    )


@dataclass(frozen=True)
class _Measured:
    """An anchor and what its file says about it.

    Attributes:
        prepares: the settings by which the backbone makes its inputs.
        inputs: name -> sha256 of the data it was measured on.
        meta: how that data is named in the file's header.
        work: the progress that is saved until the anchor is written.
        entropy: entropy of the answers, in nats per word; None without curvature.
    """

    anchor: Anchor
    fingerprint: str
    prepares: Mapping[str, str]
    samples: int
    skipped: int
    seconds: dict[str, float]
    inputs: Mapping[str, str]
    meta: Mapping[str, Any]
    work: Work
    entropy: float | None = None


def _on_questions(
    backbone: str, settings: Settings, out: Path, on_event: OnEvent, ranks: Ranks, keep: bool
) -> _Measured:
    source = sets.read(settings.vqa, settings.skip_bad, on_event, settings.ask)
    files.check_utf8(out, "choose another --out")
    files.check_writable(out)
    files.check_apart("--out", out, [*source.files, *backbones.model_files(backbone)])
    with loading_told("anchor", on_event):
        model = backbones.load(backbone).to(devices.pick())
    asked = source.choose(
        "anchor", settings.samples, settings.seed, [model.check_text], on_event
    ).sized(model.image_size)
    fingerprint = ranks.by_first(model.fingerprint)

    def read() -> dict[str, Any]:
        # Their order, and which of them share an image, decide the batches.
        shown = [digests.of_questions(asked), asked.image_of.tolist()]
        return {"questions": files.sha256_value(shown)}

    about = _about(model, fingerprint, settings, ranks, read) if keep else None
    work = Work(about, ranks, on_event)
    entropy = curvature.AnswerEntropy()
    part = _PartMeasurement(model, asked, settings, on_event, ranks, work, entropy)
    anchor, seconds = part.parts()
    return _Measured(
        anchor,
        fingerprint=fingerprint,
        prepares=model.preparation(),
        samples=len(asked.questions),
        skipped=asked.skipped,
        seconds=seconds,
        inputs=source.sha256,
        meta={"vqa": source.name} | ({} if source.ask == sets.PLAIN else {"ask": source.ask}),
        work=work,
        entropy=entropy.mean(ranks) if "curvature" in settings.parts else None,
    )


def _about(
    model: Backbone,
    fingerprint: str,
    settings: Settings,
    ranks: Ranks,
    read: Callable[[], Mapping[str, Any]],
) -> dict[str, Any]:
    """Everything that a measurement depends on, by which its saved progress is found.

    Args:
        read: returns what identifies the data; called by the first process only.
    """
    return {
        "weights": fingerprint,
        "settings": model.settings(),
        "anchor": asdict(settings),
        "processes": ranks.count,
        # Sums of a CPU are split among its threads, so their number decides how they are rounded.
        "threads": torch.get_num_threads() if model.device.type == "cpu" else None,
        **ranks.by_first(lambda: {**read(), **circumstances.of_answers()}),
    }


def _on_frames(
    backbone: str,
    settings: Settings,
    out: Path,
    demos: Path | None,
    selection: Selection,
    on_event: OnEvent,
    ranks: Ranks,
    keep: bool,
) -> _Measured:
    """The moments of frames of episodes, drawn without repetition, with their instructions."""
    demos = _check_frames(settings, demos)
    files.check_utf8(out, "choose another --out")
    files.check_writable(out)
    files.check_apart("--out", out, [demos, *backbones.model_files(backbone)])
    mixture.check_rename((demos,), selection.rename)
    with loading_told("anchor", on_event):
        model = backbones.load(backbone).to(devices.pick())
    # None: all episodes are held out from training, so all their frames are in `validation`.
    found = demonstrations.load(
        demos, None, 0, selection, model.image_size, on_event=on_event, cache=False
    )
    order = np.random.default_rng(settings.seed).permutation(len(found.validation))
    # Drawn at random, but read in order, since videos are decoded in order.
    frames = found.validation[torch.from_numpy(np.sort(order[: settings.samples]))]
    fingerprint = ranks.by_first(model.fingerprint)
    of = {"demos": found.sha256, "frames": frames.tolist(), "selection": repr(selection)}
    of |= machine.versions(("av",))  # which decodes videos
    about = _about(model, fingerprint, settings, ranks, lambda: of) if keep else None
    work, start = Work(about, ranks, on_event), time.perf_counter()

    def read(rows: torch.Tensor) -> moments.Read:
        texts = [found.instructions[i] for i in found.instruction_of[rows].tolist()]
        return found.images(rows), texts

    meta: dict[str, Any] = {"demos": demos.name}
    if selection.only is not None:
        meta["only"] = selection.only
    if found.cameras:
        meta["cameras"] = list(found.cameras)
    batches = frames.split(settings.batch_size)
    image, text = moments.measure_passes(model, batches, read, len(frames), on_event, ranks, work)
    return _Measured(
        Anchor(image, text),
        fingerprint=fingerprint,
        prepares=model.preparation(),
        samples=len(frames),
        skipped=0,
        seconds={"moments": work.before_s + time.perf_counter() - start},
        inputs={"demos": found.sha256},
        meta=meta,
        work=work,
    )


def _check_frames(settings: Settings, demos: Path | None) -> Path:
    """The demonstrations' path.

    Raises:
        AegisError: parts that need answers, or no demonstrations.
    """
    others = sorted(set(settings.parts) - {"moments"})
    if others:
        raise AegisError(
            f"{', '.join(others)} of robot frames",
            "only moments: the other parts need answers, which frames do not have",
            "--parts moments, or leave --demos out",
        )
    if demos is None:
        raise AegisError(
            "an anchor of robot frames without demonstrations",
            "a file, or a LeRobot folder",
            "record some with aegis demos, and give them as --demos",
        )
    return demos


@dataclass(frozen=True)
class _PartMeasurement:
    """The questions that each part is measured on, and how.

    Attributes:
        work: the saved progress of the parts.
        entropy: counts the answers of the curvature.
    """

    model: Backbone
    asked: VQASet
    settings: Settings
    on_event: OnEvent
    ranks: Ranks
    work: Work
    entropy: curvature.AnswerEntropy

    def parts(self) -> tuple[Anchor, dict[str, float]]:
        """The requested parts, always in the same order, and the seconds each took."""
        measures = {
            "moments": self._moments,
            "inputs": self._inputs,
            "curvature": self._curvature,
            "fisher": self._fisher,
        }
        found: dict[str, Any] = {}
        seconds: dict[str, float] = {}
        for part in sorted(set(self.settings.parts)):
            start, before_s = time.perf_counter(), self.work.before_s
            found[part] = measures[part]()
            seconds[part] = self.work.before_s - before_s + time.perf_counter() - start
        image, text = found.pop("moments", ((), ()))
        return Anchor(image, text, **found), seconds

    def _moments(self) -> tuple[list[Moments], list[Moments]]:
        count, size = len(self.asked.questions), self.settings.batch_size
        # As rows, so that no image is decoded for a batch that was passed before.
        batches = [slice(first, first + size) for first in range(0, count, size)]

        def read(rows: slice) -> moments.Read:
            part = self.asked.part(rows)
            return tensors(part.images[part.image_of]), [q.text for q in part.questions]

        return moments.measure_passes(
            self.model, batches, read, count, self.on_event, self.ranks, self.work
        )

    def _inputs(self) -> dict[str, Spectrum]:
        return inputs.measure(
            self.model,
            self.asked,
            self.settings.energy,
            self.settings.batch_size,
            self.on_event,
            memory=self._memory,
            whole=self.settings.exact_width,
            ranks=self.ranks,
            drawn=inputs.Drawn(self.settings.tokens, self.settings.seed),
            work=self.work,
        )

    def _curvature(self) -> dict[str, Spectrum]:
        return curvature.measure(
            self.model,
            self.asked,
            self.settings.energy,
            self.settings.seed,
            self.settings.batch_size,
            self.on_event,
            memory=self._memory,
            whole=self.settings.exact_width,
            ranks=self.ranks,
            temperature=self.settings.temperature,
            entropy=self.entropy,
            work=self.work,
        )

    def _fisher(self) -> dict[str, Tensor]:
        samples = min(self.settings.fisher_samples, len(self.asked.questions))
        return fisher.measure(self.model, self.asked, samples, self.on_event, self.ranks, self.work)

    @property
    def _memory(self) -> int | None:
        """Bytes that the sums of a group of maps may take; None: all maps are one group."""
        return None if self.settings.memory is None else self.settings.memory * 10**6
