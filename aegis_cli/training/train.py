"""`aegis train`: fine-tune a backbone and an action expert on demonstrations with one method."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from aegis_cli import methods, recipes
from aegis_cli.common import (
    artifacts,
    commands,
    devices,
    files,
    interrupts,
    locks,
    machine,
    prefetch,
)
from aegis_cli.common.errors import AegisError, Diverged, check_finite
from aegis_cli.common.events import Event, OnEvent, Progress, Warned, ignore, loading_told
from aegis_cli.common.headers import rewrite
from aegis_cli.common.kinds import is_finite
from aegis_cli.common.ranks import ALONE, Ranks, joined, rows_here, whole
from aegis_cli.common.state_dicts import AS_WRITTEN, reading_meta
from aegis_cli.core.ledger import Ledger, conflict_share, energy_shed_mean
from aegis_cli.data import augment, demonstrations, mixture, spread
from aegis_cli.data.batch import RobotBatch
from aegis_cli.data.selection import Paths
from aegis_cli.data.vqa.gate import UPPER
from aegis_cli.data.vqa.metrics import Graded
from aegis_cli.methods.base import Parts
from aegis_cli.methods.known_parameters import check_row
from aegis_cli.models import flow, structure
from aegis_cli.models.backbones import preparation
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.models.buffers import WrittenBuffers
from aegis_cli.models.policy import Policy
from aegis_cli.recipes import Recipe, RobotTrain, Train
from aegis_cli.training import (
    ahead,
    assemble,
    checkpoint,
    eight_bit,
    folder,
    inputs,
    longer,
    parallel,
    retention,
    step,
    track,
    validation_actions,
    validation_rollout,
    validation_vqa,
)
from aegis_cli.training.assemble import TrainingRun
from aegis_cli.training.schedule import moving_steps, rate_factor, rate_left
from aegis_cli.training.validation_vqa import ToldOfSet, ValidationQuestions

LEDGER = "ledger.safetensors"
INTERRUPTED = "interrupted"  # in a training state's header: the sums since the last line of metrics
UNLOGGED = "unlogged"  # in such a header: true if no line of metrics had been written yet
VALIDATION_FRAMES = 512
# A validation reports its own progress if training steps on as many batches would take longer than
# this; questions do if their answers took longer before training, and episodes and predicted
# actions if they took longer the last time.
_LONG_S = 20.0
_LOGGED = ("step", "loss", "step_s")  # in every line of metrics
# The entries of such a line that the progress shows, and their labels.
_SHOWN = {
    "loss": "loss",
    "vqa_drop_points": "VQA drop",
    "rollout_success": "success",
    "rollout_mean_return": "return",
    "rollout_low": "at least",
    "rollout_high": "at most",
    "action_error": "action error",
}
LOWER = "try a lower train.backbone_lr or train.expert_lr"
_NOISE, _VALIDATION = 1, 2  # streams of a step's generator
_Hearing = Callable[[float], OnEvent]


@dataclass(frozen=True)
class TrainReport:
    """How the run ended.

    `energy_shed_mean` is what the projection of the gradient removes, or would remove if an option
    projects the update or fewer groups; None for a method that reads no anchor gradient. `cameras`
    are those of a LeRobot folder, in order. The last three are results of the final weights:
    `validation_vqa` on questions, by the set's name, as `validation_vqa.of_line` returns them;
    `validation_rollout` on episodes, as from `validation_rollout.of_line`; `validation_actions` on
    held-out actions, as from `validation_actions.of_line`. Each is empty if it was not measured.
    """

    method: str
    steps: int
    loss: float
    validation_loss: float
    energy_shed_mean: float | None
    step_s: float
    cameras: list[str]
    out: str
    validation_vqa: dict[str, ToldOfSet] = field(default_factory=dict)
    validation_rollout: dict[str, Any] = field(default_factory=dict)
    validation_actions: dict[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


def run(
    recipe: Recipe,
    method: str,
    demos: Paths,
    anchor: Path | None,
    out: Path,
    resume: bool = False,
    on_event: OnEvent = ignore,
    overwrite: bool = False,
) -> TrainReport:
    """Train for `recipe.train.steps` steps in the run folder `out`.

    Only methods that train on questions read any; all others know VQA only through the anchor.

    If torchrun has started several processes, each calls this, and they share every step.

    Args:
        demos: one set of demonstrations, or several to learn from together.
        resume: resume the existing run, if there is one; a finished run is extended if `recipe` has
            more steps, as described in `longer`.
        overwrite: remove the existing run, once everything else has been checked.

    Raises:
        AegisError: the inputs do not fit together, there is a run and neither option is given,
            another process is using it, or the disk cannot be written.
        Diverged: a loss or gradient is not finite; the checkpoint is that of the last good step or,
            if only the validation found it, an earlier one.
    """
    track.check(recipe)
    recipe = dataclasses.replace(recipe, train=dataclasses.replace(recipe.train, method=method))
    chosen = methods.get(method)
    out, places = Path(out), inputs.Inputs.given(demos, anchor)
    # Only one process writes and reports, so its lock of the folder serves all of them.
    with (
        joined() as ranks,
        locks.alone(out) if ranks.first else nullcontext(),
        prefetch.using(recipe.train.workers),
    ):
        on_event = on_event if ranks.first else ignore
        if resume:
            recipe = ranks.agree(longer.plan(out, recipe) if ranks.first else recipe)
        if ranks.first:
            longer.check(out, recipe, resume, overwrite, places, on_event)
        goes_on = ranks.agree(ranks.first and not overwrite and checkpoint.begun(out))
        is_finished = goes_on and _has_ended(out, recipe)
        if is_finished:  # no step is left that would be taken in another way
            recipe = folder.as_begun(out, recipe)
        with loading_told("train", on_event):
            training = assemble.build(recipe, chosen, demos, anchor, out, on_event, ranks)
        if not is_finished:
            training.episodes = validation_rollout.chosen(
                recipe, training.shown, training.meta, ranks
            )
            training.actions = validation_actions.chosen(
                recipe, training.policy, training.demos, training.meta
            )
            training.questions = _asked_before(training, on_event)
        if goes_on:
            _check_passes(training)
            restored = _restore(training, places)
            # If all steps have been taken, `_train` takes none and only reports.
            if is_finished:
                on_event(Progress("train (up to date)", 1, 1, "stage"))
            else:
                _warn_of_another_precision(training, on_event)
                _tell_of_adjustments(training, on_event)
            if ranks.first:
                if _says_otherwise(out, recipe, places):
                    folder.write_recipe(out, recipe)
                inputs.keep(out, places)
            return _train(training, *restored, on_event)
        if ranks.first:
            # Everything has been loaded and checked by now; only then is an old run removed.
            if overwrite:
                folder.remove(out)
            folder.begin(out, recipe)
            inputs.keep(out, places)
            files.save_json(out / machine.NAME, _machine(training))
            _warn_of_learned_episodes(training, places, on_event)
        return _train(training, 0, Window(), on_event)


def _has_ended(out: Path, recipe: Recipe) -> bool:
    """Whether a run has taken all steps and written the last one's metrics line."""
    steps = recipe.train.steps
    if checkpoint.step_of(checkpoint.last(out)) < steps:
        return False
    lines = folder.read_metrics(out, "step")
    return not lines or lines[-1]["step"] >= steps


def _asked_before(run: TrainingRun, on_event: OnEvent) -> ValidationQuestions | None:
    """The questions asked during training, with the model's answers before training.

    A resumed run asks them here too, before its checkpoint is restored.
    """
    backbone = run.shown.backbone
    chosen = validation_vqa.chosen(run.recipe, backbone, on_event)
    if chosen is None:
        return None

    def answered(ranks: Ranks) -> tuple[tuple[list[Graded], ...], float]:
        # Without the questions' images, since one process may have to send the result to all
        # others.
        found = chosen.asked_before(backbone, ranks, on_event)
        return found.before, found.seconds

    with run.masters.as_written(), _evaluating(run.shown):
        before, seconds = run.by_whole(answered)
    questions = dataclasses.replace(chosen, before=before, seconds=seconds)
    questions.warn_of_little_knowledge(run.recipe, on_event)
    return questions


def _machine(run: TrainingRun) -> dict[str, str | int]:
    """The machine, and the precision that `train.precision`, such as `auto`, means on it."""
    device = run.policy.backbone.device
    taken = devices.precision_taken(device, run.recipe.train.precision)
    return machine.describe() | {"precision": taken}


def _warn_of_another_precision(run: TrainingRun, on_event: OnEvent) -> None:
    """Warn if a run is resumed with another precision of matrix products than it began with.

    This happens with `train.precision: auto` on other hardware. The weights then match neither.
    """
    path = run.out / machine.NAME
    said = files.load_json(path) if path.is_file() else None
    begun = said.get("precision") if isinstance(said, dict) else None
    now = devices.precision_taken(run.policy.backbone.device, run.recipe.train.precision)
    if begun not in (None, now):
        text = (
            f"'{run.out}' began with matrix products in {begun} ({machine.NAME}), and goes on in "
            f"{now}, which is what train.precision: {run.recipe.train.precision} means on this "
            "machine: its weights will match neither"
        )
        on_event(Warned("train", text))


def _check_passes(run: TrainingRun) -> None:
    """Refuse another number of passes per step where batch normalisation reads those of a pass."""
    begun, now = folder.as_begun(run.out, run.recipe).train.accumulate, run.recipe.train.accumulate
    if begun != now and structure.averaging(run.policy.backbone):
        raise AegisError(
            f"train.accumulate: {now} for the run in '{run.out}', which began with {begun}, and "
            "whose backbone normalises over the frames of a pass",
            "as many passes as it began with",
            f"go on with its own: {commands.aegis('train', run.out)}",
        )


def _tell_of_adjustments(run: TrainingRun, on_event: OnEvent) -> None:
    """Say which settings a resumed run takes that it did not have so far."""
    changes = folder.adjustments(run.out, run.recipe)
    if changes:
        text = (
            f"'{run.out}' goes on with {changes}. This changes memory, time or what is written, "
            "and what is learned at most by rounding, or by where a method's steps end "
            "(nullspace.every, kfac.every); files may differ from those of an uninterrupted run"
        )
        on_event(Warned("train", text))


def _warn_of_learned_episodes(run: TrainingRun, places: inputs.Inputs, on_event: OnEvent) -> None:
    """Warn if held-out episodes may be among those that the run of `expert.start` was trained on.

    They are drawn anew if the same demonstrations have grown, or are split differently.
    """
    recipe, start = run.recipe, run.recipe.expert.start
    if start is None or not Path(start).is_dir():
        return
    path = Path(start)
    before = path if (path / "recipe.yaml").is_file() else checkpoint.run_of(path)
    if before is None or recipes.is_stream_run(before):
        return
    learned = inputs.of(before)
    if learned is None or learned.demos != places.demos:
        return
    # The held-out episodes follow from the share, the seed, the selection, and the number of
    # episodes, which the digests cover.
    begun = recipes.load(before / "recipe.yaml", kind=Recipe)
    splits = {(each.train.validation_share, each.seed, each.demos.only) for each in (begun, recipe)}
    there = artifacts.read_header(before / LEDGER).inputs
    if len(splits) > 1 or mixture.digests(there) != mixture.digests(run.inputs):
        text = (
            f"the run in '{before}', which this one begins with, may have learned from episodes "
            "that are held out now, so that the validation loss looks better than it is. Leave "
            "some new episodes out with demos.only, and judge by these: aegis evaluate --episodes"
        )
        on_event(Warned("train", text))


def _says_otherwise(out: Path, recipe: Recipe, places: inputs.Inputs) -> bool:
    """Whether the recipe differs from the one in the run's folder, or its inputs have moved.

    Settings that affect its weights are known to be equal by now; a longer plan, questions or a
    gate may differ.
    """
    kept = recipes.load(out / "recipe.yaml", kind=Recipe)
    # A path can be written in several ways; whether the demonstrations have moved is in
    # inputs.json.
    demos = dataclasses.replace(kept.demos, path=recipe.demos.path)
    return dataclasses.replace(kept, demos=demos) != recipe or inputs.of(out) not in (None, places)


def _restore(run: TrainingRun, places: inputs.Inputs) -> tuple[int, Window]:
    """Restore state, ledger and metrics as they were after the last checkpoint.

    Returns:
        The number of steps taken, and the sums since the last metrics line: those of no step if the
        last step's line has been written.
    """
    state = checkpoint.kept_state(run.out)
    # Only the header: other inputs are refused before gigabytes of state are read.
    with _reading_state(run.out):
        saved = artifacts.read_header(state, "training-state")
    if saved.inputs != run.inputs:
        raise _other_inputs(run, saved.inputs, places)
    _check_preparation(run, saved.meta)
    kept = artifacts.load(run.out / LEDGER, "ledger")
    lines = folder.read_metrics(run.out, *_LOGGED)
    with _reading_state(run.out):
        done, meta, run.reused = checkpoint.restore(
            run.out, run.policy, run.optimizers, run.average
        )
    _check_behind(run, done, meta, kept, lines)
    # A run that was killed may have written ledger rows and metrics beyond its last checkpoint. The
    # steps after it are taken again.
    run.ledger = Ledger.from_tensors(run.ledger.groups, run.ledger.layers, kept.tensors)
    run.ledger.truncate(done)
    window = Window()
    if INTERRUPTED in meta:
        run.temporary = checkpoint.last(run.out).resolve()
        with reading_meta(run.temporary / checkpoint.STATE):
            summed = Window.read(meta[INTERRUPTED])
        # The line may have been written when the run was resumed earlier and interrupted again.
        if all(line["step"] != done for line in lines):
            window = summed
    if run.ranks.first:
        folder.truncate_metrics(run.out, done)
    return done, window


def _other_inputs(run: TrainingRun, there: Mapping[str, str], places: inputs.Inputs) -> AegisError:
    """The error for a run that cannot be resumed: other cameras, demonstrations or files."""
    begun, out = recipes.load(run.out / "recipe.yaml", kind=Recipe), run.out
    if mixture.digests(there) != mixture.digests(run.inputs):
        if begun.demos.camera != run.recipe.demos.camera:
            seen = [{"demos.camera": each.demos.camera} for each in (begun, run.recipe)]
            return AegisError(
                f"the run in '{out}' was started with other settings: {folder.differences(*seen)}",
                "the cameras that it began with",
                f"go on with its own: {commands.aegis('train', out)}, or start anew in another "
                "--out",
            )
        kept = inputs.of(out)
        if kept is not None and kept.demos == places.demos:
            return AegisError(
                f"the demonstrations in {', '.join(map(repr, places.demos))} have changed since "
                f"the run in '{out}' began",
                "the same episodes, with the same frames and numbers",
                "bring them back as they were, or begin another run with what this one has "
                f"learned: {folder.learned(out)}, in another --out",
            )
    found = f"{mixture.differing(there, run.inputs)} than the run in '{out}' began with"
    fix = "give the files the run began with, or start anew in another --out"
    changed, moved = _differing_places(run, there, places, begun)
    if changed or moved:
        found += f": {'; '.join([*moved, *changed])}"
    if moved and not changed and checkpoint.begun(out):
        fix = f"go on with its own: {commands.aegis('train', out)}, or start anew in another --out"
    return AegisError(found, "the same inputs", fix)


def _differing_places(
    run: TrainingRun, there: Mapping[str, str], places: inputs.Inputs, begun: Recipe
) -> tuple[list[str], list[str]]:
    """Which files with other contents are at the run's own paths, and which at others."""
    kept, recipe = inputs.of(run.out), run.recipe
    known = {
        "anchor": (None if kept is None else kept.anchor, places.anchor),
        "backbone": (begun.backbone, recipe.backbone),
        "expert": (begun.expert.start, recipe.expert.start),
    }
    if kept is not None and len(kept.demos) == len(places.demos) == 1:
        known["demos"] = (kept.demos[0], places.demos[0])
    changed, moved = [], []
    for name, (before, now) in known.items():
        if there.get(name) == run.inputs.get(name) or before is None or now is None:
            continue
        if before == now:
            changed.append(f"'{now}' has changed since")
        else:
            moved.append(f"'{now}' instead of '{before}'")
    return changed, moved


def _check_preparation(run: TrainingRun, meta: Mapping[str, Any]) -> None:
    """Raise AegisError if the backbone would make other inputs of images and texts than before."""
    now, then = run.policy.backbone.preparation(), meta.get(preparation.META, {})
    other = preparation.differing(now, then)
    if other is not None:
        raise AegisError(
            f"'{run.recipe.backbone}' prepares images or text differently from when the run in "
            f"'{run.out}' began: {other}",
            "the same settings of the processor",
            "bring them back in the model's folder (e.g. in its preprocessor_config.json), or "
            "start anew in another --out",
        )


@contextmanager
def _reading_state(out: Path) -> Generator[None]:
    """In errors about the last training state, say how the run can still be resumed.

    Raises:
        AegisError: the error that was raised inside the block.
    """
    try:
        yield
    except AegisError as error:
        if error.fix != AS_WRITTEN and rewrite("training-state") not in error.fix:
            raise
        link = checkpoint.last(out)
        known, name = checkpoint.whole(out), link.resolve().name
        # A copy that followed links has a folder named 'last'.
        older = [at for at in known if name.isdecimal() and int(at.name) < int(name)]
        fix = "bring back a copy of it, or begin anew with --overwrite instead of --resume"
        if older:
            fix = f"go on from an earlier checkpoint: ln -sfn {older[-1].name} '{link}'; or {fix}"
        raise AegisError(error.found, error.expected, fix) from error


def _check_behind(
    run: TrainingRun,
    done: int,
    meta: Mapping[str, Any],
    kept: artifacts.Artifact,
    lines: Sequence[Mapping[str, Any]],
) -> None:
    """Raise AegisError unless state, ledger and metrics are of the same run, without gaps."""
    method = meta.get("method")
    rows = kept.tensors["step"][:done].tolist()
    settings = run.recipe.train
    log_every = folder.as_begun(run.out, run.recipe).train.log_every  # may change from here on
    # Steps in which the backbone is frozen have no row.
    moving = moving_steps(settings.steps, settings.backbone_until)
    moved = min(done, moving)
    wanted = list(range(1, moved + 1)) if run.parts.dual else []
    columns = [list(run.ledger.groups), list(run.ledger.layers)]
    problem = ""
    if method != run.method.name:
        problem = f"a checkpoint of method '{method}'"
    elif kept.header.inputs != run.inputs or kept.header.meta.get("method") != method:
        problem = f"the {LEDGER} of another run"
    elif rows != wanted or [kept.header.meta.get(k) for k in ("groups", "layers")] != columns:
        problem = f"a {LEDGER} without exactly the steps 1 to {moved} before its end"
    elif not lines and done >= log_every and meta.get(UNLOGGED) is not True:
        problem = f"an empty {folder.METRICS} after {done} steps"
    elif done < moving and run.parts.reuses(done) and not run.reused:
        problem = f"a checkpoint of step {done} without the anchor gradient that the next reuses"
    if problem:
        raise AegisError(
            f"{problem} in '{run.out}'",
            "the files of one run",
            "bring back the run's own files, or start anew in another --out",
        )


# --- the loop -------------------------------------------------------------------------------------


@dataclass
class Window:
    """Sums since the last metrics line."""

    loss: float = 0.0
    data_s: float = 0.0
    update_s: float = 0.0
    steps: int = 0

    @classmethod
    def read(cls, raw: Mapping[str, Any]) -> Window:
        """The sums in a file's meta.

        Raises:
            TypeError, ValueError: the meta holds something else.
        """
        # Older files also have `leaks`, the figures of a measurement that is no longer made.
        found = cls(**{name: value for name, value in raw.items() if name != "leaks"})
        numbers = (found.loss, found.data_s, found.update_s)
        if type(found.steps) is not int or not all(isinstance(x, int | float) for x in numbers):
            raise ValueError(f"'{INTERRUPTED}' is {raw!r}")
        return found

    def means(self, batch_size: int) -> dict[str, float]:
        """A line's figures: means over these steps, and frames per second."""
        step_s = (self.data_s + self.update_s) / self.steps
        return {
            "loss": self.loss / self.steps,
            "data_s": self.data_s / self.steps,
            "update_s": self.update_s / self.steps,
            "step_s": step_s,
            "samples_per_s": batch_size / step_s,
        }


def _train(run: TrainingRun, done: int, window: Window, on_event: OnEvent) -> TrainReport:
    """Take the steps after the first `done` ones.

    Args:
        window: the sums since the last line of metrics.

    Raises:
        Diverged: a step is not finite; the steps before it are saved.
        KeyboardInterrupt: a signal was received; the steps up to it are saved.
    """
    settings = run.recipe.train
    shown: dict[str, float] = {}
    told: dict[str, float] = {}
    run.policy.train()
    buffers = WrittenBuffers(run.policy.backbone)
    fetched = batches_of(run, range(done, settings.steps))
    tracked = track.following(run.recipe, run.out, done, speaks=run.ranks.first)
    signals = interrupts.saved_first("train", on_event)
    with fetched as batches, signals as signaled, tracked as log:
        if done < settings.steps:
            on_event(Progress("train", done, settings.steps, "steps"))
        # A run that was interrupted during a validation still has to write the line of its last
        # step.
        owed = window.steps > 0 and _Due.after(done, settings).line
        for finished in range(done if owed else done + 1, settings.steps + 1):
            due = _Due.after(finished, settings)
            if finished > done:
                _take_step(run, finished - 1, batches, window, due)
            if finished == done + 1:
                warn_of_written(run.policy.backbone, buffers, on_event)
            # First the line: its validation loss decides which older checkpoints are kept.
            if due.line:
                shown = _log(run, finished, window, due.validation, signaled, on_event)
                log(shown)
                window = Window()
            if due.checkpoint:
                _save(run, finished)
            told |= {label: shown[name] for name, label in _SHOWN.items() if name in shown}
            on_event(Progress("train", finished, settings.steps, "steps", told))
            # All processes leave together: one that continued alone would wait for the others.
            if _heeds(run, due) and run.ranks.any(signaled.number is not None)[0]:
                _save_interrupted(run, finished, window)
                signaled.leave()
    if done < settings.steps:
        _tell_of_no_checkpoint_within(run, on_event)
    return run.ranks.by_first(lambda: _report(run))


@dataclass(frozen=True)
class _Due:
    """What is due after a step: a checkpoint, a validation, a metrics line."""

    checkpoint: bool
    validation: bool
    line: bool

    @classmethod
    def after(cls, finished: int, settings: Train) -> _Due:
        """What is due after `finished` steps; after the last one everything is."""
        # The end of an earlier plan counts too: a run planned this long from the start with
        # `train.extended_from` writes what an extended run has written.
        last = finished in settings.plans
        save = finished % settings.checkpoint_every == 0 or last
        validate = finished % settings.validate_every == 0 or last
        return cls(save, validate, save or validate or finished % settings.log_every == 0)


def _take_step(
    run: TrainingRun, index: int, batches: Iterator[RobotBatch], window: Window, due: _Due
) -> None:
    """Fetch a batch and take its step; both times are added to the window.

    Raises:
        Diverged: the steps before it are saved.
    """
    started = time.perf_counter()
    batch = next(batches)
    fetched = time.perf_counter()
    with _good_steps_saved(run):
        # Neither a checkpoint nor a validation may see an update that is still to be constrained.
        update(run, index, batch, window, settle=due.checkpoint or due.validation)
        if due.validation:
            parallel.share_averages(run.policy.backbone, run.ranks)
        if due.line:
            read_figures(run, window)
    window.data_s += fetched - started
    window.update_s += time.perf_counter() - fetched
    window.steps += 1


def _heeds(run: TrainingRun, due: _Due) -> bool:
    """Whether to check for a signal after this step."""
    # Steps between two constraints are pending: constraining them early would lead to other weights
    # than in an uninterrupted run.
    if run.stepper.pending:
        return False
    # With several processes this is a collective, which would force a GPU sync.
    return due.line or not (run.ranks.several and run.unread.deferred)


def _save_interrupted(run: TrainingRun, finished: int, window: Window) -> None:
    """Write the checkpoint that a run is resumed from after a signal."""
    with _good_steps_saved(run):
        read_figures(run, window)
    _save(run, finished, {INTERRUPTED: dataclasses.asdict(window), **_unlogged(run)})


def _unlogged(run: TrainingRun) -> dict[str, bool]:
    """What a checkpoint that no line of metrics belongs to says, if there is no line at all."""
    is_logged = not run.ranks.first or bool(folder.read_metrics(run.out))  # the first one writes
    return {} if is_logged else {UNLOGGED: True}


def batches_of(
    run: TrainingRun, steps: Sequence[int]
) -> AbstractContextManager[Iterator[RobotBatch]]:
    """This process's frames of each of these steps, fetched ahead."""
    return ahead.batches(_fetching(run), steps, run.policy.backbone.device)


def _fetching(run: TrainingRun) -> Callable[[int], RobotBatch]:
    """A function from the index of a step to this process's frames.

    Several threads may call it.
    """
    order = run.order
    waits = devices.reading_stalls(run.policy.backbone.device)

    def fetch(index: int) -> RobotBatch:
        of_step = run.demos.train[order.rows(index)]
        batch = _read(run, of_step, _own(run, of_step), index)
        return prepared(run, batch, of_step, index) if waits else batch

    return fetch


def _own(run: TrainingRun, of_step: Tensor) -> Tensor:
    """The places of this process's frames among all frames of a step."""
    return step.own_rows(torch.arange(len(of_step)), run.ranks, run.recipe.train.accumulate)


def _read(run: TrainingRun, of_step: Tensor, own: Tensor, index: int) -> RobotBatch:
    """The frames at the places `own` of a step's frames, augmented."""
    settings, frames = run.recipe.train, of_step[own]
    batch = run.demos.batch(frames, settings.chunk)
    if settings.augment is None:
        return batch
    # A batch may contain a frame twice, each time with another draw. Repeats are counted over all
    # frames of the step, whichever process takes them.
    repeats = torch.tensor(augment.earlier(of_step.tolist()))[own].tolist()
    images = augment.augmented(
        batch.images,
        frames.tolist(),
        settings.augment,
        settings.augment_count,
        run.recipe.seed,
        index,
        repeats,
    )
    return dataclasses.replace(batch, images=images)


def preparing_s(run: TrainingRun) -> float:
    """Seconds in which one thread reads this process's frames of a step, and processes them."""
    of_step = run.demos.train[run.order.rows(0)]
    own = _own(run, of_step)

    def prepare(places: Tensor) -> None:
        batch = _read(run, of_step, places, 0)
        shown = [batch]
        if run.parts.fraction < 1:
            shown.append(step.first_frames(batch, run.parts.fraction))
        for each in shown:
            run.policy.backbone.process(each.images, each.instructions)

    return ahead.preparing_s(prepare, own)


def prepared(run: TrainingRun, batch: RobotBatch, frames: Tensor, index: int) -> RobotBatch:
    """A batch with what a step would otherwise wait for: sums over processes, scaled images.

    Args:
        batch: this process's frames of a step.
        frames: the numbers of all frames of the step.
        index: the index of the step.
    """
    settings, parts = run.recipe.train, run.parts
    size = run.demos.size(frames, settings.chunk)
    sharing = run.ranks, settings.accumulate
    # A step that reuses an anchor gradient passes no frames of its own for it.
    fraction = 1.0 if parts.reuses(index) else parts.fraction
    return step.with_prepared(batch, size, run.policy.backbone, *sharing, fraction, parts.prepare)


@contextmanager
def _good_steps_saved(run: TrainingRun) -> Generator[None]:
    """Write a checkpoint of the good steps if a later one is not finite.

    Raises:
        Diverged: a step is not finite; the error says where the good steps are.
    """
    try:
        yield
    except Diverged as end:
        good = end.good_steps
        _save(run, good, _unlogged(run))
        steps = "1 good step is" if good == 1 else f"{good} good steps are"
        kept = f"the {steps} in {run.out}/checkpoints/last; {end.fix}"
        raise Diverged(end.found, end.expected, kept, good) from None


def _save(run: TrainingRun, finished: int, going_on: Mapping[str, Any] | None = None) -> None:
    """Write a checkpoint.

    Raises:
        Diverged: a step left weights that are not finite although its loss was, which options of a
            method can cause; the last checkpoint stays.
    """
    parameters = dict(run.policy.named_parameters())
    with devices.single_threaded():
        found = [not is_finite(rows_here(p)) for p in parameters.values()]
    wrong = run.ranks.any(*found)
    bad = [name for name, is_wrong in zip(parameters, wrong, strict=True) if is_wrong]
    if bad:
        good = checkpoint.step_of(checkpoint.last(run.out)) if checkpoint.begun(run.out) else 0
        kept = f"the {good} steps of {run.out}/checkpoints/last are good"
        raise Diverged(
            f"weights that are not finite after step {finished}: '{bad[0]}' first of {len(bad)}",
            "finite numbers",
            f"{kept}; {LOWER}, or another value of the method's options",
            good,
        )
    parallel.share_averages(run.policy.backbone, run.ranks)
    run.save_checkpoint(finished, going_on)


def warn_of_written(backbone: Backbone, before: WrittenBuffers, on_event: OnEvent) -> None:
    """Warn of buffers of the backbone that passes have changed, which no method constrains.

    Args:
        before: the buffers before these passes.
    """
    written = [name.removeprefix(backbone.inside) for name in before.modules()]
    if not written:
        return
    more = f" and of {len(written) - 1} more modules" if written[1:] else ""
    text = (
        f"passes in training mode change buffers of '{written[0]}'{more}, as BatchNorm averages "
        "what it reads: answers change with them, and no method protects them; train.freeze, of "
        "the modules or of what they lie in, keeps batch normalisations as they are"
    )
    on_event(Warned("train", text))


def _generator(run: TrainingRun, index: int, stream: int) -> torch.Generator:
    """A generator seeded by (seed, step): a resumed run draws what an uninterrupted one draws."""
    return torch.Generator().manual_seed(_seed(run.recipe.seed, index, stream))


def validation_noise(seed: int) -> int:
    """The seed of the noise in every validation loss of a run with this recipe seed."""
    return _seed(seed, 0, _VALIDATION)


def _seed(seed: int, index: int, stream: int) -> int:
    # Seeds are 1,000,003 steps apart, and a step has room for four streams. A generator on the CPU
    # uses the lower 32 bits of this, which differ for all steps of a run below 2^30.
    return (seed * 1_000_003 + index) * 4 + stream


def update(
    run: TrainingRun, index: int, batch: RobotBatch, window: Window, settle: bool = False
) -> None:
    """Take one step; with `settle`, the method constrains it now, even if it is not yet due.

    Raises:
        AegisError: the method does not cover what is trained; nothing is updated.
        Diverged: something is not finite; nothing is updated, and earlier steps are constrained.
    """
    settings = run.recipe.train
    moving = moving_steps(settings.steps, settings.backbone_until)
    still = index >= moving
    method, parts = run.method, run.parts
    if still:
        # No gradient reaches the backbone, and the optimizer skips parameters without one.
        method, parts = dataclasses.replace(method, stop_gradient=True), Parts()
    for optimizer in run.optimizers:
        optimizer.zero_grad()
    result = step.compute_gradients(
        run.policy,
        method,
        parts,
        batch,
        _generator(run, index, _NOISE),
        index=index,
        flow_samples=settings.flow_samples,
        precision=settings.precision,
        reused=run.reused if run.parts.reuses(index) else None,
        ranks=run.ranks,
        accumulate=settings.accumulate,
        masters=run.masters,
    )
    # Over backbone and expert together, and after the projection, which clipping does not undo: a
    # scaled gradient stays orthogonal to the anchor gradient.
    norm = whole(nn.utils.clip_grad_norm_(run.learning, settings.clip_norm))
    run.unread.note(index, result, norm)
    if not run.unread.deferred:
        read_figures(run, window)
    if run.parts.refresh > 1:
        run.reused = result.taken
    run.unread.stop(run.optimizers)
    if still:
        _move(run, index, still=True)
    else:
        move = partial(_move, run, index)
        left, moves = rate_left(index, settings), run.unread.moves
        run.stepper.step(index + 1, move, result.anchor, left, moves)
        # The backbone's last step is always constrained: no later step would do it.
        if settle or index + 1 == moving:
            run.stepper.settle()
    # Weights that are still to be constrained do not enter the average.
    if not run.stepper.pending:
        run.average.follow(run.unread.moved)


def read_figures(run: TrainingRun, window: Window) -> None:
    """Read the figures of the steps since the last call into the ledger and the window.

    Raises:
        AegisError: the method does not cover what is trained.
        Diverged: something is not finite. No optimizer has updated anything since, and earlier
            steps are constrained.
    """
    for step_figures in run.unread.taken():
        index, row = step_figures.index, step_figures.row
        if not step_figures.finite:
            run.stepper.settle()  # whoever catches the error saves the weights of the good steps
        check_finite(step_figures.checked, f"at step {index + 1}", LOWER, index)
        window.loss += step_figures.checked["loss"]
        if row is not None:
            if "moments" in run.method.needs:  # other penalties may be at their minimum
                check_row((row.tt, row.ta, row.aa), run.ledger.groups)
            run.ledger.append(index + 1, row.tt, row.ta, row.aa, row.w2)


def _move(run: TrainingRun, index: int, still: bool = False) -> None:
    """Take the optimizers' step at the scheduled rates, which a method may scale down.

    With `still`, the backbone is not updated.
    """
    shares = {} if still or run.parts.shares is None else run.parts.shares()
    for group, rate in zip(run.rates, _rates(run, index, shares), strict=True):
        group["lr"] = rate
        if eight_bit.is_marked(group):
            group["lr"] = float(group["lr"])  # its kernel accepts no tensor
    for optimizer in run.optimizers:
        optimizer.step()


def _scheduled(run: TrainingRun, index: int) -> list[float]:
    """The scheduled learning rate of each parameter group in the step of this index."""
    settings = run.recipe.train
    factor = rate_factor(index, settings)
    still = index >= moving_steps(settings.steps, settings.backbone_until)
    rates = []
    for group in run.rates:
        stands = still and group["name"] == "backbone"
        rates.append(0.0 if stands else group["peak"] * factor)
    return rates


def _rates(
    run: TrainingRun, index: int, shares: Mapping[Tensor, float | Tensor]
) -> list[float | Tensor]:
    """The rates that the optimizers use: the scheduled ones, which a method may scale down."""
    scheduled = _scheduled(run, index)
    found: list[float | Tensor] = [*scheduled]
    # A method with shares has each of the backbone's parameters in its own group.
    left = [shares.get(group["params"][0], 1.0) for group in run.rates]
    unread = {place: share for place, share in enumerate(left) if isinstance(share, Tensor)}
    if unread:
        # One kernel for all of them.
        rates = [scheduled[place] for place in unread]
        scaled = torch._foreach_mul(list(unread.values()), rates)
        for place, rate in zip(unread, scaled, strict=True):
            found[place] = rate
    for place, share in enumerate(left):
        if place not in unread:
            found[place] *= share
    return found


def _log(
    run: TrainingRun,
    finished: int,
    window: Window,
    validate: bool,
    signaled: interrupts.Deferred,
    on_event: OnEvent,
) -> dict[str, float]:
    """Append one line to metrics.jsonl and return it."""
    line: dict[str, float] = {"step": finished, **window.means(run.recipe.train.batch_size)}
    rates = zip(run.rates, _scheduled(run, finished - 1), strict=True)
    line |= {f"lr_{group['name']}": rate for group, rate in rates}
    recent = run.ledger.tensors(after=finished - window.steps)
    if len(recent["step"]):  # steps in which the backbone is frozen have no row
        line |= {"energy_shed": energy_shed_mean(recent), "conflict": conflict_share(recent)}
    if validate:
        with _saved_where_left(run, finished, window):
            line |= _validation(run, finished, line["step_s"], _hearing(run, signaled, on_event))
        _warn_of_drop(run, line, on_event)
    if run.ranks.first:
        folder.append_metrics(run.out, line)
    return line


@contextmanager
def _saved_where_left(run: TrainingRun, finished: int, window: Window) -> Generator[None]:
    """Write a checkpoint if the block, a validation, fails or is left after a signal.

    A run resumed from it repeats the validation. With several processes nothing is written: if only
    one fails, the others would wait for it.
    """
    try:
        yield
    except Diverged:
        raise  # its weights are unusable
    except BaseException:
        if not run.ranks.several:
            _save_interrupted(run, finished, window)
        raise


def _hearing(run: TrainingRun, signaled: interrupts.Deferred, on_event: OnEvent) -> _Hearing:
    """A function from the seconds that a part of a validation takes to its progress handler.

    The handler leaves the run once a signal was received: no work is half done at an event. Several
    processes leave a validation together, at its end.
    """

    def hearing(seconds: float) -> OnEvent:
        def heard(event: Event) -> None:
            if seconds > _LONG_S:
                on_event(event)
            if signaled.number is not None and not run.ranks.several:
                signaled.leave()

        return heard

    return hearing


def _validation(
    run: TrainingRun, finished: int, step_s: float, hearing: _Hearing
) -> dict[str, float]:
    """The validation loss of a checkpoint written now, and its other validation figures.

    Args:
        step_s: how long a step takes.
    """
    settings, noise = run.recipe.train, validation_noise(run.recipe.seed)
    batches = min(len(run.demos.validation), VALIDATION_FRAMES) / settings.batch_size
    heard = hearing(batches * step_s)
    # With the weights that a checkpoint holds, rounded as in training passes.
    with run.average.in_place(), run.masters.rounded():
        loss = validation_loss(run.policy, run.demos, settings, noise, run.ranks, heard)
    check_finite({"validation loss": loss}, f"after step {finished}", LOWER, finished)
    return {"validation_loss": loss, **_watched(run, finished, hearing)}


def _watched(run: TrainingRun, finished: int, hearing: _Hearing) -> dict[str, float]:
    """The figures of a checkpoint written now on questions, episodes and held-out actions.

    It is empty if the recipe asks for none of them.

    Raises:
        Diverged: a figure is not finite, as can happen to an answer's likelihood.
    """
    if run.questions is None and run.episodes is None and run.actions is None:
        return {}

    def figures(ranks: Ranks) -> dict[str, float]:
        found: dict[str, float] = {}
        if run.questions is not None:
            heard = hearing(run.questions.seconds)
            found |= run.questions.figures(run.shown.backbone, ranks, heard)
        if run.episodes is not None:
            found |= run.episodes.figures(ranks, hearing(run.episodes.seconds))
        if run.actions is not None:
            heard = hearing(run.actions.seconds)
            found |= run.actions.figures(run.shown, ranks, heard)
        return found

    with run.average.in_place(), run.masters.as_written(), _evaluating(run.shown):
        found = run.by_whole(figures)
    check_finite(found, f"after step {finished}", LOWER, finished)
    return found


def _warn_of_drop(run: TrainingRun, line: Mapping[str, float], on_event: OnEvent) -> None:
    """Warn the first time that the drop, or only its interval, exceeds what the gate allows."""
    recipe = run.recipe
    past = validation_vqa.past_limit(recipe, validation_vqa.of_line(recipe, line))
    if not past or not run.learns_vlm:  # a frozen VLM has lost nothing, however few its questions
        return
    is_lost = any(validation_vqa.is_lost(recipe, told) for told in past.values())
    if run.told_of_drop or (run.told_of_few and not is_lost):
        return
    run.told_of_drop, run.told_of_few = is_lost, True
    on_event(Warned("train", validation_vqa.of_past_limit(recipe, int(line["step"]), past)))


def _tell_of_no_checkpoint_within(run: TrainingRun, on_event: OnEvent) -> None:
    """Say at the end of a training if no checkpoint that is kept is known to pass the gate."""
    if run.recipe.train.keep_checkpoints is None or not run.learns_vlm or not run.ranks.first:
        return
    steps = [int(path.name) for path in checkpoint.whole(run.out)]
    best = retention.best(run.out, steps, run.recipe)
    if best.passes is not False:
        return
    probe = run.recipe.probe
    by = " by the upper end of its interval (probe.gate)" if probe.gate == UPPER else ""
    text = (
        f"no checkpoint is known to have lost at most {probe.max_drop:g} points of VQA "
        f"(probe.max_drop){by}: the one kept as the best, of step {best.step}, has the lowest "
        "validation loss"
    )
    on_event(Warned("train", text))


@torch.no_grad()
def validation_loss(
    policy: Policy,
    demos: demonstrations.Demonstrations,
    settings: Train | RobotTrain,
    noise: int,
    ranks: Ranks = ALONE,
    on_event: OnEvent = ignore,
) -> float:
    """The flow-matching loss on frames of held-out episodes, with the same noise every time.

    The frames are spread evenly. They are passed in batches of the training's size, which are
    divided among the processes and split into as many passes as a step. None of this affects the
    loss: the draws depend only on the frame, and the loss is the mean over all frames' steps.

    Args:
        noise: seed of the draws; for a run, that of `validation_noise`.
    """
    held_out, backbone = len(demos.validation), policy.backbone
    frames = demos.validation[spread.rows(held_out, VALIDATION_FRAMES)]
    # The number of steps in all frames' chunks that are not padding. Every batch's loss is divided
    # by it, so that their sum is the mean over all frames.
    _, shown = demos.size(frames, settings.chunk)

    def prepare(part: Tensor) -> tuple[Tensor, RobotBatch, Ranks, int]:
        """This process's frames of a batch, the processes sharing it, and the number of passes."""
        # If there are fewer frames than processes, each passes all of them.
        sharing = ranks if len(part) >= ranks.count else ALONE
        passes = settings.accumulate
        passes = passes if len(part) >= sharing.count * passes else 1
        numbers = step.own_rows(part, sharing, passes)
        own = demos.batch(numbers, settings.chunk)
        size = demos.size(part, settings.chunk)
        return numbers, step.with_prepared(own, size, backbone, sharing, passes), sharing, passes

    total, done = 0.0, 0
    parts = frames.split(settings.batch_size)
    on_event(Progress("validation", done, len(frames), "frames"))
    with (
        _evaluating(policy),
        prefetch.for_device(prepare, parts, backbone.device) as ready,
    ):
        for numbers, own, sharing, passes in ready:
            losses = []
            batches = [batch for batch, _ in step.passes(own, sharing, passes, backbone.device)]
            numbers_of_each = numbers.split([len(batch) for batch in batches])
            each_pass = zip(batches, own.prepared, numbers_of_each, strict=True)
            for batch, prepared_pass, frame_numbers in each_pass:
                drawn = _draws(frame_numbers, settings.flow_samples, batch, noise)
                with devices.autocast(backbone.device, settings.precision):
                    encoding = backbone.encode(prepared_pass.inputs.to(backbone.device))
                    losses.append(policy.flow_loss_at(batch, encoding, *drawn, shown))
            # `ALONE` does not sum: if every process passes all frames, each has the whole loss
            # already.
            total += sharing.total(torch.stack(losses).sum()).item()
            done = min(done + settings.batch_size, len(frames))
            on_event(Progress("validation", done, len(frames), "frames"))
    return total


def _draws(frames: Tensor, samples: int, batch: RobotBatch, noise: int) -> tuple[Tensor, Tensor]:
    """The flow times [B, K] and noises [B, K, H, A] of frames [B], seeded by the frame's number.

    So they depend neither on how many frames are passed at once nor on which others are held out.
    """
    shape = (samples, *batch.actions.shape[1:])  # (K, H, A)
    times, noises = [], []
    for frame in frames.tolist():
        # A CPU generator uses 32 bits of its seed: mixing separates the seeds of neighbours first.
        mixed = np.random.SeedSequence([noise, frame]).generate_state(1)
        generator = torch.Generator().manual_seed(int(mixed[0]))
        times.append(flow.draw_times(shape[:1], generator))
        noises.append(flow.draw_noise(shape, generator))
    return torch.stack(times), torch.stack(noises)


@contextmanager
def _evaluating(policy: Policy) -> Generator[None]:
    """Put the policy in evaluation mode inside the block, so that passes do not write buffers."""
    was_training = policy.training
    policy.eval()
    try:
        yield
    finally:
        policy.train(was_training)


def _report(run: TrainingRun) -> TrainReport:
    lines = folder.read_metrics(run.out, *_LOGGED)
    if not lines or lines[-1].get("validation_loss") is None:
        raise AegisError(
            f"no validation loss in the last line of '{run.out / folder.METRICS}'",
            "the log as aegis train wrote it",
            "bring back a copy of it, or start anew in another --out",
        )
    times = sorted(line["step_s"] for line in lines)
    return TrainReport(
        method=run.method.name,
        steps=run.recipe.train.steps,
        loss=lines[-1]["loss"],
        validation_loss=lines[-1]["validation_loss"],
        energy_shed_mean=energy_shed_mean(run.ledger.tensors()) if run.parts.dual else None,
        step_s=times[len(times) // 2],  # the median: the first step includes one-time work
        cameras=list(run.demos.cameras),
        out=str(run.out),
        validation_vqa=validation_vqa.of_line(run.recipe, lines[-1]),
        validation_rollout=validation_rollout.of_line(lines[-1]),
        validation_actions=validation_actions.of_line(lines[-1]),
    )
