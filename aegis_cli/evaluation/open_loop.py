"""`aegis evaluate`: predicted against recorded actions, on episodes that a run was not trained on.

It is open loop: each prediction starts from a recorded frame, and nothing is executed. For a robot
without a simulation it is the only figure available. It does not say how often the robot succeeds.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch

from aegis_cli import recipes
from aegis_cli.common import artifacts, circumstances, commands, devices, hub, machine
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Warned, ignore, loading_told
from aegis_cli.common.kept_lines import KeptLines
from aegis_cli.common.kinds import quoted
from aegis_cli.data import demonstrations, joints, mixture, other_units, renaming, spread
from aegis_cli.data.demonstrations import Demonstrations
from aegis_cli.data.lerobot import layout
from aegis_cli.data.mixture import Robot
from aegis_cli.data.renaming import Renaming
from aegis_cli.data.selection import Selection
from aegis_cli.evaluation import results
from aegis_cli.evaluation.results import CHOSEN, OTHER, UNKNOWN, VALIDATION
from aegis_cli.models import backbones, download, lerobot_folder
from aegis_cli.models.action_errors import (
    ActionErrors,
    interval,
    mean,
    no_better_than_standing_still,
    predict,
    training_std,
)
from aegis_cli.models.policy import Policy
from aegis_cli.models.policy_meta import PolicyMeta
from aegis_cli.training import checkpoint, inputs

_STAGE = "evaluate"
_ENOUGH = 30  # frames from which the spread of actions tells their units
TRACED = 3  # episodes that a plot shows
_BY_PART = ("dimensions", "horizon")  # of the report
FULL_ACTION = "share of a full action"  # the unit of every simulated task's actions


@dataclass(frozen=True)
class DimensionError:
    """The error in one dimension of the actions, over all frames and steps of the chunks.

    Attributes:
        unit: None if the data does not say.
        mae, rmse: mean absolute error and root mean squared error, in raw units.
        training_std: standard deviation over the training frames, which is the RMSE there of always
            predicting their mean; 0 if nothing varied.
        constant_rmse: RMSE of the best constant action on these frames, which is the standard
            deviation of the recorded actions.
        hold_rmse: RMSE of repeating the current position; None if actions are not positions.
        relative_error: squared error over the training variance; None if nothing varied.
        rmse_by_step: [H].
    """

    name: str
    unit: str | None
    mae: float
    rmse: float
    training_std: float
    constant_rmse: float
    hold_rmse: float | None
    relative_error: float | None
    rmse_by_step: list[float]


@dataclass(frozen=True)
class StepError:
    """The error a given number of steps ahead; step 1 is the action at the frame itself.

    `frames` counts the frames whose episode lasts that long.
    """

    step: int
    frames: int
    relative_error: float | None
    hold_error: float | None


@dataclass(frozen=True)
class InstructionError:
    """The error at the frames of one instruction, over all dimensions and steps of their chunks.

    `relative_interval` is by Student's t over the episodes; None for a single one.
    """

    instruction: str
    episodes: int
    frames: int
    relative_error: float | None
    relative_interval: tuple[float, float] | None
    hold_error: float | None


@dataclass(frozen=True)
class EpisodeError:
    """The error in one episode, over all dimensions and steps of the chunks that begin in it.

    `steps` is the number of steps in all its chunks, over which the errors are averaged.
    """

    episode: int
    frames: int
    steps: int
    relative_error: float | None
    hold_error: float | None


@dataclass(frozen=True, eq=False)
class Trace:
    """An episode as a plot shows it; `predicted` [T, A] has a new chunk every `replan` frames."""

    episode: int
    replan: int
    recorded: np.ndarray
    predicted: np.ndarray


@dataclass(frozen=True)
class OpenLoopReport:
    """How far predictions are from the recorded actions.

    Attributes:
        split: which episodes these are: the run's own `validation` episodes, all episodes of `other
            data` than the training's, `chosen` ones, or all if it is `unknown` what the policy was
            trained on.
        trained_on: the episodes among these that the run was trained on; empty if that is not
            known, as for an exported policy.
        relative_error: mean squared error over the variance of the training's actions, averaged
            over the dimensions that varied there; 1 is the error of always predicting their mean.
        relative_interval: 95 % interval by Student's t over episodes; None for one episode.
        hold_error: relative error of repeating the current position, if actions are positions.
        fps: steps of a chunk per second, which is the control rate of the demonstrations; None if
            they do not say.
        instructions: the errors for each instruction of the frames, the worst first.
        episode_errors: the errors for each episode, in the order of `episodes`.
        traces: what a plot shows; empty unless asked for.
    """

    data: str
    split: str
    episodes: list[int]
    trained_on: list[int]
    frames: int
    chunk: int
    seed: int
    relative_error: float | None
    relative_interval: tuple[float, float] | None
    hold_error: float | None
    dimensions: list[DimensionError]
    horizon: list[StepError]
    fps: float | None = None
    instructions: list[InstructionError] = dataclasses.field(default_factory=list)
    episode_errors: list[EpisodeError] = dataclasses.field(default_factory=list)
    traces: list[Trace] = dataclasses.field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        """The report as JSON-ready values, without what only a plot shows."""
        found = dataclasses.asdict(dataclasses.replace(self, traces=[]))
        del found["traces"]
        return found

    def kept(self) -> dict[str, Any]:
        """The part of the report that a run keeps: the error, by instruction and by episode."""
        found = self.to_json()
        return {name: value for name, value in found.items() if name not in _BY_PART}


def run(
    run_path: Path,
    data: Path,
    episodes: Sequence[int] | None = None,
    frames: int = 1000,
    seed: int = 0,
    batch_size: int = 64,
    traced: bool = False,
    on_event: OnEvent = ignore,
    keep: bool = False,
    rename: Renaming = (),
    task: str | None = None,
) -> OpenLoopReport:
    """Compare a run's predictions with demonstrations, frame by frame.

    Args:
        run_path: the run of one policy, one of its checkpoints, an exported policy, or the id of a
            policy on the hub.
        data: demonstrations, a file or a LeRobot folder.
        episodes: numbers from 0; None: the run's validation episodes if it was trained on this
            data, else all.
        frames: the largest number of frames to predict at, spread evenly over the episodes.
        seed: seed of the noise from which the flow starts.
        batch_size: frames per forward pass.
        traced: whether the report includes the traces of a plot.
        keep: write the report into the run's folder, if `run_path` is a run or its checkpoint.
        rename: the policy's names for cameras, features and joints of these demonstrations, in
            addition to the training's renaming.
        task: if given, it must be the policy's own.

    Raises:
        AegisError: no such run, another task than its own, demonstrations that do not fit the
            policy, or episodes that cannot be told from those that it was trained on.
    """
    run_path, data = Path(run_path), Path(data)
    source, place = Source.find(run_path)
    with loading_told(_STAGE, on_event):
        policy, meta = checkpoint.load_policy(place)
    checkpoint.check_task(meta, task)
    asked = Asked(episodes, frames, seed, batch_size, traced, rename)
    report = evaluated(source, policy, meta, data, asked, source.before(), on_event)
    if keep:
        kept = {"episodes": None if episodes is None else list(episodes), "frames": frames}
        kept |= {"seed": seed, "path": str(data.absolute() if data.exists() else data)}
        kept |= {"rename": dict(rename)} if rename else {}
        name = f"{results.OPEN_LOOP}-{report.split}-{data.absolute().name}"
        results.keep_if_possible(run_path, name, report.kept(), kept, on_event)
    return report


class Asked(NamedTuple):
    """The settings of `aegis evaluate` besides the policy and the demonstrations: see `run`."""

    episodes: Sequence[int] | None = None
    frames: int = 1000
    seed: int = 0
    batch_size: int = 64
    traced: bool = False
    rename: Renaming = ()


def evaluated(
    source: Source,
    policy: Policy,
    meta: PolicyMeta,
    data: Path,
    asked: Asked,
    earlier: Sequence[Earlier] = (),
    on_event: OnEvent = ignore,
) -> OpenLoopReport:
    """Compare a policy's predictions with demonstrations, frame by frame.

    Args:
        source: what is known about its training.
        earlier: other trainings that it may have learned from.

    Raises:
        AegisError: demonstrations that do not fit the policy, or episodes that cannot be told from
            those that it was trained on.
    """
    mixture.check_rename((data,), asked.rename)
    learned = source.selection(meta, data, asked.rename)
    _check_robot(policy, meta, data, learned, on_event)
    chosen = source.choose(learned, data, asked.episodes)
    _warn_of_earlier_learning(earlier, data, asked.rename, chosen.episodes, on_event)
    shown = _shown(policy, meta, data, learned, chosen, on_event)
    at = _spread(shown, chosen.episodes, asked.frames)
    policy, seed, batch_size = policy.to(devices.pick()), asked.seed, asked.batch_size
    about = {
        "policy": policy.fingerprint(),
        "data": [shown.sha256, repr(learned), [list(size) for size in checkpoint.sizes_of(meta)]],
        "frames": at.tolist(),
        "how": [seed, batch_size],
        **circumstances.of_answers(),
        **machine.versions(("av",)),  # which decodes videos
    }
    kept = KeptLines("predictions", about, on_event)
    predicted = predict(policy, shown, at, seed, batch_size, _STAGE, on_event, kept)
    found = compare(shown, at, predicted, _training_std(policy, meta, on_event))
    report = dataclasses.replace(
        found,
        data=str(data),
        split=chosen.split,
        trained_on=[one for one in chosen.trained_on if one in found.episodes],
        seed=seed,
        traces=_traces(policy, meta, shown, chosen, seed, batch_size) if asked.traced else [],
    )
    # Chosen episodes may be of a task in which the robot hardly moves.
    if report.split in (OTHER, UNKNOWN) and report.frames >= _ENOUGH:
        _warn_of_other_units(report, on_event)
    _warn_of_standing_still(report, on_event)
    return report


def _warn_of_other_units(report: OpenLoopReport, on_event: OnEvent) -> None:
    """Warn of recorded actions that may be in other units than the policy's."""
    text = other_units.said(
        f"the actions recorded in '{report.data}'",
        [one.constant_rmse for one in report.dimensions],
        [one.training_std for one in report.dimensions],
        "those that the policy was trained on",
    )
    if text is not None:
        on_event(Warned(_STAGE, f"{text}, and then the errors mean nothing"))


def _warn_of_standing_still(report: OpenLoopReport, on_event: OnEvent) -> None:
    """Warn about a policy that is no closer to the recording than a robot that stays in place."""
    text = no_better_than_standing_still(report.relative_error, report.hold_error)
    if text is not None:
        on_event(Warned(_STAGE, text))


# --- which episodes -------------------------------------------------------------------------------


class _Chosen(NamedTuple):
    """Episodes: how they were chosen, their numbers, and which of them were trained on."""

    split: str
    episodes: list[int]
    trained_on: list[int]


def check_policy(run: Path) -> None:
    """Raise AegisError for an existing path that is not a policy, without asking the hub."""
    _refuse_stream(run)
    if (run.exists() or hub.is_local(str(run))) and not lerobot_folder.is_policy(run):
        checkpoint.chosen(run)


def _refuse_stream(run: Path) -> None:
    if recipes.is_stream_run(run):
        raise AegisError(
            f"'{run}', the run of a stream",
            "the run of one policy, or of a stream of robot tasks with --task",
            "evaluate a run that aegis train wrote from a recipe of kind policy",
        )


class Learned(NamedTuple):
    """What a training read of its demonstrations, and which of them it held out.

    Attributes:
        read: what `recipes.selected` returns for the recipe's section `demos`.
        camera: as in the recipe.
        share, seed: determine which episodes were held out.
        starts: the models that the training started from, as the recipe names them.
    """

    read: dict[str, Any]
    camera: str | tuple[str, ...] | None
    share: float
    seed: int
    starts: tuple[str, ...]

    @classmethod
    def of(cls, recipe: recipes.Recipe) -> Learned:
        """What the training of one policy read and held out."""
        demos, share = recipe.demos, recipe.train.validation_share
        starts = (recipe.expert.start, backbones.divided(recipe.backbone)[0])
        named = tuple(name for name in starts if name is not None)
        return cls(recipes.selected(recipe), demos.camera, share, recipe.seed, named)


class Earlier(NamedTuple):
    """Another training that a policy may have learned from, besides its own.

    Attributes:
        said: for a warning: what was trained on the episodes, and what follows for the policy.
    """

    said: str
    source: Source
    meta: PolicyMeta


@dataclass(frozen=True)
class Source:
    """A policy, and what is known about its training.

    Outside a run `learned` is None; a folder in LeRobot's layout does not have the `digests` of the
    demonstrations either.

    Attributes:
        words: the command-line words that name the policy, its folder first.
        places: where the run found its demonstrations, if it says so.
    """

    words: tuple[str, ...]
    learned: Learned | None
    digests: frozenset[str]
    places: frozenset[Path] = frozenset()

    @classmethod
    def find(cls, run: Path) -> tuple[Source, Path]:
        """What is known about a run or policy, and the checkpoint to load.

        Raises:
            AegisError: no such run, or the run of a stream.
        """
        _refuse_stream(run)
        words, run = (str(run),), download.locate(run)
        if lerobot_folder.is_policy(run):
            return cls(words, None, frozenset()), run
        chosen = checkpoint.chosen(run)
        folder = run if (run / "recipe.yaml").is_file() else checkpoint.run_of(run)
        recipe = None if folder is None else recipes.load(folder / "recipe.yaml")
        header = artifacts.read_header(chosen / checkpoint.EXPERT)
        kept = None if folder is None else inputs.of(folder)
        places = frozenset(Path(place).resolve() for place in kept.demos) if kept else frozenset()
        learned = None if recipe is None else Learned.of(recipe)
        return cls(words, learned, mixture.digests(header.inputs), places), chosen

    @property
    def name(self) -> str:
        """The policy's name in an error."""
        return self.words[0]

    def before(self) -> list[Earlier]:
        """The trainings that this one started from, recursively, as far as they still exist."""
        found = []
        for run in [] if self.learned is None else _began_with(self.learned):
            try:
                source, place = Source.find(run)
                meta = artifacts.read_header(place / checkpoint.EXPERT).meta
            except AegisError:
                continue
            said = f"by '{run}', with which '{self.name}' began: the policy has learned from them"
            found.append(Earlier(f"{said} already", source, cast(PolicyMeta, meta)))
        return found

    def selection(self, meta: PolicyMeta, data: Path, rename: Renaming = ()) -> Selection:
        """What training would read of these demonstrations, as far as it is known.

        Args:
            rename: names that the training did not have.

        Raises:
            AegisError: a folder with several cameras, but not those of the training.
        """
        own = ("only", "state", "action", "rename")
        known: dict[str, Any] = {name: meta[name] for name in own if name in meta}
        if self.learned is not None:
            known = self.learned.read
        known = {name: tuple(v) if isinstance(v, list) else v for name, v in known.items()}
        known["rename"] = renaming.of(known.get("rename", {}) | dict(rename))
        at = demonstrations.locate(data)
        camera = self._camera(meta, at, known["rename"]) if at.is_dir() else None
        return Selection(camera, **known)

    def _camera(
        self, meta: PolicyMeta, data: Path, rename: Renaming
    ) -> str | tuple[str, ...] | None:
        """The cameras of a LeRobot folder that training used; None: the folder's only one."""
        own = layout.read_info(data).cameras
        known = [renaming.feature(rename, name) for name in own]
        if self.learned is not None and self.learned.camera is not None:
            _check_cameras(self.learned.camera, known, data)
            return self.learned.camera
        named = meta.get("cameras", ())
        by_name = {layout.short(camera): camera for camera in known}
        short = [layout.short(camera) for camera in named]
        if short and all(name in by_name for name in short):
            return tuple(by_name[name] for name in short)
        if len(known) > 1:
            raise AegisError(
                f"the cameras {', '.join(known)} in '{data}'",
                f"{', '.join(named) or 'the only one that there was'}, as the policy was trained",
                "give demonstrations with these cameras alone, say what is called otherwise with "
                "--rename, or train by a recipe that names them (--set demos.camera=NAME)",
            )
        return None

    def choose(self, learned: Selection, data: Path, asked: Sequence[int] | None) -> _Chosen:
        """The episodes to predict on.

        Raises:
            AegisError: episodes that do not exist, or none that is known to be held out.
        """
        count = demonstrations.count_episodes(data)
        # Compared by content and not by path.
        if not self.digests or not demonstrations.is_one_of(data, learned, self.digests):
            if asked is None and data.resolve() in self.places:
                raise _has_changed(self.words, data, count)
            everything = OTHER if self.digests else UNKNOWN
            split = everything if asked is None else CHOSEN
            return _Chosen(split, _existing(asked, count, data), [])
        if self.learned is None:
            if asked is not None:
                return _Chosen(CHOSEN, _existing(asked, count, data), [])
            raise AegisError(
                f"'{self.name}', a checkpoint outside its run, which was trained on '{data}'",
                "the run, whose recipe says which episodes were held out",
                "give the run's folder, choose the episodes (--episodes 6,7), or give "
                "demonstrations that it was not trained on",
            )
        share, seed = self.learned.share, self.learned.seed
        # Drawn again as the training drew them: by seed, from the episodes that it used.
        own = demonstrations.learned_from(data, count, self.learned.read.get("only"))
        held_out = own[demonstrations.held_out(len(own), share, seed)].tolist()
        if asked is None:
            return _Chosen(VALIDATION, sorted(held_out), [])
        chosen = _existing(asked, count, data)
        trained_on = set(own.tolist()) - set(held_out)
        return _Chosen(CHOSEN, chosen, [e for e in chosen if e in trained_on])


def _warn_of_earlier_learning(
    earlier: Sequence[Earlier],
    data: Path,
    rename: Renaming,
    episodes: Sequence[int],
    on_event: OnEvent,
) -> None:
    """Warn if the policy also learned from another training on some of these episodes."""
    for said, source, meta in earlier:
        try:
            learned = source.selection(meta, data, rename)
            known = source.choose(learned, data, episodes).trained_on
        except AegisError:
            # This data lacks the cameras or features that the other training used.
            continue
        if known:
            text = f"{len(known)} of these {len(episodes)} episodes were trained on {said}"
            on_event(Warned(_STAGE, text))


def _began_with(learned: Learned) -> list[Path]:
    """The runs whose backbone or expert a training started from, recursively, if they exist."""
    found, waiting = list[Path](), [learned]
    while waiting:
        for name in waiting.pop().starts:
            run = _run_here(Path(name))
            if run is not None and run not in found:
                found.append(run)
                waiting.append(Learned.of(recipes.load(run / "recipe.yaml")))
    return found


def _run_here(path: Path) -> Path | None:
    """The run of a policy to which a folder belongs: itself or its checkpoint; None otherwise."""
    if not path.is_dir() or recipes.is_stream_run(path):
        return None
    run = path if (path / "recipe.yaml").is_file() else checkpoint.run_of(path)
    return run if run is not None and checkpoint.whole(run) else None


def _check_cameras(learned: str | tuple[str, ...], known: Sequence[str], data: Path) -> None:
    """Raise AegisError unless the cameras of the training are among those of the data."""
    named = (learned,) if isinstance(learned, str) else learned
    # A recipe names a camera with or without LeRobot's prefix; a policy always uses the prefix.
    of_name = {name: camera for camera in known for name in (camera, layout.short(camera))}
    missing = [name for name in named if name not in of_name]
    if not missing:
        return
    used = [of_name.get(name) for name in named]
    others = [layout.short(camera) for camera in known if camera not in used]
    fix = "give demonstrations with the cameras that the policy was trained on"
    if others:
        fix = f"say which camera is which, e.g. --rename {others[0]}={missing[0]}, or {fix}"
    raise AegisError(
        f"no camera {quoted(missing)} in '{data}', which has {', '.join(known) or 'none'}",
        f"{', '.join(named)}, as the policy was trained",
        fix,
    )


def _has_changed(words: Sequence[str], data: Path, count: int) -> AegisError:
    """The error for changed data at the training's path, most of which may have been trained on."""
    return AegisError(
        f"'{data}' is not as it was when '{words[0]}' learned from it: episodes were added, "
        f"removed or changed, and now there are {count}",
        "the demonstrations as they were, whose held-out episodes are known, or episodes of your "
        "choice",
        f"choose those that are new: {commands.aegis('evaluate', *words, '--demos', data)} "
        f"--episodes {count - 1}",
    )


def _existing(asked: Sequence[int] | None, count: int, data: Path) -> list[int]:
    """The requested episodes, sorted and without duplicates; None: all of them."""
    if asked is None:
        return list(range(count))
    if beyond := [e for e in asked if not 0 <= e < count]:
        raise AegisError(
            f"episode {beyond[0]} of '{data}', which has {count}",
            f"numbers from 0 to {count - 1}",
            f"e.g. --episodes 0-{min(9, count - 1)}",
        )
    return sorted(set(asked))


def _check_robot(
    policy: Policy, meta: PolicyMeta, data: Path, learned: Selection, on_event: OnEvent
) -> None:
    """Compare the robot with the policy's before decoding, which may take hours.

    Raises:
        AegisError: another robot, other cameras, or a joint in another place.
    """
    robot = mixture.robot_of(data, learned)
    _check_fit(policy, robot, meta, data)
    _check_names(robot, meta, data, on_event)
    _check_rate(robot, meta, data, on_event)


def _check_fit(policy: Policy, robot: Robot, meta: PolicyMeta, data: Path) -> None:
    """Raise AegisError for demonstrations of another robot or other cameras."""
    own, found = (len(policy.proprio_scale.mean), len(policy.action_scale.mean)), robot.sizes
    if own != found:
        raise AegisError(
            f"{found[0]} positions and {found[1]} actions in '{data}'"
            f"{joints.told_apart(meta, robot.names)}",
            f"{own[0]} and {own[1]}, as the run was trained on",
            "give demonstrations of the same robot",
        )
    cameras = max(1, len(robot.cameras))
    if cameras != (wanted := max(1, len(meta.get("cameras", ())))):
        raise AegisError(
            f"{cameras} camera(s) of '{data}' for a policy of {wanted}",
            "the cameras that it was trained on",
            "give the run's folder, whose recipe names them",
        )


def _shown(
    policy: Policy,
    meta: PolicyMeta,
    data: Path,
    learned: Selection,
    chosen: _Chosen,
    on_event: OnEvent,
) -> Demonstrations:
    """The demonstrations as the policy sees them, with at least the chosen episodes' frames."""
    # The training may already have decoded the frames of its episodes.
    is_own = chosen.split == VALIDATION
    only = learned.only if is_own else ",".join(map(str, chosen.episodes))
    selection, side = dataclasses.replace(learned, only=only), policy.backbone.image_size
    found = demonstrations.load(data, None, 0, selection, side, on_event=on_event, cache=False)
    shown = _as_deployed(policy, found, meta)
    policy.backbone.check_prompts(shown.images(shown.read[:1]), shown.texts)
    return shown


def _as_deployed(policy: Policy, shown: Demonstrations, meta: PolicyMeta) -> Demonstrations:
    """The demonstrations, with each camera's frames in the size that a deployed policy sees.

    Where a policy acts, images of another camera are resized to the sizes of its training; the same
    happens here. If those sizes are not known, frames are unchanged.
    """
    side = policy.backbone.image_size
    sizes = checkpoint.sizes_of(meta) if side is None else ((side, side),) * len(shown.frames)
    return shown.fitted(sizes) if sizes else shown


def _check_names(robot: Robot, meta: PolicyMeta, data: Path, on_event: OnEvent) -> None:
    """Compare the joints' names with the policy's, if both have them; warn if they differ.

    Raises:
        AegisError: a joint of the policy that has another position here.
    """
    for other in joints.differences(meta, robot.names):
        known, found = ", ".join(other.known), ", ".join(other.found)
        if other.moved is not None:
            raise AegisError(
                f"'{other.moved}' in another place in '{data}', with {other.what} {found}",
                f"{known}, in this order, as the policy was trained on",
                "give demonstrations in the policy's order, or train on these",
            )
        text = (
            f"the {other.what} in '{data}' are named {found}, and those that the policy was "
            f"trained on {known}: the errors mean something only if these are the same joints in "
            "the same order; --rename says which is which"
        )
        on_event(Warned(_STAGE, text))


def _check_rate(robot: Robot, meta: PolicyMeta, data: Path, on_event: OnEvent) -> None:
    """Warn about a control rate that differs from the policy's, so that its steps differ too."""
    own = meta.get("fps")
    if own is not None and robot.fps is not None and own != robot.fps:
        text = (
            f"'{data}' has {robot.fps:g} frames a second, and the policy was trained on {own:g}: "
            "its actions are meant for steps of another length"
        )
        on_event(Warned(_STAGE, text))


def _spread(shown: Demonstrations, episodes: Sequence[int], most: int) -> torch.Tensor:
    """Frame numbers [N <= most], spread evenly over the episodes."""
    own = torch.isin(shown.episode_of, torch.tensor(episodes)).nonzero().squeeze(1)
    return own[spread.rows(len(own), most)]


# --- what a plot shows ----------------------------------------------------------------------------


def _traces(
    policy: Policy,
    meta: PolicyMeta,
    shown: Demonstrations,
    chosen: _Chosen,
    seed: int,
    batch_size: int,
) -> list[Trace]:
    """What a plot shows of the first episodes."""
    replan = min(meta["replan"], policy.expert.shape.chunk)
    first = chosen.episodes[:TRACED]
    return [_trace(policy, shown, episode, replan, seed, batch_size) for episode in first]


def _trace(
    policy: Policy, shown: Demonstrations, episode: int, replan: int, seed: int, batch_size: int
) -> Trace:
    """What is predicted along one episode, with a new chunk every `replan` frames."""
    starts = shown.tensors["episode_starts"]
    first, end = int(starts[episode]), int(starts[episode + 1])
    at = torch.arange(first, end, replan)
    chunks = predict(policy, shown, at, seed, batch_size, _STAGE)[:, :replan]  # [n, replan, A]
    joined = chunks.reshape(-1, chunks.shape[-1])
    return Trace(
        episode,
        replan,
        recorded=shown.tensors["actions"][first:end].numpy(),
        predicted=joined[: end - first].numpy(),  # the last chunk may go past the episode's end
    )


# --- errors ---------------------------------------------------------------------------------------


def compare(
    shown: Demonstrations, at: torch.Tensor, predicted: torch.Tensor, training_std: np.ndarray
) -> OpenLoopReport:
    """The errors of chunks [N, H, A] that were predicted at frames [N].

    Steps past an episode's end do not count.

    Args:
        training_std: [A], the standard deviations that errors are relative to; 0 for an action that
            never varied in training.
    """
    errors = ActionErrors.of(shown, at, predicted, training_std)
    relative, held, valid = errors.relative, errors.held, errors.valid
    return OpenLoopReport(
        data="",
        split=CHOSEN,
        # At least the first step of each frame's chunk belongs to its episode.
        episodes=sorted(set(errors.episode_of.tolist())),
        trained_on=[],
        frames=len(at),
        chunk=predicted.shape[1],
        seed=0,
        relative_error=mean(relative, valid),
        relative_interval=errors.interval(),
        hold_error=mean(held, valid),
        dimensions=_dimensions(shown, errors),
        horizon=_horizon(relative, held, valid),
        fps=shown.fps,
        instructions=_instructions(shown, at, relative, held, valid),
        episode_errors=_episodes(errors.episode_of, relative, held, valid),
    )


def _training_std(policy: Policy, meta: PolicyMeta, on_event: OnEvent) -> np.ndarray:
    """The standard deviations of the training's actions, for `compare`.

    Checkpoints of earlier versions may lack them; their scale of relative actions or quantiles is
    used instead.
    """
    other_scale = meta.get("relative") or meta.get("normalization", "mean_std") != "mean_std"
    if "action_std" not in meta and other_scale:
        text = (
            "the checkpoint is of an earlier version and does not say how far its actions vary: "
            "errors are relative to its scale of relative actions or quantiles, and do not compare "
            "with other runs'"
        )
        on_event(Warned(_STAGE, text))
    return training_std(policy, meta)


def _rmse(error: np.ndarray) -> float:
    return float(np.sqrt(np.square(error).mean()))


def _dimensions(shown: Demonstrations, errors: ActionErrors) -> list[DimensionError]:
    hold, valid = errors.hold, errors.valid
    unit = None if shown.task is None else FULL_ACTION
    # Padding is at a chunk's end, so the steps that any frame has are the first ones, and their
    # index is their number.
    rows_of_step = [valid[:, h] for h in range(valid.shape[1]) if valid[:, h].any()]
    found = []
    for d, name in enumerate(action_names(shown)):
        by_step, std = errors.error[..., d], float(errors.training_std[d])  # [N, H]
        own = by_step[valid]
        found.append(
            DimensionError(
                name=name,
                unit=unit,
                mae=float(np.abs(own).mean()),
                rmse=_rmse(own),
                training_std=std,
                constant_rmse=float(errors.recorded[..., d][valid].std()),
                hold_rmse=None if hold is None else _rmse(hold[..., d][valid]),
                relative_error=float(np.square(own / std).mean()) if std else None,
                rmse_by_step=[_rmse(by_step[rows, h]) for h, rows in enumerate(rows_of_step)],
            )
        )
    return found


def action_names(shown: Demonstrations) -> list[str]:
    """A name for each dimension of the actions; its number if the data has no names."""
    count, names = shown.tensors["actions"].shape[1], shown.action_names
    if len(names) != count:
        names = ("",) * count
    return [name or f"action {d}" for d, name in enumerate(names)]


def _horizon(
    relative: np.ndarray | None, held: np.ndarray | None, valid: np.ndarray
) -> list[StepError]:
    """One entry per step ahead for which some episode is long enough."""
    found = []
    for h in range(valid.shape[1]):
        rows = valid[:, h]
        if rows.any():
            own = None if relative is None else float(relative[rows, h].mean())
            hold = None if held is None else float(held[rows, h].mean())
            found.append(StepError(h + 1, int(rows.sum()), own, hold))
    return found


def _episodes(
    episode_of: np.ndarray, relative: np.ndarray | None, held: np.ndarray | None, valid: np.ndarray
) -> list[EpisodeError]:
    """One entry per episode; a chunk counts for the episode in which it begins."""
    found = []
    for episode in np.unique(episode_of):
        rows = episode_of == episode
        own = valid[rows]
        found.append(
            EpisodeError(
                episode=int(episode),
                frames=int(rows.sum()),
                steps=int(own.sum()),
                relative_error=mean(None if relative is None else relative[rows], own),
                hold_error=mean(None if held is None else held[rows], own),
            )
        )
    return found


def _instructions(
    shown: Demonstrations,
    at: torch.Tensor,
    relative: np.ndarray | None,
    held: np.ndarray | None,
    valid: np.ndarray,
) -> list[InstructionError]:
    """One entry per instruction, the worst first; a chunk counts for its first frame's."""
    rows_of: dict[str, list[int]] = {}
    # A dataset may list one text as two tasks, so instructions are compared by text.
    for row, number in enumerate(shown.instruction_of[at].tolist()):
        rows_of.setdefault(shown.instructions[number], []).append(row)
    found = []
    for text, rows in rows_of.items():
        own = valid[rows]
        episode_of = shown.episode_of[at[rows]].numpy()
        ends = None
        if relative is not None:
            of_steps = np.broadcast_to(episode_of[:, None], own.shape)[own]
            ends = interval(relative[rows][own], of_steps)
        found.append(
            InstructionError(
                instruction=text,
                episodes=len(set(episode_of.tolist())),
                frames=len(rows),
                relative_error=mean(None if relative is None else relative[rows], own),
                relative_interval=ends,
                hold_error=mean(None if held is None else held[rows], own),
            )
        )
    return sorted(found, key=lambda one: one.relative_error or 0.0, reverse=True)
