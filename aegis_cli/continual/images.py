"""Streams of classification tasks: a dual encoder learns pictures by the names of their classes.

The tasks come from a shipped stream or from image folders. A task is learned by the cross-entropy
over its own classes. The evaluation measures the accuracy on every task, with the task told and
with the task inferred.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from aegis_cli.common import cache, devices, prefetch
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Progress, Warned, ignore
from aegis_cli.common.files import sha256_value
from aegis_cli.continual import files, learners
from aegis_cli.continual.learners.base import Learner
from aegis_cli.continual.report import ImageStreamReport, StreamReport, as_rows
from aegis_cli.continual.state import WHOLE, StreamRun
from aegis_cli.core import routing
from aegis_cli.core.accuracy_matrix import scores
from aegis_cli.core.gaussians import NONE, Gaussian, fit, infer
from aegis_cli.core.routing import Routed, activate
from aegis_cli.data import spread, streams
from aegis_cli.data.batch import Share
from aegis_cli.data.streams import folders, mtil
from aegis_cli.data.streams.contract import Part, StreamTask
from aegis_cli.models import backbones
from aegis_cli.models.backbones.dual import DualEncoder, class_weights
from aegis_cli.recipes import VALIDATION, StreamRecipe

# Number of evenly spaced training images on which routers are measured. They are always the same,
# so nothing is drawn at random. They need a gradient, so there are no more than in a step.
CALIBRATION_IMAGES = 64
EVALUATION_BATCH = 256  # images at a time when no gradient is needed
ENCODER = "encoder"  # subfolder of the run folder for an encoder that the run has trained
OWN_ENCODER = "trained encoder"  # name of that encoder among a report's inputs


# --- the run --------------------------------------------------------------------------------------


@dataclass(kw_only=True)
class ImageStreamRun(StreamRun[StreamRecipe]):
    """A run through a stream of classification tasks.

    Attributes:
        encoder: the dual encoder that learns.
        tasks: the stream's tasks in order.
        image_set: digest that identifies the tasks' images.
        prototypes: mean feature [D] of the training images in the bare encoder, for each task so
            far; empty for a learner that does not compare them.
    """

    encoder: DualEncoder
    tasks: tuple[StreamTask, ...]
    image_set: str
    prototypes: list[Tensor] = field(default_factory=list)

    @property
    def score_name(self) -> str:
        return "accuracy"

    @property
    def model(self) -> DualEncoder:
        return self.encoder

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(task.name for task in self.tasks)

    def objective(self, task: int) -> ClassificationLoss:
        return ClassificationLoss(self.tasks[task], self.encoder, self.recipe.train.label_smoothing)

    @property
    def inputs(self) -> dict[str, str]:
        return {**super().inputs, "encoder": self.fingerprint, "image set": self.image_set}

    @cached_property
    def evaluator(self) -> ImageEvaluator:
        """The evaluator of the run; it caches what never changes from row to row."""
        return ImageEvaluator(self.encoder, self.sites, self.tasks, self.learner)

    def before_task(self) -> list[Tensor]:
        """Prototypes for a learner that compares them, and a Gaussian of the task's early features.

        A learner with one state for all tasks does not have to infer the task.
        """
        task = self.current.task
        if self.learner.compares:
            # A resumed run starts from the first task. Its state holds no prototypes, but the bare
            # encoder gives the same ones again.
            for i in range(len(self.prototypes), task + 1):
                features = self.evaluator.bare(self.tasks[i].train)  # [N, D]
                mean = features.double().mean(0)
                self.prototypes.append(mean.float().cpu())
        # For a resumed task, the Gaussian is in the state.
        if not self.learner.shared and len(self.gaussians) == task:
            settings = self.recipe.inference
            looks = self.evaluator.looks(self.tasks[task].train)
            found = fit(looks, settings.rank, settings.shrinkage, settings.quantile)
            self.gaussians.append(found)
        return self.prototypes

    def after_task(self) -> dict[str, float]:
        told, inferred = self.evaluator.row(self.current.task, self.gaussians)
        self.current.oracle.append(told)
        self.current.inferred.append(inferred)
        return {}

    def measure_again(
        self, before: StreamReport, on_event: OnEvent
    ) -> tuple[ImageStreamReport, int]:
        assert isinstance(before, ImageStreamReport)
        count = len(self.tasks)
        oracle, inferred = list(before.oracle), list(before.inferred)
        # If a learner does not freeze a learned task's weights, those of earlier rows are gone.
        rows = range(count) if self.learner.frozen else [count - 1]
        for done, t in enumerate(rows, 1):
            told, guessed = self.evaluator.row(t, self.gaussians[: t + 1])
            oracle[t], inferred[t] = tuple(told), tuple(guessed)
            on_event(Progress("probe", done, len(rows), "rows"))
        found = dataclasses.replace(
            before,
            oracle=tuple(oracle),
            inferred=tuple(inferred),
            scores=scores(oracle),
            inferred_scores=scores(inferred),
        )
        return found, len(rows)

    def report(self) -> ImageStreamReport:
        current = self.current
        return ImageStreamReport(
            **self.summary(),
            stream=self.recipe.stream,
            path=self.recipe.path,
            split=self.recipe.split,
            oracle=as_rows(current.oracle),
            inferred=as_rows(current.inferred),
            scores=scores(current.oracle),
            inferred_scores=scores(current.inferred),
            inference_parameters=sum(g.count() for g in self.gaussians),
            inputs=self.measured_with(),
        )

    def measured_with(self) -> dict[str, str]:
        """Digests of the inputs, and of the final encoder if the run has trained it."""
        trained = self.learner.trains == "model"
        own = {OWN_ENCODER: self.encoder.fingerprint()} if trained else {}
        return {**self.inputs, **own}

    def save_model(self) -> None:
        if self.learner.trains == "model":
            self.encoder.save(self.out / ENCODER)


def build(recipe: StreamRecipe, out: Path, on_event: OnEvent = ignore) -> ImageStreamRun:
    """Build encoder, tasks and learner; the encoder's maps can have experts, but have none yet.

    Raises:
        AegisError: no such encoder, stream or task, or names that the text tower cannot read.
    """
    learner = learners.get(recipe.train.method)
    model = encoder(recipe.encoder).to(devices.pick()).eval()
    found = tasks(recipe, model.image_size, on_event)
    if recipe.split == VALIDATION:  # settings must be chosen without the test parts
        found = on_validation(found)
    fingerprint = model.fingerprint()  # of the bare encoder, before experts are added
    model.requires_grad_(False)
    for task in found:  # a name that cannot be read is refused before anything is written
        _check_words(model, task, recipe.path)
    sites = routing.route(model, model.sites()) if learner.trains == "experts" else {}
    return ImageStreamRun(
        recipe=recipe,
        learner=learner,
        encoder=model,
        sites=sites,
        tasks=found,
        fingerprint=fingerprint,
        out=out,
        image_set=_checked_image_set(recipe, on_event),
    )


def _check_words(model: DualEncoder, task: StreamTask, path: str | None) -> None:
    """Raise AegisError if the text tower cannot read a task's words, and say where they are."""
    try:
        class_weights(model, task.classes, task.templates)
    except AegisError as error:
        if path is None:
            raise
        paths = [
            str(Path(path) / task.name / name) for name in (folders.TEMPLATES, folders.CLASSES)
        ]
        fix = f"sentences that it knows in '{paths[0]}', words for the classes in '{paths[1]}'"
        raise AegisError(error.found, error.expected, f"{error.fix}; {fix}") from error


def load(
    recipe: StreamRecipe, path: Path, before: StreamReport, on_event: OnEvent = ignore
) -> ImageStreamRun:
    """Load a finished run in its final state, to measure it again.

    Args:
        before: the run's report.

    Raises:
        AegisError: files are missing or damaged, or the images, words or encoder are not those
            that the run was measured with.
    """
    if (path / ENCODER).is_dir():
        recipe = dataclasses.replace(recipe, encoder=str(path / ENCODER))
    run = build(recipe, path, on_event)
    now = run.measured_with()
    # A run that trained its encoder no longer needs the one that it started from.
    needed = [OWN_ENCODER if OWN_ENCODER in now else "encoder", "image set"]
    if changed := [name for name in needed if before.inputs.get(name) != now[name]]:
        raise AegisError(
            f"a different {', '.join(changed)} than the run in '{path}' was measured with",
            "the same images, words and encoder",
            "bring them back, or train the stream again in another --out",
        )
    if run.learner.trains == "experts":
        files.attach(run)
    return run


# --- encoder and tasks ----------------------------------------------------------------------------


def encoder(name: str) -> DualEncoder:
    """A dual encoder by name or folder.

    Raises:
        AegisError: there is no such encoder.
    """
    return backbones.load_dual(name)


def tasks(
    recipe: StreamRecipe, image_size: int, on_event: OnEvent = ignore
) -> tuple[StreamTask, ...]:
    """The recipe's tasks in its order.

    Generated images are kept with the other caches; those of folders stay where they are.

    Raises:
        AegisError: no such stream or task, or images that cannot be read or made.
    """
    if recipe.path is not None:
        return tuple(_folder_tasks(Path(recipe.path), recipe, image_size))
    kept = cache.folder("streams")
    return ordered(streams.load(recipe.stream, image_size, kept, on_event=on_event), recipe.order)


def image_set(recipe: StreamRecipe) -> str:
    """Digest of images and words, which does not depend on where they are stored.

    Raises:
        AegisError: no such stream or task, or files that cannot be read.
    """
    if recipe.path is None:
        return sha256_value(streams.edition(recipe.stream))
    return sha256_value(_contents(recipe, Path(recipe.path)))


def _contents(recipe: StreamRecipe, root: Path) -> dict[str, dict[str, Any]]:
    """The files of each task's folder, by task."""
    return {name: folders.contents(root / name) for name in _folder_names(recipe)}


def _checked_image_set(recipe: StreamRecipe, on_event: OnEvent) -> str:
    """The same digest; warns of images in folders that are not really held out."""
    if recipe.path is None:
        return image_set(recipe)
    used = _contents(recipe, Path(recipe.path))
    _warn_of_shared(Path(recipe.path), used, on_event)
    return sha256_value(used)


def _warn_of_shared(root: Path, used: Mapping[str, Mapping[str, Any]], on_event: OnEvent) -> None:
    """Warn of held-out images that are byte for byte also in an earlier part."""
    pairs: list[tuple[Path, Path]] = []
    total = 0
    for name, contents in used.items():
        found, held_out = folders.shared(root / name, contents["files"])
        pairs += [(root / name / one, root / name / other) for one, other in found]
        total += held_out
    if pairs:
        one, other = pairs[0]
        text = (
            f"{len(pairs)} of the {total} held-out images in '{root}' are also in a part that "
            f"comes before, byte for byte: '{one}' is '{other}'. The accuracy on them is not that "
            "on new images; remove one of the two"
        )
        on_event(Warned("train", text))


def _folder_tasks(root: Path, recipe: StreamRecipe, image_size: int) -> Iterator[StreamTask]:
    # Only tasks of a published stream have their own templates; other tasks may share a name.
    known = mtil.STREAMS.get(recipe.stream, ())
    for name in _folder_names(recipe):
        template = mtil.TEMPLATES.get(name, folders.TEMPLATE) if known else folders.TEMPLATE
        yield folders.load(root, name, image_size, (template,))


def _folder_names(recipe: StreamRecipe) -> tuple[str, ...]:
    """The tasks below `path` by name."""
    if not (names := recipe.order or mtil.STREAMS.get(recipe.stream, ())):
        raise AegisError(
            f"the stream '{recipe.stream}' of the folders in '{recipe.path}', and no 'order'",
            f"{' or '.join(mtil.STREAMS)}, or the tasks by name",
            "set 'order' to the names of the folders, as they are to be learned",
        )
    return names


def on_validation(found: Sequence[StreamTask]) -> tuple[StreamTask, ...]:
    """The tasks with their validation parts in place of the test parts, which stay unseen."""
    return tuple(dataclasses.replace(task, test=task.validation) for task in found)


def ordered(found: Sequence[StreamTask], order: Sequence[str] | None) -> tuple[StreamTask, ...]:
    """The tasks that `order` names, in that order; None means all tasks, unchanged."""
    if order is None:
        return tuple(found)
    named = {task.name: task for task in found}
    if unknown := [name for name in order if name not in named]:
        expected = f"tasks of the stream: {', '.join(named)}"
        raise AegisError(f"order: {', '.join(unknown)}", expected, "correct 'order', or delete it")
    return tuple(named[name] for name in order)


# --- the training objective -----------------------------------------------------------------------


class ClassificationLoss:
    """Cross-entropy over a task's own classes, whose names are put into the first template."""

    passes = calibration_passes = 1

    def __init__(self, task: StreamTask, encoder: DualEncoder, label_smoothing: float) -> None:
        self.name, self.size = task.name, len(task.train)
        self._task, self._encoder, self._smoothing = task, encoder, label_smoothing
        self._calibration = self.fetch(spread.rows(self.size, CALIBRATION_IMAGES))
        # The classes' features [C, D], cached while no trainable parameter affects them.
        self._texts: Tensor | None = None

    def fetch(self, rows: Tensor, step: int | None = None) -> tuple[Tensor, Tensor]:
        """Images [B, H, W, 3] uint8 and labels [B]."""
        return self._task.train.images(rows), self._task.train.labels[rows]

    def ahead(
        self, fetch: Callable[[int], Any], steps: Sequence[int]
    ) -> AbstractContextManager[Iterator[Any]]:
        return prefetch.ahead(fetch, steps)

    def loss(self, batch: tuple[Tensor, Tensor], step: int, share: Share = WHOLE) -> Tensor:
        return self._loss(batch, self._class_features)

    def calibration_loss(self, share: Share = WHOLE) -> Tensor:
        # No cached features here: this pass also measures the text tower's routers.
        return self._loss(self._calibration, self._class_weights)

    def trainable_changed(self) -> None:
        self._texts = None

    def _loss(self, batch: tuple[Tensor, Tensor], texts: Callable[[], Tensor]) -> Tensor:
        images, labels = batch
        features = self._encoder.image_features(self._encoder.pixels(images))  # [B, D]
        logits = self._encoder.scale() * features @ texts().T  # [B, C]
        return nn.functional.cross_entropy(
            logits.float(), labels.to(logits.device), label_smoothing=self._smoothing
        )

    def _class_features(self) -> Tensor:
        if self._texts is not None:
            return self._texts
        found = self._class_weights()
        # With gradients disabled, `requires_grad` is False even if the text tower learns.
        if not found.requires_grad and torch.is_grad_enabled():
            self._texts = found
        return found

    def _class_weights(self) -> Tensor:
        return class_weights(self._encoder, self._task.classes, self._task.templates[:1])


# --- evaluation -----------------------------------------------------------------------------------


class ImageEvaluator:
    """Predictions of one encoder.

    The bare encoder's predictions never change and are computed once. If the learner freezes the
    weights of learned tasks, their answers are also cached until the last row, which is computed
    anew. A learner that trains the model itself leaves no bare encoder. The router None then
    stands for the current weights, and nothing is cached.
    """

    def __init__(
        self, encoder: DualEncoder, sites: Routed, tasks: Sequence[StreamTask], learner: Learner
    ) -> None:
        self.encoder, self.sites, self.tasks, self.learner = encoder, sites, tasks, learner
        self._bare: dict[int, Tensor] = {}
        self._looks: dict[int, Tensor] = {}
        self._known: dict[tuple[int, int | None], Tensor] = {}  # by task and router

    @torch.inference_mode()
    def row(self, done: int, gaussians: Sequence[Gaussian]) -> tuple[list[float], list[float]]:
        """R[t, :] after tasks 0 to t = `done`, with the task told and with the task inferred.

        A task that has not come yet is served by the bare encoder, or by the single state of a
        learner that has one for all tasks. Inference chooses among the tasks so far and the bare
        encoder for each image. In both cases an image is classified among its own task's classes.
        """
        if done == len(self.tasks) - 1:  # measure the final forgetting instead of assuming it
            self._known = {key: answers for key, answers in self._known.items() if key[1] is None}
        told, inferred = [], []
        for i, task in enumerate(self.tasks):
            labels = task.test.labels
            state = self._state(i, done)
            answers = self._answers(i, state)  # [N]
            told.append(_accuracy(answers, labels))
            if not self.learner.shared:
                chosen = infer(self._test_looks(i), gaussians)  # [N]; NONE: the bare encoder
                answers = self._inferred(i, state, answers, chosen)
            inferred.append(_accuracy(answers, labels))
        return told, inferred

    def bare(self, part: Part) -> Tensor:
        """Features [N, D] of a part's images in the bare encoder."""
        return self._features(part, None, torch.arange(len(part)))

    def looks(self, part: Part) -> Tensor:
        """Early features [N, W] of a part's images in the bare encoder's image tower, on the CPU.

        The task is inferred from them.
        """
        return self._read(self.encoder.looks, part, None, torch.arange(len(part))).cpu()

    def _test_looks(self, i: int) -> Tensor:
        if i not in self._looks:
            self._looks[i] = self.looks(self.tasks[i].test)
        return self._looks[i]

    def bare_test(self, i: int) -> Tensor:
        """Features [N, D] of a task's test images with no router active."""
        if self.learner.trains == "model":
            return self.bare(self.tasks[i].test)
        if i not in self._bare:
            self._bare[i] = self.bare(self.tasks[i].test)
        return self._bare[i]

    def _state(self, i: int, done: int) -> int | None:
        """The router that serves task i after task `done`, or None."""
        known = self.learner.shared or i <= done
        return self.learner.router(i) if known and self.learner.trains == "experts" else None

    def _answers(self, i: int, router: int | None) -> Tensor:
        """Predicted classes [N] of all test images of a task."""
        if (i, router) in self._known:
            return self._known[i, router]
        if router is None:
            features = self.bare_test(i)
        else:
            features = self._features(self.tasks[i].test, router, None)
        answers = self._classify(i, router, features)
        # Cached only if nothing that is learned later can change them.
        if self.learner.frozen or (router is None and self.learner.trains != "model"):
            self._known[i, router] = answers
        return answers

    def _inferred(self, i: int, own: int | None, answers: Tensor, chosen: Tensor) -> Tensor:
        """Predicted classes [N] if each image uses the router of its `chosen` [N] task."""
        mixed = torch.empty_like(answers)
        for task in chosen.unique().tolist():
            rows = (chosen == task).nonzero().flatten()
            router = None if task == NONE else self.learner.router(task)
            if router == own:  # the answers come from this router already
                mixed[rows] = answers[rows]
            elif router is None:
                mixed[rows] = self._answers(i, None)[rows]
            else:
                features = self._features(self.tasks[i].test, router, rows)
                mixed[rows] = self._classify(i, router, features)
        return mixed

    def _features(self, part: Part, router: int | None, rows: Tensor | None) -> Tensor:
        """Features [N, D] of a part's images, or only of those in `rows` [N]."""
        chosen = torch.arange(len(part)) if rows is None else rows
        return self._read(self.encoder.image_features, part, router, chosen)

    @torch.inference_mode()
    def _read(
        self, tower: Callable[[Tensor], Tensor], part: Part, router: int | None, rows: Tensor
    ) -> Tensor:
        activate(self.sites, router)
        self.encoder.eval()
        found = []
        for chunk in rows.split(EVALUATION_BATCH):
            pixels = self.encoder.pixels(part.images(chunk))
            found.append(tower(pixels))
        return torch.cat(found)

    def _classify(self, i: int, router: int | None, features: Tensor) -> Tensor:
        activate(self.sites, router)  # the text tower has routers too
        weights = class_weights(self.encoder, self.tasks[i].classes, self.tasks[i].templates)
        return (features @ weights.T).argmax(1).cpu()


def _accuracy(answers: Tensor, labels: Tensor) -> float:
    return int((answers == labels).sum()) / len(labels)
