"""`aegis run`: every stage of a recipe in order, skipping what is up to date by content, and one table."""

from __future__ import annotations

import dataclasses
import hashlib
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from aegis_cli import __version__, backbones, files, gl, methods
from aegis_cli import recipe as recipes
from aegis_cli.events import OnEvent, Progress, ignore
from aegis_cli.recipe import Recipe
from aegis_cli.stages import anchor, demos, probe, rollout, train
from aegis_cli.stages import device as devices
from aegis_cli.vqa.dataset import VQASet, load_scenes
from aegis_cli.vqa.metrics import Graded

STAMPS = "stages.json"
POLICY = ("backbone/model.safetensors", "expert.safetensors")  # the files of a checkpoint that a probe or rollout reads


@dataclass(frozen=True)
class Row:
    """One method: shares in [0, 1], drop in percentage points, cross-entropy in nats, W2^2 as a mean over layers."""

    method: str
    accuracy: float
    drop_points: float
    drop_interval: tuple[float, float]
    cross_entropy: float
    success_seen: float | None
    success_held_out: float | None
    w2: float
    energy_shed: float | None
    step_s: float
    step_time_ratio: float | None
    validation_loss: float


@dataclass(frozen=True)
class PipelineReport:
    """The recipe's table, also written to `table.json`."""

    name: str
    rows: list[Row]
    baseline_accuracy: float
    baseline_cross_entropy: float
    majority_accuracy: float
    out: str

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


def run(recipe: Recipe, root: Path, on_event: OnEvent = ignore) -> PipelineReport:
    """Run `recipe` under `root/<name>`; what a stage reads decides whether it runs again.

    Raises:
        AegisError: whatever a stage finds wrong; the stages before it are kept.
    """
    folder = Path(root) / recipe.name
    gl.check()
    files.make_folder(folder)
    job = _Job(recipe, folder, on_event)
    rows = [job.row(method) for method in recipe.methods]
    report = _report(recipe, job, rows, folder)
    files.save_json(folder / "table.json", report.to_json())
    return report


def _report(recipe: Recipe, job: _Job, rows: list[Row], folder: Path) -> PipelineReport:
    naive = next((row.step_s for row in rows if row.method == "naive"), None)
    if naive is not None:
        rows = [dataclasses.replace(row, step_time_ratio=row.step_s / naive) for row in rows]
    first = files.load_json(folder / recipe.methods[0] / "probe.json")
    return PipelineReport(
        recipe.name, rows, first["baseline_accuracy"], first["baseline_cross_entropy"], first["majority"], str(folder)
    )


class _Job:
    """A recipe on its way: where its files are, and which of them are up to date."""

    def __init__(self, recipe: Recipe, folder: Path, on_event: OnEvent) -> None:
        self.recipe, self.folder, self.on_event = recipe, folder, on_event
        path = folder / STAMPS
        self.stamps: dict[str, Any] = files.load_json(path) if path.exists() else {}

    # --- what the methods share ---------------------------------------------------------------

    @cached_property
    def demos(self) -> Path:
        path, settings = self.folder / "demos.safetensors", self.recipe.demos
        self.fresh(
            "demos", {"task": self.recipe.task, **dataclasses.asdict(settings)}, [path],
            lambda e: demos.run(self.recipe.task, settings.episodes, settings.seed, path, noise=settings.noise, on_event=e),
        )
        return path

    @cached_property
    def anchor(self) -> Path:
        path, settings = self.folder / "anchor.safetensors", self.recipe.anchor
        self.fresh(
            "anchor", {"backbone": self.backbone_sha256, **dataclasses.asdict(settings)}, [path],
            lambda e: anchor.run(
                self.recipe.backbone, settings.vqa, settings.samples, path, settings.batch_size, settings.seed, on_event=e
            ),
        )
        return path

    @cached_property
    def backbone_sha256(self) -> str:
        return files.sha256_file(backbones.locate(self.recipe.backbone))

    @cached_property
    def questions(self) -> VQASet:
        return load_scenes("probe", self.recipe.probe.questions, probe.PROBE_SEED, on_event=self.on_event)

    @cached_property
    def before(self) -> list[Graded]:
        model = backbones.load(self.recipe.backbone).to(devices.pick())
        return probe.ask(model, self.questions, self.recipe.probe.batch_size, self._named("baseline/probe"))

    # --- a method -----------------------------------------------------------------------------

    def row(self, method: str) -> Row:
        """Train, probe and roll out one method."""
        trained = self.train(method)
        probed = self.probe(method)
        success = {colors: self.rollout(method, colors)["success"] for colors in self.recipe.rollout.colors}
        return Row(
            method=method, accuracy=probed["accuracy"], drop_points=probed["drop_points"],
            drop_interval=tuple(probed["drop_interval"]), cross_entropy=probed["cross_entropy"],
            success_seen=success.get("seen"), success_held_out=success.get("held-out"),
            w2=sum(layer["w2"] for layer in probed["layers"]) / len(probed["layers"]),
            energy_shed=trained["energy_shed_mean"], step_s=trained["step_s"], step_time_ratio=None,
            validation_loss=trained["validation_loss"],
        )

    def train(self, method: str) -> dict[str, Any]:
        """The method's training report."""
        out = self.folder / method
        recipe = dataclasses.replace(self.recipe, train=dataclasses.replace(self.recipe.train, method=method))
        given = self.anchor if methods.get(method).combine else None  # the others never read it
        key = {
            "recipe": recipes.training_part(recipe), "backbone": self.backbone_sha256,
            "demos": files.sha256_file(self.demos), "anchor": given and files.sha256_file(given),
        }
        outputs = [out / "train.json", *(out / "checkpoints" / "last" / name for name in POLICY)]

        def make(on_event: OnEvent) -> None:
            # Of other settings, or finished and then damaged: nothing in it can be continued.
            if self._key_of(f"{method}/begun") != _digest(key) or self._key_of(f"{method}/train") == _digest(key):
                shutil.rmtree(out, ignore_errors=True)
                self.stamps.pop(f"{method}/train", None)
                self._stamp(f"{method}/begun", key, [])
            report = train.run(recipe, method, self.demos, given, out, resume=True, on_event=on_event)
            files.save_json(out / "train.json", report.to_json())

        self.fresh(f"{method}/train", key, outputs, make)
        return files.load_json(out / "train.json")

    def _policy_sha256(self, method: str) -> list[str]:
        last = self.folder / method / "checkpoints" / "last"
        return [files.sha256_file(last / name) for name in POLICY]

    def probe(self, method: str) -> dict[str, Any]:
        """The method's drift report."""
        path, settings = self.folder / method / "probe.json", self.recipe.probe
        key = {"policy": self._policy_sha256(method), "anchor": files.sha256_file(self.anchor)}
        key |= {"backbone": self.backbone_sha256, "settings": dataclasses.asdict(settings)}

        def make(on_event: OnEvent) -> None:
            model = backbones.load(str(self.folder / method)).to(devices.pick())
            before = backbones.load(self.recipe.backbone)
            moments = anchor.load(self.anchor, before.fingerprint())
            after = probe.ask(model, self.questions, settings.batch_size, on_event)
            layers = probe.drift(model, self.questions, moments, settings.batch_size)
            files.save_json(path, probe.compare(after, self.before, layers, settings.max_drop).to_json())

        self.fresh(f"{method}/probe", key, [path], make)
        return files.load_json(path)

    def rollout(self, method: str, colors: str) -> dict[str, Any]:
        """The method's success on seen or held-out colours."""
        path, settings = self.folder / method / f"rollout-{colors}.json", self.recipe.rollout
        key = {"policy": self._policy_sha256(method), "episodes": settings.episodes, "replan": settings.replan}

        def make(on_event: OnEvent) -> None:
            report = rollout.run(
                self.folder / method, None, settings.episodes, colors, replan=settings.replan, on_event=on_event
            )
            files.save_json(path, report.to_json())

        self.fresh(f"{method}/rollout {colors}", key, [path], make)
        return files.load_json(path)

    # --- up to date? --------------------------------------------------------------------------

    def fresh(self, stage: str, key: Any, outputs: list[Path], make: Callable[[OnEvent], object]) -> None:
        """Call `make` unless the stage ran with an equal key and its outputs are still what it wrote."""
        if self._key_of(stage) == _digest(key) and self.stamps[stage]["outputs"] == self._hashes(outputs):
            self.on_event(Progress(f"{stage} (up to date)", 1, 1, "stage"))
            return
        make(self._named(stage))
        self._stamp(stage, key, outputs)

    def _key_of(self, stage: str) -> str | None:
        return self.stamps.get(stage, {}).get("key")

    def _stamp(self, stage: str, key: Any, outputs: list[Path]) -> None:
        self.stamps[stage] = {"key": _digest(key), "outputs": self._hashes(outputs)}
        files.save_json(self.folder / STAMPS, self.stamps)

    def _hashes(self, outputs: list[Path]) -> dict[str, str]:
        """sha256 of each output that exists; a missing one makes the difference."""
        return {str(p.relative_to(self.folder)): files.sha256_file(p) for p in outputs if p.is_file()}

    def _named(self, stage: str) -> OnEvent:
        """A stage's own events under the name of what it does here: `aegis/train`, not `train`."""
        method, slash, _ = stage.partition("/")
        prefix = f"{method}/" if slash else ""
        return lambda event: self.on_event(dataclasses.replace(event, stage=prefix + event.stage))


def _digest(key: Any) -> str:
    return hashlib.sha256(files.canonical({"version": __version__, "key": key}).encode()).hexdigest()
