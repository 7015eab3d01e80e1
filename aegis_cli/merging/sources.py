"""What can be merged: the run of a policy, or a folder of a fine-tuned model."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from aegis_cli import recipes
from aegis_cli.anchors import curvature, inputs
from aegis_cli.common import artifacts, devices, files, machine
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, loading_told
from aegis_cli.core.ledger import Ledger
from aegis_cli.core.spectrum import Spectrum
from aegis_cli.data import mixture
from aegis_cli.data.demonstrations import Demonstrations
from aegis_cli.data.selection import Paths
from aegis_cli.data.vqa import digests, sets
from aegis_cli.data.vqa.dataset import VQASet
from aegis_cli.data.vqa.metrics import score
from aegis_cli.evaluation import kept_answers, probe
from aegis_cli.merging import task_factors
from aegis_cli.merging.settings import MergeSettings
from aegis_cli.methods import ledger_file
from aegis_cli.models import backbones
from aegis_cli.models.asking import ask
from aegis_cli.models.backbones import model_folder
from aegis_cli.models.backbones.base import STORED_TYPES, Backbone
from aegis_cli.training import checkpoint, loading, train
from aegis_cli.training import folder as run_folder
from aegis_cli.training import inputs as places

_CARD = """# `{method}` merge of strength {strength:g}

The fine-tuned model was moved back towards the pre-trained `{base}` by `aegis merge`, which kept
{percent:.1f} % of the displacement of its maps{damped}.
"""


class Source(Protocol):
    """A fine-tuned backbone, its pre-trained one, and the task of the fine-tuning.

    Attributes:
        backbone: fine-tuned; a merge changes its weights.
        base: pre-trained, on the same device.
        base_name: as the user names it.
    """

    backbone: Backbone
    base: Backbone
    base_name: str

    def task_spectra(self, part: str) -> dict[str, Spectrum]:
        """An anchor's `part` ("inputs" or "curvature"), but measured on the task."""

    def performance(self) -> dict[str, float]:
        """How well the task is done on validation data: `validation_loss` or `task_accuracy`.

        It is empty if there is no such data.
        """

    def judged_by(self) -> dict[str, Any]:
        """Everything that `performance` depends on, as JSON, including the current weights."""

    def write(self, out: Path, merged: Mapping[str, Any]) -> None:
        """Write the merged weights, all or nothing; `merged` says how they were made."""


def find(target: str, settings: MergeSettings, on_event: OnEvent) -> Source:
    """The source that a user names: a run, one of its checkpoints, or a model with its `--base`.

    Raises:
        AegisError: nothing that can be merged, or a pre-trained model that does not belong to it.
    """
    path = Path(target)
    if recipes.is_stream_run(path):
        raise AegisError(
            f"'{target}', the run of a stream",
            "the run of one policy, or a model with --base",
            "merge a run that aegis train wrote from a recipe of kind policy",
        )
    if (path / "checkpoints").is_dir() or checkpoint.is_one(path):
        return PolicyRun(path, settings, on_event)
    return ModelFolder(target, settings, on_event)


# --- the run of a policy --------------------------------------------------------------------------


class PolicyRun:
    """A run of `aegis train`, or one of its checkpoints."""

    def __init__(self, path: Path, settings: MergeSettings, on_event: OnEvent) -> None:
        if settings.task_vqa is not None:
            raise AegisError(
                f"--task-vqa with the run '{path}'",
                "demonstrations: a policy's task is on robot frames",
                "leave --task-vqa out, and give --demos",
            )
        self._settings, self._on_event = settings, on_event
        self._checkpoint = checkpoint.chosen(path)
        self._run = _run_of(path)
        self._recipe = recipes.load(self._run / "recipe.yaml")
        self._header = artifacts.read_header(self._checkpoint / checkpoint.EXPERT)
        self.base_name = settings.base or self._recipe.backbone
        with loading_told("merge", on_event):
            self.base = backbones.load(self.base_name).to(devices.pick())
            self._check_base()  # before loading the policy, which is equally large
            policy, self._meta = checkpoint.load_policy(self._checkpoint)
        self._policy = policy.to(devices.pick())
        self.backbone = self._policy.backbone
        _check_alike(self.backbone, self.base)

    def task_spectra(self, part: str) -> dict[str, Spectrum]:
        frames = self._settings.frames
        if part == "inputs":
            return task_factors.inputs(self._policy, self._demos, frames, self._on_event)
        samples = self._recipe.train.flow_samples
        return task_factors.curvature(self._policy, self._demos, frames, samples, self._on_event)

    def performance(self) -> dict[str, float]:
        noise = train.validation_noise(self._recipe.seed)
        loss = train.validation_loss(self._policy, self._demos, self._recipe.train, noise)
        return {"validation_loss": loss}

    def judged_by(self) -> dict[str, Any]:
        return {
            "policy": self._policy.fingerprint(),
            "demos": self._demos.sha256,
            "recipe": files.sha256_file(self._run / "recipe.yaml"),
            **machine.versions(("av",)),  # which decodes videos
        }

    def write(self, out: Path, merged: Mapping[str, Any]) -> None:
        step = checkpoint.step_of(self._checkpoint)
        made_from = {**self._header.inputs, "tuned": self._header.fingerprint or ""}

        def fill(folder: Path) -> None:
            self._copy_records(folder, out, step)
            # The same path as in a run, so that code that reads a run also reads the merge.
            target = folder / "checkpoints" / f"{step:06d}"
            target.mkdir(parents=True)
            checkpoint.write_policy(
                target,
                self.backbone,
                self._policy,
                {**self._meta, "merge": dict(merged)},
                made_from,
                self._recipe.seed,
                self._card(merged),
            )
            checkpoint.point_last_at(target)

        _write_whole(out, fill)

    def _copy_records(self, folder: Path, out: Path, step: int) -> None:
        """Copy the records of the training; log and ledger up to the merged step.

        Args:
            folder: where they are written.
            out: the final path of that folder.
        """
        for name in ("recipe.yaml", run_folder.METRICS, machine.NAME):
            # Earlier versions recorded neither the machine nor the paths of the inputs.
            if name != machine.NAME or (self._run / name).is_file():
                shutil.copyfile(self._run / name, folder / name)
        if (kept := places.of(self._run)) is not None:
            places.keep(folder, kept, out, places.began_in(self._run), self._run)
        # For a checkpoint before the last one, later steps do not count.
        run_folder.truncate_metrics(folder, step)
        saved = artifacts.load(self._run / "ledger.safetensors", "ledger")
        header = saved.header
        ledger = Ledger.from_tensors(header.meta["groups"], header.meta["layers"], saved.tensors)
        ledger.truncate(step)
        path = folder / "ledger.safetensors"
        ledger_file.save(path, ledger, header.meta, header.inputs, header.seed)

    def _check_base(self) -> None:
        """Raise AegisError unless the training started from the base."""
        if self.base.fingerprint() != self._header.inputs.get("backbone"):
            raise AegisError(
                f"the backbone '{self.base_name}', whose weights are others than those that "
                f"'{self._run}' began with",
                "the pre-trained backbone of the run",
                "give the one that it was trained from as --base",
            )

    @cached_property
    def _demos(self) -> Demonstrations:
        """The demonstrations that the policy was trained on, with the same split."""
        wanted = self._header.inputs["demos"]
        paths = self._settings.demos or self._find_demos(wanted)
        found = loading.load_demonstrations(self._recipe, self.base, paths, self._on_event)
        # Other demonstrations have another split, so the policy may have trained on what it holds
        # out.
        if found.sha256 != wanted:
            raise AegisError(
                f"other demonstrations in {mixture.said(paths)} than those of the run "
                f"'{self._run}'",
                "those that the policy was trained on, of which some were held out",
                "give these as --demos",
            )
        return found

    def _find_demos(self, wanted: str) -> Paths:
        """Their path in the run's records, in its recipe, or of a file beside it."""
        kept = places.of(self._run)
        if kept is not None and not any(map(places.is_gone, kept.demos)):
            return tuple(map(Path, kept.demos))
        if self._recipe.demos.path is not None:
            return mixture.at(self._recipe.demos.path)
        for path in sorted(self._run.resolve().parent.glob("*.safetensors")):
            if files.sha256_file(path) == wanted:
                return path
        raise AegisError(
            f"no demonstrations of the run '{self._run}' beside it",
            "those that it was trained on",
            "give them: --demos FILE",
        )

    def _card(self, merged: Mapping[str, Any]) -> str:
        """The model card of a Hugging Face backbone, with a section about the merge."""
        before = self._checkpoint / checkpoint.BACKBONE / "README.md"
        if not before.is_file():
            return ""
        said = before.read_text(encoding="utf-8")
        # One heading level below the card's own.
        return said + "\n" + _card(merged).replace("# ", "## ", 1)


def _run_of(path: Path) -> Path:
    """The run's own folder, which has the recipe."""
    if (path / "recipe.yaml").is_file():
        return path
    run = checkpoint.run_of(path)
    if run is None:
        raise AegisError(
            f"the checkpoint '{path}' outside a run",
            "one in its run, whose recipe says how it was trained",
            "give the run, or merge the model alone: its folder 'backbone' with --base",
        )
    return run


# --- a model --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Asked:
    """The task's questions: those for measuring, and those for validation."""

    measured: VQASet
    validation: VQASet


class ModelFolder:
    """A fine-tuned model, ours or from the Hugging Face Hub; its task, if any, is questions."""

    def __init__(self, target: str, settings: MergeSettings, on_event: OnEvent) -> None:
        if settings.base is None:
            raise AegisError(
                f"'{target}', which is no run, without --base",
                "the pre-trained model too",
                "add --base, or give the folder of a run",
            )
        if settings.demos is not None:
            raise AegisError(
                f"--demos with '{target}', which has no action expert",
                "a run, whose policy tells what robot frames need",
                "give the run's folder, or the task as questions: --task-vqa SET",
            )
        self._settings, self._on_event, self.base_name = settings, on_event, settings.base
        with loading_told("merge", on_event):
            self.backbone = backbones.load(target).to(devices.pick())
            self.base = backbones.load(settings.base).to(devices.pick())
        _check_alike(self.backbone, self.base)

    def task_spectra(self, part: str) -> dict[str, Spectrum]:
        settings, asked = self._settings, self._asked
        if asked is None:
            raise AegisError(
                f"method '{settings.method}' for a model without a run or --task-vqa",
                "what the fine-tuning was for: a policy's run, or questions of the task",
                "add --task-vqa SET, or --method linear or kfac-shrink, which do not ask that",
            )
        if part == "inputs":
            return inputs.measure(
                self.backbone, asked.measured, 1.0, settings.batch_size, self._on_event
            )
        return curvature.measure(
            self.backbone, asked.measured, 1.0, 0, settings.batch_size, self._on_event
        )

    def performance(self) -> dict[str, float]:
        if self._asked is None:
            return {}
        asked, size = self._asked.validation, self._settings.batch_size
        graded = ask(self.backbone, asked, size, self._on_event)
        return {"task_accuracy": score(graded).accuracy}

    def judged_by(self) -> dict[str, Any]:
        asked = None if self._asked is None else digests.of_questions(self._asked.validation)
        size = self._settings.batch_size
        return {**kept_answers.about(self.backbone), "questions": asked, "batch_size": size}

    def write(self, out: Path, merged: Mapping[str, Any]) -> None:
        def fill(folder: Path) -> None:
            # In the fine-tuned model's own dtype, unlike a policy's run, whose checkpoints are
            # float32.
            self.backbone.round_weights(STORED_TYPES[self.backbone.stored])
            self.backbone.save(folder)
            if model_folder.is_model(folder):
                stored = f"\nThe weights are stored in {self.backbone.stored}.\n"
                files.write_text(folder / "README.md", _card(merged) + stored)

        _write_whole(out, fill)

    @cached_property
    def _asked(self) -> _Asked | None:
        settings = self._settings
        if settings.task_vqa is None:
            return None
        source = sets.read(settings.task_vqa, settings.skip_bad, self._on_event, settings.ask)
        checks = [self.backbone.check_text]
        measured, validation = (
            source.choose(part, count, probe.PROBE_SEED, checks, self._on_event)
            for part, count in (("anchor", settings.samples), ("validation", settings.questions))
        )
        return _Asked(measured.sized(self.backbone.image_size), validation)


def _card(merged: Mapping[str, Any]) -> str:
    # A linear merge reads no curvature that could be damped.
    damped = "" if merged["method"] == "linear" else f". Damping {merged['damping']:g}"
    return _CARD.format(percent=100 * merged["kept"], damped=damped, **merged)


def _check_alike(tuned: Backbone, base: Backbone) -> None:
    """Raise AegisError unless both have the same parameters, whatever their values."""
    shapes, wanted = (
        {name: list(parameter.shape) for name, parameter in model.named_parameters()}
        for model in (tuned, base)
    )
    differing = [
        f"{name} {shapes.get(name, 'missing')} instead of {wanted.get(name, 'none')}"
        for name in sorted(shapes.keys() | wanted.keys())
        if shapes.get(name) != wanted.get(name)
    ]
    # The order counts too: `Displacement` walks through both models side by side.
    if differing or list(shapes) != list(wanted):
        shown = ", ".join(differing[:3]) or "another order of the parameters"
        more = f" and {len(differing) - 3} more" if len(differing) > 3 else ""
        raise AegisError(
            f"two models of other shapes: {shown}{more}",
            "a fine-tuned model and the one that it was fine-tuned from",
            "give the pre-trained model that it began as: --base",
        )


def check_moved(source: Source) -> None:
    """Raise AegisError if nothing can be moved back."""
    pairs = zip(source.backbone.parameters(), source.base.parameters(), strict=True)
    if not any(has_moved(source, now, before) for now, before in pairs):
        raise AegisError(
            "the same weights in the fine-tuned and the pre-trained model",
            "a backbone that has moved",
            "merge a run of a method that trains the backbone",
        )


def has_moved(source: Source, now: Tensor, before: Tensor) -> bool:
    """Whether a parameter has changed by more than rounding.

    A model that is stored in half precision may be fine-tuned from one in float32.
    """
    rounded = before.to(STORED_TYPES[source.backbone.stored]).to(now.dtype)
    return not (torch.equal(now, before) or torch.equal(now, rounded))


def check_out(out: Path) -> None:
    """Raise AegisError unless a folder can be written there without replacing another."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise AegisError(f"'{out}' is not empty", "a new or empty folder", "choose another --out")
    files.make_folder(out.parent)
    if not os.access(out.parent, os.W_OK):
        raise AegisError(f"'{out}' cannot be written", "a writable folder", "choose another --out")


def _write_whole(out: Path, fill: Callable[[Path], None]) -> None:
    """Let `fill` write a temporary folder, and rename it to `out`."""
    out = out.resolve()
    with checkpoint.writing(out), files.folder_aside(out) as aside:
        fill(aside)
        files.put(aside, out)
