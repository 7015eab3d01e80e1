"""Streams of robot tasks: policies that share a backbone and an action expert learn one by one.

The backbone's maps get experts with every task. All weights of the action expert are trained on the
first task and then frozen; from the second task on, low-rank experts adapt it too. With the task
told, the weights that serve a learned task never change. The evaluation measures the closed-loop
success on the tasks so far (or, for tasks without a simulator, the error of the predicted actions
on held-out episodes) and the backbone's answers to questions with no task active.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from aegis_cli import recipes, sim
from aegis_cli.common import artifacts, commands, devices, gl
from aegis_cli.common.errors import AegisError, check_finite
from aegis_cli.common.events import OnEvent, Progress, Warned, ignore
from aegis_cli.common.ranks import ALONE
from aegis_cli.common.state_dicts import check_state, outline, reading_meta, shape_from
from aegis_cli.continual import files, learners, places, robot_demos
from aegis_cli.continual.report import (
    Ends,
    ErrorMatrix,
    RecordedStreamReport,
    RobotStreamReport,
    StreamReport,
    SuccessMatrix,
    vqa_scores,
)
from aegis_cli.continual.robot_evaluators import (
    ClosedLoopEvaluator,
    HeldOutEvaluator,
    Questions,
    RobotEvaluator,
)
from aegis_cli.continual.state import WHOLE, StreamRun, changed_inputs
from aegis_cli.core import routing
from aegis_cli.core.routing import Routed
from aegis_cli.data import augment, spread
from aegis_cli.data.batch import Normalizer, RobotBatch, Share, WholeBatch
from aegis_cli.data.demonstrations import Demonstrations
from aegis_cli.data.relative import Places
from aegis_cli.data.relative import of_meta as relative_of
from aegis_cli.data.vqa import sets
from aegis_cli.models import backbones, policy_meta
from aegis_cli.models.acting import Acting
from aegis_cli.models.action_errors import no_better_than_standing_still
from aegis_cli.models.backbones.base import FLOAT32, Backbone
from aegis_cli.models.expert import ActionExpert, ExpertShape, check_fit
from aegis_cli.models.policy import Policy
from aegis_cli.models.policy_meta import PolicyMeta
from aegis_cli.models.structure import digest
from aegis_cli.recipes import RobotStreamRecipe, RobotTrain
from aegis_cli.training import ahead, assemble, checkpoint, freezing, loading, train
from aegis_cli.training import step as training_step
from aegis_cli.training.freezing import Still

# Number of evenly spaced training frames on which routers are measured, with constant noise.
CALIBRATION_FRAMES = 32
# maps of a backbone that get no experts
ATTENTION_INPUTS = {"qkv", "qkv_proj", "q_proj", "k_proj", "v_proj"}
# purposes of a step's noise, each with a generator of its own
TRAINING_NOISE, VALIDATION_NOISE, CALIBRATION_NOISE = 1, 2, 3
ACTION_EXPERT, BACKBONE = "expert.safetensors", "backbone"
QUESTION_FILE = "vqa/"  # prefix of the names of question files among a run's inputs

Scales = tuple[Normalizer, Normalizer]  # of positions and of actions


# --- the run --------------------------------------------------------------------------------------


@dataclass(kw_only=True)
class RobotStreamRun(StreamRun[RobotStreamRecipe]):
    """A run through a stream of robot tasks.

    Attributes:
        policies: one per task; they share backbone and action expert, and each has its own scales.
        views: the entries of each task's policy meta that describe its input and output, such as
            `cameras`, `pictures`, `rename` and `relative`.
        still: the parts of the backbone that the recipe freezes.
        demos: one per task; empty in a run that only acts.
        question_files: digests of the files that the questions come from; empty for scenes.
        evaluator: measures the run; None in a run that only acts.
    """

    partial_matrix = True

    policies: tuple[Policy, ...]
    views: Sequence[PolicyMeta]
    still: Still = Still()
    demos: tuple[Demonstrations, ...] = ()
    question_files: Mapping[str, str] = field(default_factory=dict)
    evaluator: RobotEvaluator | None = None

    @property
    def score_name(self) -> str:
        return "success" if self.recipe.simulated else "action error"

    @property
    def model(self) -> Policy:
        return self.policies[0]

    @property
    def names(self) -> tuple[str, ...]:
        return self.recipe.tasks

    def objective(self, task: int) -> FlowMatchingLoss:
        return FlowMatchingLoss(task, self.recipe, self.policies[task], self.demos[task])

    def growing(self, task: int) -> Routed:
        """All maps; with the first task only the backbone's, as the whole action expert learns."""
        if task > 0:
            return self.sites
        return {n: site for n, site in self.sites.items() if not n.startswith("expert.")}

    def task_begun(self) -> None:
        """Freeze what the recipe freezes; with the first task, train the whole action expert."""
        self.still.hold()
        if self.learner.trains == "experts" and self.current.task == 0:
            self.model.expert.requires_grad_(True)

    def parameters(self) -> dict[str, nn.Parameter]:
        if self.learner.trains == "model":
            return super().parameters()
        return super().parameters() | {
            f"expert.{name}": p for name, p in own_parameters(self.model.expert).items()
        }

    def rate_key(self, name: str) -> str:
        own = name.startswith("expert.") and not is_added(name)
        return "train.expert_lr" if own else super().rate_key(name)

    def stored(self) -> int:
        """How many numbers are stored beside the bare backbone, including the scales so far."""
        count = super().stored()
        for policy in self.policies[: self.current.task + 1]:
            for scale in (policy.proprio_scale, policy.action_scale):
                count += sum(buffer.numel() for buffer in scale.buffers())
        if self.learner.trains == "experts":
            count += sum(p.numel() for p in own_parameters(self.model.expert).values())
        return count

    @property
    def inputs(self) -> dict[str, str]:
        digests = {}
        # Not strict, because a run that only acts has no demonstrations.
        for task, demos in zip(self.names, self.demos, strict=False):
            digests[f"demos of {task}"] = demos.sha256
        return {**super().inputs, "backbone": self.fingerprint, **digests, **self.question_files}

    def acting(self, task: int) -> Acting:
        """The policy of task `task`; only this task is active from here on.

        Raises:
            AegisError: the task has no simulator.
        """
        if not self.recipe.simulated:
            raise no_simulator(self.out, self.names[task])
        self.activate(task)
        # The policies share backbone and action expert and differ in their scales.
        policy, name, view = self.policies[task].eval(), self.names[task], self.views[task]
        cameras = checkpoint.cameras_of(view, name)
        sizes = checkpoint.sizes_of(view)
        settings = self.recipe.rollout
        return Acting(policy, name, settings.replan, cameras, settings.ensemble, sizes)

    @property
    def origin(self) -> dict[str, str]:
        """The policy meta that describes the original backbone: `stored`, `base_model`."""
        backbone, found = self.model.backbone, dict[str, str]()
        if backbone.hub_id is not None:
            found["base_model"] = backbone.hub_id
        if backbone.stored != FLOAT32:
            found["stored"] = backbone.stored
        return found

    def meta(self, task: int) -> PolicyMeta:
        """The meta of the policy of task `task`, which its users need."""
        recipe = self.recipe
        found: dict[str, Any] = {
            "method": recipe.train.method,
            "task": self.names[task] if recipe.simulated else None,
            "replan": recipe.rollout.replan,
            "normalization": recipe.train.normalization,
        }
        if recipe.rollout.ensemble is not None:
            found["ensemble"] = recipe.rollout.ensemble
        chosen = recipes.selected(recipe)
        if "only" in chosen:
            chosen["only"] = chosen["only"][task]
        return cast(PolicyMeta, {**found, **chosen, **self.views[task], **self.origin})

    def activate(self, task: int | None) -> None:
        """Let every map compute for task `task`; None means the bare backbone."""
        routing.activate(self.sites, None if task is None else self.learner.router(task))

    def measure_with(self, source: Questions, on_event: OnEvent) -> None:
        """Measure the run with these questions.

        Raises:
            AegisError: there are too few of them, or the backbone cannot read one.
        """
        self.question_files = source.sha256
        kind = ClosedLoopEvaluator if self.recipe.simulated else HeldOutEvaluator
        self.evaluator = kind(self, source, on_event)

    @property
    def measuring(self) -> RobotEvaluator:
        """The evaluator of a run that does not only act."""
        assert self.evaluator is not None
        return self.evaluator

    def before_stream(self) -> None:
        known = self.measuring.vqa()
        self.current.vqa.append(known)
        self.measuring.warn_of_little_knowledge(known[0])

    def after_task(self) -> dict[str, float]:
        current = self.current
        self.demos[current.task].check_files()  # they must not have changed during the training
        # Each measurement activates its own task and does not rely on the one before.
        current.oracle.append(self.measuring.row(current.task))
        if not self.recipe.simulated:
            current.intervals.append(self.measuring.intervals(current.task))
            self._warn_of_standing_still(current.oracle[-1][-1])
        current.vqa.append(self.measuring.vqa())
        loss = self.validation_loss()
        figures = {"validation loss": loss, "VQA cross-entropy": current.vqa[-1][1]}
        if not self.recipe.simulated:
            figures["action error"] = current.oracle[-1][-1]
        where = f"after task '{self.names[current.task]}'"
        check_finite(figures, where, self.slower(self.parameters()), self.recipe.train.steps)
        return {"validation_loss": loss}

    def _warn_of_standing_still(self, error: float) -> None:
        """Warn of a task whose actions are predicted no better than by holding the position."""
        task = self.current.task
        hold = self.measuring.hold_errors[task]
        if (text := no_better_than_standing_still(error, hold)) is not None:
            self.measuring.on_event(Warned(f"task {task + 1} {self.names[task]}", text))

    def validation_loss(self, on_event: OnEvent = ignore) -> float:
        """The loss of the task just learned, on held-out episodes."""
        number, settings = self.current.task, self.recipe.train
        self.activate(number)
        noise = _seed(self.recipe.seed, number * settings.steps, VALIDATION_NOISE)
        policy = self.policies[number].eval()
        demos = self.demos[number]
        return train.validation_loss(policy, demos, settings, noise, on_event=on_event)

    def measure_again(self, before: StreamReport, on_event: OnEvent) -> tuple[StreamReport, int]:
        """Measure every task once; with frozen experts all rows of a column share one policy."""
        assert isinstance(before, SuccessMatrix | ErrorMatrix)
        count = len(self.names)
        now = []
        for task in range(count):
            now.append(self.measuring.tried(task))
            on_event(Progress("probe", task + 1, count, "tasks"))
        known = self.measuring.vqa()
        # Without frozen experts, only the last row's weights are left.
        first = 0 if self.learner.frozen else count - 1
        rows = tuple(tuple(now[: t + 1]) for t in range(first, count))
        ends = [self.measuring.intervals(t) for t in range(first, count)]
        measured = self.matrix(
            [*before.measured_rows[:first], *rows], [*before.measured_intervals[:first], *ends]
        )
        # VQA has one more score than there are rows: the one before the first task.
        told = [(then.accuracy, then.cross_entropy) for then in before.vqa]
        vqa = vqa_scores([*told[: first + 1], *[known] * (count - first)])
        return dataclasses.replace(before, **measured, vqa=vqa), count - first

    def matrix(self, rows: Sequence[Sequence[float]], intervals: Sequence[Ends]) -> dict[str, Any]:
        """The scores of the tasks so far with their figures, by a report's attribute names."""
        kind = SuccessMatrix if self.recipe.simulated else ErrorMatrix
        return kind.of_measured(rows, intervals, self.measuring.hold_errors)

    def report(self) -> RobotStreamReport | RecordedStreamReport:
        current, common = self.current, self.summary()
        kind = RobotStreamReport if self.recipe.simulated else RecordedStreamReport
        return kind(
            **common,
            **self.matrix(current.oracle, current.intervals),
            stream=", ".join(common["tasks"]),
            vqa=vqa_scores(current.vqa),
            inputs=self.inputs,
        )

    def save_model(self) -> None:
        """Save the action expert's own weights, each task's scales, and the backbone if trained."""
        fingerprint = self.fingerprint
        if self.learner.trains == "model":
            self.model.backbone.save(self.out / BACKBONE)
            fingerprint = self.model.backbone.fingerprint()
        own = own_parameters(self.model.expert)
        tensors = {f"expert.{name}": parameter for name, parameter in own.items()}
        for i, policy in enumerate(self.policies):
            for kind, scale in (("proprio", policy.proprio_scale), ("action", policy.action_scale)):
                tensors |= {f"tasks.{i}.{kind}.{name}": t for name, t in scale.state_dict().items()}
        meta: dict[str, Any] = {
            "method": self.recipe.train.method,
            "tasks": list(self.names),
            "shape": self.model.expert.shape.to_json(),
        }
        meta |= self.origin
        if any(self.views):
            meta["views"] = list(self.views)
        if self.sites:
            meta["experts"] = digest(artifacts.load(self.out / files.EXPERTS).tensors)
        artifacts.save(
            self.out / ACTION_EXPERT,
            "expert",
            tensors,
            seed=self.recipe.seed,
            inputs=self.inputs,
            fingerprint=fingerprint,
            meta=meta,
        )


def build(recipe: RobotStreamRecipe, out: Path, on_event: OnEvent = ignore) -> RobotStreamRun:
    """Build backbone, demonstrations, questions and learner of a run that is to be trained.

    Demonstrations that are not given are recorded unless they exist already.

    Raises:
        AegisError: inputs that do not fit together; nothing has been recorded then.
    """
    source = questions(recipe, on_event)  # reject a bad set before anything is recorded
    if recipe.simulated:
        gl.check()
    for task in recipe.tasks if recipe.simulated else ():
        if recipe.demos.paths is None:
            sim.check_recordable(task)
        else:
            sim.check(task)
    backbone, fingerprint = _loaded(recipe.backbone, recipe.train.weights)
    if recipe.train.gradient_checkpointing:
        backbone.checkpoint_gradients()
    _check_freeze(recipe, backbone, on_event)
    loading.check_cameras(backbone, recipe)
    robot_demos.check_given(recipe, on_event)
    robot_demos.check_relative(recipe)
    for task in recipe.tasks if recipe.simulated else ():
        robot_demos.check_words(backbone, task)
    # Last, after all other checks, because recording takes long.
    numbers = range(len(recipe.tasks))
    demos = tuple(robot_demos.load(recipe, i, backbone, out, on_event) for i in numbers)
    joints = [robot_demos.Joints.of(d) for d in demos]
    places = robot_demos.relative_places(recipe, joints, on_event)
    fitted = recipe.train.normalization, recipe.train.chunk
    scales = [d.scales(*fitted, own) for d, own in zip(demos, places, strict=True)]
    # One action expert serves all robots, so it has the sizes of the robot with the most joints.
    proprio = max(len(positions.mean) for positions, _ in scales)
    actions = max(len(of_actions.mean) for _, of_actions in scales)
    shape = assemble.expert_shape(backbone, recipe, proprio, actions)
    each_task = zip(demos, scales, places, strict=True)
    views = [_view(recipe, *each, backbone) for each in each_task]
    run = _assemble(recipe, backbone, fingerprint, shape, scales, views, out, demos)
    run.model.expert.recomputes = recipe.train.gradient_checkpointing
    run.measure_with(source, on_event)
    return run


def load(
    recipe: RobotStreamRecipe,
    path: Path,
    before: StreamReport,
    on_event: OnEvent = ignore,
    backbone: str | None = None,
    paths: Sequence[Path] = (),
) -> RobotStreamRun:
    """Load a finished run in its final state, to measure it again.

    Args:
        before: the run's report.
        backbone, paths: the new places of its backbone and demonstrations; by default the run's.

    Raises:
        AegisError: files are missing, damaged or of another backbone, or the questions or held-out
            episodes are not those that the run was measured with.
    """
    if not recipe.simulated:  # before a large backbone is loaded
        recipe = places.here(path, recipe, backbone or recipe.backbone, paths)
        places.check_demos(path, recipe, "probe")
    elif paths:
        places.here(path, recipe, recipe.backbone, paths)  # raises
    run = load_to_act(path, backbone)
    source = questions(recipe, on_event)
    asked = {name: sha for name, sha in before.inputs.items() if name.startswith(QUESTION_FILE)}
    if changed := changed_inputs(asked, source.sha256):
        raise AegisError(
            f"different questions than the run in '{path}' was measured with: {', '.join(changed)}",
            "the same files",
            "bring them back, or train the stream again in another --out",
        )
    if not recipe.simulated:
        run.demos = _as_learned(recipe, run, before, on_event)
    run.measure_with(source, on_event)
    return run


def _as_learned(
    recipe: RobotStreamRecipe, run: RobotStreamRun, before: StreamReport, on_event: OnEvent
) -> tuple[Demonstrations, ...]:
    """The demonstrations that a finished run has learned from, for its held-out episodes.

    Raises:
        AegisError: they are gone, or not those that the run learned from.
    """
    count, backbone = len(recipe.tasks), run.model.backbone
    demos = tuple(robot_demos.load(recipe, i, backbone, run.out, on_event) for i in range(count))
    now = {f"demos of {task}": d.sha256 for task, d in zip(recipe.tasks, demos, strict=True)}
    then = {name: before.inputs.get(name, "") for name in now}
    if changed := changed_inputs(then, now):
        raise AegisError(
            f"different {', '.join(changed)} than the run in '{run.out}' learned from",
            "the same demonstrations, whose held-out episodes it was measured on",
            "bring them back, or train the stream again in another --out",
        )
    return demos


def load_to_act(path: Path, backbone_at: str | None = None) -> RobotStreamRun:
    """Load a finished run that can act, but not learn.

    Args:
        backbone_at: the new place of its backbone; None: the run's.

    Raises:
        AegisError: the run is not done, its backbone is gone, `backbone_at` is given for a run that
            holds its own, or files are missing, damaged or of another backbone.
    """
    files.read(path)
    recipe = recipes.load(path / "recipe.yaml", kind=RobotStreamRecipe)
    trains_model = learners.get(recipe.train.method).trains == "model"
    if trains_model and backbone_at is not None:
        raise places.refuse(path)
    # A run with a backbone of its own does not need the one that it began with.
    recipe = places.here(path, recipe, recipe.backbone if trains_model else backbone_at)
    home = path / BACKBONE if trains_model else None
    name = recipe.backbone if home is None else str(home)
    backbone, fingerprint = _loaded(name, recipe.train.weights)
    saved = _saved_expert(path / ACTION_EXPERT, recipe, fingerprint, home)
    shape = _checked_shape(path / ACTION_EXPERT, saved, backbone, len(recipe.tasks))
    scales = [
        (_scale(saved.tensors, i, "proprio"), _scale(saved.tensors, i, "action"))
        for i in range(len(recipe.tasks))
    ]
    views = _views(path / ACTION_EXPERT, saved, len(recipe.tasks))
    run = _assemble(recipe, backbone, fingerprint, shape, scales, views, path)
    _put_back(run, saved)
    return run


def take_over(run: RobotStreamRun, learned: RobotStreamRecipe) -> None:
    """Give a run that is at its start what the finished run in its folder has learned.

    Args:
        learned: the finished run's recipe, with the first of this run's tasks.

    Raises:
        AegisError: files are missing, damaged or of another backbone, or the finished run's action
            expert has fewer joints than this run's robots.
    """
    path, fingerprint, home = run.out / ACTION_EXPERT, run.fingerprint, None
    if run.learner.trains == "model":
        home = run.out / BACKBONE
        trained = backbones.load(str(home))
        fingerprint = trained.fingerprint()
        run.model.backbone.load_state_dict(trained.state_dict())
    saved = _saved_expert(path, learned, fingerprint, home)
    shape = _checked_shape(path, saved, run.model.backbone, len(learned.tasks))
    if shape != run.model.expert.shape:
        needed, there = run.model.expert.shape, shape
        raise AegisError(
            f"robots of {needed.proprio} positions and {needed.actions} actions for the stream in "
            f"'{run.out}'",
            f"at most the {there.proprio} positions and {there.actions} actions that its action "
            "expert was made for",
            "begin a stream with all tasks in another --out",
        )
    _put_back(run, saved)


def _put_back(run: RobotStreamRun, saved: artifacts.Artifact) -> None:
    """Copy a finished run's action expert and low-rank experts into a run at its start.

    Raises:
        AegisError: the low-rank experts are missing, damaged, or not those of the action expert.
    """
    with torch.no_grad():
        for name, parameter in own_parameters(run.model.expert).items():
            parameter.copy_(saved.tensors[f"expert.{name}"])
    if run.sites:
        files.attach(run)
        _check_experts(run.out, saved)


def _saved_expert(
    path: Path, recipe: RobotStreamRecipe, fingerprint: str, home: Path | None
) -> artifacts.Artifact:
    """The action expert of a run, with each task's scales.

    Args:
        home: the folder of the run's own backbone; None: it is the recipe's.

    Raises:
        AegisError: the file is missing, damaged, or belongs to other tasks or another backbone.
    """
    name = recipe.backbone if home is None else str(home)
    owner = artifacts.Owner(fingerprint, name, files.bring_back(name))
    saved = artifacts.load(path, "expert", owner=owner)
    if saved.header.meta.get("tasks") != list(recipe.tasks):
        raise AegisError(
            f"'{path}' is not the action expert of {', '.join(recipe.tasks)}",
            "the file of this run",
            "train the stream again",
        )
    return saved


def _check_experts(path: Path, saved: artifacts.Artifact) -> None:
    """Raise AegisError unless the run's low-rank experts are those that the file was saved with."""
    experts = artifacts.load(path / files.EXPERTS).tensors
    if saved.header.meta.get("experts") != digest(experts):
        raise AegisError(
            f"'{path / ACTION_EXPERT}' and '{path / files.EXPERTS}' do not belong together",
            "the files of one run",
            "train the stream again",
        )


def _loaded(name: str, weights: str) -> tuple[Backbone, str]:
    """A backbone on its device, with its weights in the dtype of `train.weights`.

    Returns:
        The backbone, and its fingerprint, which is that of the weights before rounding.

    Raises:
        AegisError: it cannot be loaded, or has to be float32.
    """
    backbone = backbones.load(name)
    fingerprint = backbone.fingerprint()
    assemble.round_weights(backbone, weights)
    return backbone.to(devices.pick()).eval(), fingerprint


def _assemble(
    recipe: RobotStreamRecipe,
    backbone: Backbone,
    fingerprint: str,
    shape: ExpertShape,
    scales: Sequence[Scales],
    views: Sequence[PolicyMeta],
    out: Path,
    demos: tuple[Demonstrations, ...] = (),
) -> RobotStreamRun:
    """A run at its start: one policy per task, and sites for experts if its learner has any."""
    learner = learners.get(recipe.train.method)
    still = freezing.named(backbone, recipe.train.freeze)
    places = [tuple(view.get("relative", ())) for view in views]
    policies = share(backbone, shape, scales, recipe.seed, places)
    return RobotStreamRun(
        recipe=recipe,
        learner=learner,
        sites=route(policies[0], still) if learner.trains == "experts" else {},
        fingerprint=fingerprint,
        out=out,
        policies=policies,
        views=views,
        still=still,
        demos=demos,
    )


def load_policy(path: Path, task: str | None, backbone: str | None = None) -> Acting:
    """The policy of one of a run's tasks, ready to act in simulation.

    Args:
        backbone: as in `load_to_act`.

    Raises:
        AegisError: the run has not learned the task, no task is named, the task has no simulator,
            or `load_to_act` raises.
    """
    number = number_of(path, task)
    recipe = recipes.load(path / "recipe.yaml", kind=RobotStreamRecipe)
    if not recipe.simulated:  # before a large backbone is loaded
        raise no_simulator(path, recipe.tasks[number])
    return load_to_act(path, backbone).acting(number)


def no_simulator(run: Path, task: str) -> AegisError:
    """The error for playing a task that is not simulated."""
    return AegisError(
        f"'{task}' of the stream in '{run}', a task that no simulator has",
        "a simulated task, to roll out",
        f"run it on the robot: {commands.aegis('serve', run, '--task', task)}; how far its actions "
        f"are from held-out ones, {commands.aegis('evaluate', run, '--task', task)} shows",
    )


def number_of(path: Path, task: str | None) -> int:
    """The number of one of a run's tasks.

    Raises:
        AegisError: the run has not learned the task, or it has several and none is named.
    """
    known = files.read(path).tasks
    if task is None and len(known) == 1:
        return 0
    if task not in known:
        named = "no --task" if task is None else f"task '{task}'"
        raise AegisError(
            f"{named} for the stream in '{path}'",
            f"one of its tasks: {', '.join(known)}",
            f"--task {known[0]}; in Python, task={known[0]!r}",
        )
    return known.index(task)


def _checked_shape(
    path: Path, saved: artifacts.Artifact, backbone: Backbone, tasks: int
) -> ExpertShape:
    """The shape of a stream's action expert; checks that the file has its tensors and the scales.

    Raises:
        AegisError: the file is damaged or belongs to another backbone.
    """
    with reading_meta(path):
        shape = shape_from(ExpertShape, saved.header.meta["shape"], path, len(saved.tensors))
        check_fit(shape, backbone.depth, backbone.heads, backbone.head_dim)
    with outline(path):
        own = own_parameters(ActionExpert(shape))
    wanted: dict[str, Tensor] = {f"expert.{name}": p for name, p in own.items()}
    most = {"proprio": shape.proprio, "action": shape.actions}
    for task in range(tasks):
        for kind, size in most.items():
            # Robots with fewer joints than the largest one have shorter scales.
            mean = saved.tensors.get(f"tasks.{task}.{kind}.mean")
            length = size if mean is None else min(mean.numel(), size)
            for part in ("mean", "std"):
                name = f"tasks.{task}.{kind}.{part}"
                wanted[name] = torch.empty(length, dtype=torch.float32)
    check_state(f"'{path}'", saved.tensors, wanted)
    return shape


def _views(path: Path, saved: artifacts.Artifact, tasks: int) -> list[PolicyMeta]:
    """The inputs of each task's policy, as in `views`; empty for files of earlier versions.

    Raises:
        AegisError: these entries of the header are damaged.
    """
    with reading_meta(path):
        views = list(saved.header.meta.get("views", [{}] * tasks))
        if len(views) != tasks:
            raise ValueError(f"'views' of {len(views)} tasks for {tasks}")
        for i, view in enumerate(views):
            policy_meta.check_view(view)
            sizes = [len(saved.tensors[f"tasks.{i}.{kind}.mean"]) for kind in ("action", "proprio")]
            policy_meta.check_recorded(view, *sizes)
            relative_of(view, *sizes)
    return views


def _view(
    recipe: RobotStreamRecipe,
    shown: Demonstrations,
    scales: Scales,
    places: Places,
    backbone: Backbone,
) -> PolicyMeta:
    """The inputs of a task's policy; for a robot that is not simulated also their meaning."""
    found = assemble.view(shown, backbone)
    if places:
        found["relative"] = list(places)
    if places or not assemble.is_spread(scales[1], recipe.train.normalization, shown):
        found["action_std"] = shown.action_std
    reach = shown.proprio_reach(scales[0], recipe.train.normalization)
    if reach is not None:
        found["proprio_reach"] = reach
    if recipe.demos.rename is not None:
        found["rename"] = recipe.demos.rename
    if recipe.simulated:
        return found
    if "state" in (chosen := recipes.selected(recipe)):
        found["state"] = chosen["state"]
    return cast(PolicyMeta, {**found, **shown.recorded})


def _scale(tensors: Mapping[str, Tensor], task: int, kind: str) -> Normalizer:
    return Normalizer(tensors[f"tasks.{task}.{kind}.mean"], tensors[f"tasks.{task}.{kind}.std"])


# --- parts of a stream ----------------------------------------------------------------------------


def questions(recipe: RobotStreamRecipe, on_event: OnEvent = ignore) -> Questions:
    """The recipe's question set.

    Raises:
        AegisError: it cannot be read.
    """
    asked = recipe.probe
    return sets.read(asked.only_set, asked.skip_bad, on_event, asked.ask)


def _check_freeze(recipe: RobotStreamRecipe, backbone: Backbone, on_event: OnEvent) -> None:
    """Raise AegisError if freezing has no effect or leaves nothing of the backbone to learn.

    Each name in `train.freeze` must name a part of the backbone.
    """
    still = freezing.named(backbone, recipe.train.freeze)
    if not still.given:
        return
    learner = learners.get(recipe.train.method)
    with_learner = f"{still.said} with method '{learner.name}'"
    if learner.trains == "model":
        left = still.left(backbone.parameter_groups())
    else:
        grown = grown_maps(backbone)
        left = list(still.without(grown))
        if len(left) == len(grown):  # none of the maps that get experts is frozen
            raise AegisError(
                f"{with_learner}, which trains none of it anyway",
                "parts with maps that would get experts: the MLPs and attention outputs of all"
                " language layers but the last",
                "name such parts, delete train.freeze, or --method sequential, which trains all",
            )
    freezing.check_something_learns(with_learner, left, "freeze less")
    still.warn_of_tied(on_event)


def share(
    backbone: Backbone,
    shape: ExpertShape,
    scales: Sequence[Scales],
    seed: int,
    places: Sequence[Places],
) -> tuple[Policy, ...]:
    """One policy per task; all share one action expert, initialized from the seed.

    Args:
        places: what each task's actions are relative to; () if all are absolute.
    """
    # Forked, so that the caller's random state does not change.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        expert = ActionExpert(shape)
    device = devices.pick()
    made = []
    for both, own in zip(scales, places, strict=True):
        made.append(Policy(backbone, expert, *both, own).to(device).eval())
    return tuple(policy.requires_grad_(False) for policy in made)


def grown_maps(backbone: Backbone) -> dict[str, nn.Linear]:
    """The maps of a backbone's language layers that may get experts.

    The inputs of attention get none. Nor do the last layer's maps: they come after the last keys
    and values, which are all that the action expert reads, so no action depends on them.
    """
    last_layer = backbone.parameter_groups()[f"layers.{backbone.depth - 1}"]
    last = {id(parameter) for parameter in last_layer}
    maps = {}
    for name, linear in backbone.language_maps().items():
        leaf = name.rpartition(".")[2]
        if leaf not in ATTENTION_INPUTS and id(linear.weight) not in last:
            maps[name] = linear
    return maps


def route(policy: Policy, still: Still) -> dict[str, routing.RoutedLinear]:
    """Prepare maps of the backbone's language layers and all the action expert's maps for experts.

    Args:
        still: the parts of the backbone whose maps get no experts.
    """
    maps = {}
    for name, linear in still.without(grown_maps(policy.backbone)).items():
        maps[f"backbone.{name}"] = linear
    for name, module in policy.expert.named_modules():
        if isinstance(module, nn.Linear):
            maps[f"expert.{name}"] = module
    return routing.route(policy, maps)


def is_added(name: str) -> bool:
    """Whether `name` is a parameter of an expert or a router beside a map."""
    return ".experts." in name or ".routers." in name


def own_parameters(expert: ActionExpert) -> dict[str, nn.Parameter]:
    """The action expert's parameters without experts and routers, under their original names."""
    own = {}
    for name, parameter in expert.named_parameters():
        if not is_added(name):
            # A map with experts is the `base` of a `RoutedLinear`.
            own[name.replace(".base.", ".")] = parameter
    return own


# --- the training objective -----------------------------------------------------------------------


class FlowMatchingLoss:
    """The flow matching loss on a task's demonstrations."""

    def __init__(
        self, number: int, recipe: RobotStreamRecipe, policy: Policy, demos: Demonstrations
    ) -> None:
        self.name, self.size = recipe.tasks[number], len(demos.train)
        self._first_step = number * recipe.train.steps
        self._settings, self._seed = recipe.train, recipe.seed
        self._policy, self._demos = policy, demos
        self._device = policy.backbone.device
        self.passes = recipe.train.accumulate
        looked_at = spread.rows(self.size, CALIBRATION_FRAMES)
        self.calibration_passes = calibration_passes(recipe.train, len(looked_at))
        # Prepared once, since they are measured many times.
        self._calibration = self._prepared(self._read(looked_at), self.calibration_passes)

    def fetch(self, rows: Tensor, step: int | None = None) -> RobotBatch:
        return self._prepared(self._read(rows, step), self.passes)

    def ahead(
        self, fetch: Callable[[int], RobotBatch], steps: Sequence[int]
    ) -> AbstractContextManager[Iterator[RobotBatch]]:
        return ahead.batches(fetch, steps, self._device)

    def preparing_s(self, rows: Tensor) -> float:
        """Seconds in which one thread reads and processes the frames of these rows for step 0."""

        def prepare(part: Tensor) -> None:
            batch = self._read(part, 0)
            self._policy.backbone.process(batch.images, batch.instructions)

        return ahead.preparing_s(prepare, rows)

    def _prepared(self, batch: RobotBatch, passes: int) -> RobotBatch:
        """The batch, for a GPU with the backbone's inputs for each pass, made on the CPU."""
        if not devices.reading_stalls(self._device):
            return batch
        size = len(batch), int((~batch.is_pad).sum())
        return training_step.with_prepared(batch, size, self._policy.backbone, ALONE, passes)

    def _read(self, rows: Tensor, step: int | None = None) -> RobotBatch:
        settings, frames = self._settings, self._demos.train[rows]
        batch = self._demos.batch(frames, settings.chunk)
        if step is None or settings.augment is None:
            return batch
        numbers, drawn = frames.tolist(), (settings.augment, settings.augment_count, self._seed)
        # Seeded by the step in the whole stream, since frame numbers repeat across tasks.
        at, repeats = self._first_step + step, augment.earlier(numbers)
        images = augment.augmented(batch.images, numbers, *drawn, at, repeats)
        return dataclasses.replace(batch, images=images)

    def loss(self, batch: RobotBatch, step: int, share: Share = WHOLE) -> Tensor:
        draws = generator(self._seed, self._first_step + step, TRAINING_NOISE)
        return self._loss(batch, draws, share)

    def calibration_loss(self, share: Share = WHOLE) -> Tensor:
        # The same noise at each check, so that only changes of the routers show.
        draws = generator(self._seed, self._first_step, CALIBRATION_NOISE)
        return self._loss(self._calibration, draws, share)

    def trainable_changed(self) -> None:
        """Nothing is kept from step to step."""

    def _loss(self, batch: RobotBatch, draws: torch.Generator, share: Share) -> Tensor:
        # Each pass draws the noise of the whole batch and uses the part for its own frames.
        of = WholeBatch(len(batch), int((~batch.is_pad).sum()), share)
        part = batch if share == WHOLE else batch.rows(share.rows(len(batch)))
        if batch.prepared:
            inputs = batch.prepared[share.index].inputs
            encoding = self._policy.backbone.encode(inputs.to(self._device))
        else:  # on a CPU nothing is prepared ahead
            encoding = self._policy.encode(part.images, part.instructions)
        samples = self._settings.flow_samples
        return self._policy.flow_loss(part, encoding, samples, draws, of=of)


def calibration_passes(settings: RobotTrain, frames: int) -> int:
    """Number of passes to measure routers on `frames` frames with no more memory than a step.

    A Hugging Face model checkpoints gradients only in training mode, and routers are measured in
    evaluation mode. With `gradient_checkpointing` each pass therefore has a single frame.
    """
    if settings.gradient_checkpointing:
        return frames
    if settings.accumulate == 1:
        return 1
    of_a_pass = max(1, settings.batch_size // settings.accumulate)
    return -(-frames // of_a_pass)  # rounded up


def generator(seed: int, index: int, purpose: int) -> torch.Generator:
    """A generator that depends on the seed, the step in the whole stream and the purpose.

    A resumed run therefore draws the same noise as an uninterrupted one.
    """
    return torch.Generator().manual_seed(_seed(seed, index, purpose))


def _seed(seed: int, index: int, purpose: int) -> int:
    # Purposes are below 4, so no two of one step share a generator. Nor do two seeds in streams of
    # up to a million steps.
    return (seed * 1_000_003 + index) * 4 + purpose
