"""A stream's run in memory, and its state on disk, from which it resumes to the same bytes.

`StreamRun` is the interface between the two kinds of stream, labelled images (`images`) and robot
tasks (`robots`), and the modules that both share: the driver (`train`), the loop over a task's
steps (`loop`), the files (`files`), the report (`report`) and the probe (`probe`).
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Generic, Protocol, TypeVar

import torch
from pydantic import TypeAdapter, ValidationError
from torch import Tensor, nn

from aegis_cli import recipes
from aegis_cli.common import artifacts, files
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent
from aegis_cli.common.state_dicts import reading_meta
from aegis_cli.continual.learners.base import Learner
from aegis_cli.continual.report import StreamReport, minutes, record_from, sums
from aegis_cli.core import routing
from aegis_cli.core.gaussians import Gaussian
from aegis_cli.core.routing import Routed
from aegis_cli.data.batch import Share
from aegis_cli.recipes import RobotStreamRecipe, StreamRecipe
from aegis_cli.training import optimizer_state

S = TypeVar("S", bound=StreamRecipe | RobotStreamRecipe)
STATE = "state.safetensors"
_LEARNS = "learns"  # a key: a digest of the settings that a resumed run has to keep
WHOLE = Share()  # a batch in a single pass
_GAUSSIAN = tuple(f.name for f in dataclasses.fields(Gaussian))


@dataclass
class TaskInProgress:
    """The current task of a run and its measurements so far: the state without its tensors.

    It is stored as JSON under these field names, which therefore must not change.

    Attributes:
        task, step: task and number of the next step; step 0 means that the task has not begun.
        phase: 1 while routers are being identified, else 2.
        phase1_steps: steps that this task spent in phase 1, once it is over.
        trained_phase1: parameters that learn in phase 1, per map; None for a learner without one.
        learning_phase1: all parameters that learn in phase 1, including those outside the maps.
        quiet: consecutive checks at which the routers did not move.
        masses: mean weights of the experts at the last check, per map.
        pruned, dropped: experts removed after phase 1, per map, as in `SiteRouting`.
        records, oracle, inferred: records and matrix rows of the tasks learned so far.
        intervals: the 95 % interval of each error in `oracle`, if errors are measured; None for an
            error over a single episode.
        vqa: accuracy and cross-entropy of a robot's backbone, before the first task and after each.
        window: losses since the last line of metrics.
    """

    task: int = 0
    step: int = 0
    phase: int = 2
    phase1_steps: int | None = None
    trained_phase1: dict[str, int] | None = None
    learning_phase1: int | None = None
    quiet: int = 0
    masses: dict[str, list[float]] = field(default_factory=dict)
    pruned: dict[str, list[int]] = field(default_factory=dict)
    dropped: dict[str, list[int]] = field(default_factory=dict)
    records: list[dict[str, Any]] = field(default_factory=list)
    oracle: list[list[float]] = field(default_factory=list)
    inferred: list[list[float]] = field(default_factory=list)
    intervals: list[list[list[float] | None]] = field(default_factory=list)
    vqa: list[list[float]] = field(default_factory=list)
    window: list[float] = field(default_factory=list)

    def check(self, tasks: int, steps: int) -> None:
        """Raise ValueError unless this is a place in a stream of `tasks` tasks of `steps` steps."""
        if problem := self._of_other_type():
            raise ValueError(problem)
        if not (0 <= self.task <= tasks and 0 <= self.step <= steps and self.phase in (1, 2)):
            place = f"step {self.step} of task {self.task} in phase {self.phase}"
            raise ValueError(f"{place}, in a stream of {tasks} tasks of {steps} steps")
        if len(self.records) != self.task or len(self.oracle) != self.task:
            raise ValueError(f"{len(self.records)} records of {self.task} tasks")
        for record in self.records:
            record_from(record)

    def _of_other_type(self) -> str:
        """Names the field with a value of the wrong type; "" if there is none."""
        try:
            # As JSON, because strict validation of Python values rejects a mapping.
            TypeAdapter(TaskInProgress).validate_json(files.canonical(vars(self)), strict=True)
        except ValidationError as error:
            first = error.errors()[0]
            return f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
        if any(len(row) != 2 for row in self.vqa):
            return "vqa: rows that are no pairs"
        return ""

    def next_task(self) -> TaskInProgress:
        """The place at the beginning of the next task."""
        return TaskInProgress(
            task=self.task + 1,
            records=self.records,
            oracle=self.oracle,
            inferred=self.inferred,
            intervals=self.intervals,
            vqa=self.vqa,
        )


class Objective(Protocol):
    """The training objective of one task: its examples and its loss.

    Attributes:
        name: the task's name.
        size: number of training examples.
        passes, calibration_passes: number of forward passes of a step's loss and of the
            calibration loss.
    """

    name: str
    size: int
    passes: int
    calibration_passes: int

    def fetch(self, rows: Tensor, step: int | None = None) -> Any:
        """The training examples with these numbers [B].

        Args:
            step: the step that trains on them, for which they may be augmented; None means
                unchanged examples.
        """

    def ahead(
        self, fetch: Callable[[int], Any], steps: Sequence[int]
    ) -> AbstractContextManager[Iterator[Any]]:
        """What `fetch` returns for each of these steps, called ahead of the step."""

    def loss(self, batch: Any, step: int, share: Share = WHOLE) -> Tensor:
        """The task's own loss on a batch of `fetch`, with its graph.

        All random draws depend on `step`, so that a resumed run repeats them.

        Args:
            share: the part of the batch in this pass; the losses of all parts add up to the loss.
        """

    def calibration_loss(self, share: Share = WHOLE) -> Tensor:
        """The loss on a few fixed examples, on which routers are measured."""

    def trainable_changed(self) -> None:
        """Called when other parameters learn from now on, so cached values may be stale."""


@dataclass(kw_only=True)
class StreamRun(ABC, Generic[S]):
    """A run of a learner through a stream of any kind of tasks.

    Attributes:
        recipe: settings of the stream and of the learner.
        sites: maps that can have experts, by name; empty for a learner without experts.
        fingerprint: digest of the model at the start of the stream.
        out: the run folder.
        current: the task that is being learned.
        gaussians: one per task, to infer the task; empty for a learner that does not infer it.
        partial_matrix: whether the matrix of the tasks so far is written after each of them.
    """

    recipe: S
    learner: Learner
    sites: Routed
    fingerprint: str
    out: Path
    current: TaskInProgress = field(default_factory=TaskInProgress)
    gaussians: list[Gaussian] = field(default_factory=list)
    partial_matrix: ClassVar[bool] = False

    @property
    @abstractmethod
    def score_name(self) -> str:
        """The name of a matrix entry in a progress bar."""

    # --- what learns ------------------------------------------------------------------------------

    @property
    @abstractmethod
    def model(self) -> nn.Module:
        """All modules that a learner may train, including maps with experts."""

    @property
    @abstractmethod
    def names(self) -> Sequence[str]:
        """The tasks' names, in order."""

    @abstractmethod
    def objective(self, task: int) -> Objective:
        """The training objective of task `task`."""

    @property
    def options(self) -> dict[str, Any]:
        """The learner's own section of the recipe."""
        return recipes.options(self.recipe)

    @property
    def device(self) -> torch.device:
        return next(self.model.parameters()).device

    def growing(self, task: int) -> Routed:
        """The maps that get experts in task `task`."""
        return self.sites

    def task_begun(self) -> None:
        """Called after the learner has begun a task; does nothing by default."""

    def parameters(self) -> dict[str, nn.Parameter]:
        """The parameters that the learner has changed or added, by name."""
        if self.learner.trains == "model":
            return dict(self.model.named_parameters())
        return routing.named_parameters(self.sites)

    def learning(self) -> dict[str, nn.Parameter]:
        """The parameters that learn now, by name."""
        return {name: p for name, p in self.parameters().items() if p.requires_grad}

    def rate_key(self, name: str) -> str:
        """The recipe's key that holds the peak learning rate of a parameter."""
        own = self.recipe.train.method.replace("-", "_")
        if self.learner.trains == "model":
            return f"{own}.lr"
        if ".routers." in name:
            # A learner may have its own rate for routers.
            section = own if "router_lr" in self.options else "train"
            return f"{section}.router_lr"
        return "train.lr"

    def rate(self, name: str) -> float:
        """Peak learning rate of a parameter."""
        section, key = self.rate_key(name).split(".")
        return getattr(getattr(self.recipe, section), key)

    def slower(self, names: Iterable[str]) -> str:
        """Advice for the user if these parameters have diverged."""
        return f"try a lower {' or '.join(sorted({self.rate_key(name) for name in names}))}"

    def stored(self) -> int:
        """How many numbers are stored beside the bare model."""
        if self.learner.trains == "model":
            return sum(p.numel() for p in self.model.parameters())
        beside_maps = sum(site.count() for site in self.sites.values())
        return beside_maps + sum(g.count() for g in self.gaussians)

    @property
    def inputs(self) -> dict[str, str]:
        """Digests of the run's inputs; a run resumes only with the same inputs."""
        return {"recipe": files.sha256_value(recipes.training_part(self.recipe))}

    # --- evaluation -------------------------------------------------------------------------------

    def before_stream(self) -> None:
        """Take measurements before the first task; none by default, as for images."""

    def before_task(self) -> Sequence[Tensor]:
        """Take measurements before the current task is learned.

        Returns:
            The mean feature [D] of each task so far in the bare model, this task's last; empty
            for a learner that does not compare them.
        """
        return ()

    @abstractmethod
    def after_task(self) -> dict[str, float]:
        """Measure the tasks after learning the current one, and append the rows to `current`.

        Returns:
            Further figures for the log.

        Raises:
            Diverged: a figure is not finite.
        """

    @abstractmethod
    def measure_again(self, before: StreamReport, on_event: OnEvent) -> tuple[StreamReport, int]:
        """The report of a finished run, with its matrix measured again from the run's files.

        Returns:
            The report, and how many of the last rows were measured again: all rows if the weights
            of a learned task never change, otherwise only the last row, since the weights of the
            others are gone. The remaining rows are as the training measured them.
        """

    # --- report and files -------------------------------------------------------------------------

    @abstractmethod
    def report(self) -> StreamReport:
        """The report of the tasks learned so far."""

    def summary(self) -> dict[str, Any]:
        """The fields that the reports of both kinds of stream have in common."""
        records = [record_from(raw) for raw in self.current.records]
        return {
            "name": self.recipe.name,
            "method": self.recipe.train.method,
            "tasks": tuple(record.task for record in records),
            "records": tuple(records),
            "out": str(self.out),
            "minutes": minutes(self.out),
            **sums(records),
        }

    @abstractmethod
    def save_model(self) -> None:
        """Write what the run has trained, except experts and routers, which are already written."""


AnyStreamRun = StreamRun[StreamRecipe] | StreamRun[RobotStreamRecipe]


def optimizer(
    run: AnyStreamRun, before: torch.optim.Optimizer | None = None
) -> torch.optim.Optimizer:
    """AdamW over the trainable parameters, at the run's rates; no decay on routers and scales.

    Args:
        before: the previous optimizer, from which parameters that go on learning keep their
            moments. Without moments, Adam's first steps are as long as its rate for any gradient,
            here in the middle of a schedule and with no warm-up.
    """
    groups: dict[tuple[bool, float], list[nn.Parameter]] = {}
    for name, parameter in run.learning().items():
        routes = run.learner.trains == "experts" and ".routers." in name
        groups.setdefault((routes, run.rate(name)), []).append(parameter)
    settings = []
    for routes, rate in sorted(groups):
        # A router whose logits decay would drift towards equal weights, and scales towards 0.
        decay = 0.0 if routes else run.recipe.train.weight_decay
        # The loop sets `lr` from `peak` at every step.
        group = {"params": groups[routes, rate], "lr": rate, "peak": rate, "weight_decay": decay}
        settings.append(group)
    made = torch.optim.AdamW(settings, fused=True)
    for parameter in run.learning().values():
        if before is not None and parameter in before.state:
            made.state[parameter] = before.state[parameter]
    return made


def save(run: AnyStreamRun, current: torch.optim.Optimizer | None) -> None:
    """Write the run's state: experts, routers, scales, optimizer, phase and structure.

    It holds no random state, because a step's draws depend on its number.

    Args:
        current: the optimizer of the task being learned, if one is.
    """
    optimizers = [] if current is None else [current]
    parameters = optimizer_state.to_tensors(run.parameters(), optimizers)
    tensors = parameters | gaussian_tensors(run.gaussians)
    meta: dict[str, Any] = {
        "place": dataclasses.asdict(run.current),
        "learning": sorted(run.learning()),
        "structure": {name: site.structure() for name, site in run.sites.items()},
        optimizer_state.STATELESS: optimizer_state.stateless(run.parameters(), optimizers),
    }
    if isinstance(run.recipe, RobotStreamRecipe):
        meta[_LEARNS] = _learns(run.recipe)
    artifacts.save(
        run.out / STATE,
        "training-state",
        tensors,
        seed=run.recipe.seed,
        inputs=run.inputs,
        fingerprint=run.fingerprint,
        meta=meta,
    )


def restore(run: AnyStreamRun) -> torch.optim.Optimizer | None:
    """Restore the saved state, and return the optimizer of the task being learned, if one is.

    Raises:
        AegisError: the state is damaged, or belongs to another recipe or encoder.
    """
    path = run.out / STATE
    saved = artifacts.load(path, "training-state")
    if different := changed_inputs(_as_written_now(run, saved.header), run.inputs):
        raise AegisError(
            f"a different {', '.join(different)} than the run in '{run.out}' began with",
            "the same inputs",
            "give what the run began with, or start anew in another --out",
        )
    meta = saved.header.meta
    weights = {name.removeprefix("weight."): t for name, t in saved.tensors.items()}
    with reading_meta(path):
        run.current = TaskInProgress(**meta["place"])
        run.current.check(len(run.names), run.recipe.train.steps)
        run.gaussians = gaussians_from(saved.tensors)
        # The structure first, because it creates the experts and routers that have parameters.
        rebuild(run.sites, meta["structure"], weights)
        parameters = run.parameters()
        run.model.requires_grad_(False)
        for name in meta["learning"]:
            parameters[name].requires_grad_(True)
        bare = optimizer_state.said_stateless(meta)
    # At step 0 the task has not begun, and nothing of it learns yet.
    made = optimizer(run) if run.current.step else None
    # Without the Gaussians, which are not parameters.
    own = {name: t for name, t in saved.tensors.items() if not name.startswith("tasks.")}
    optimizer_state.from_tensors(own, parameters, [made] if made else [], f"'{path}'", bare)
    return made


def place_in(path: Path) -> TaskInProgress:
    """The place of a state in its stream, read from its header only.

    Raises:
        AegisError: it is damaged.
    """
    meta = artifacts.read_header(path).meta
    with reading_meta(path):
        return TaskInProgress(**meta["place"])


def _learns(recipe: RobotStreamRecipe) -> str:
    """The digest of what may not change when the run is resumed."""
    return files.sha256_value(recipes.learning_part(recipe))


def _as_written_now(run: AnyStreamRun, header: artifacts.Header) -> Mapping[str, str]:
    """The inputs of a state, with today's digest of the recipe if the run may go on with it.

    That is the case if only keys of `recipes.adjustable` differ. The recipe digests of earlier
    versions, which recorded no digest of the others, differ also if keys were added since.
    """
    then, recipe = header.inputs, run.recipe
    if not isinstance(recipe, RobotStreamRecipe):
        return then
    same = header.meta.get(_LEARNS) == _learns(recipe)
    if not same:
        begun = recipes.load(run.out / "recipe.yaml", kind=RobotStreamRecipe)
        written, _ = recipes.read(run.out / "recipe.yaml")
        parts = recipes.training_part(begun), recipes.earlier_training_part(begun, written)
        known = then.get("recipe") in [files.sha256_value(part) for part in parts]
        same = known and _learns(begun) == _learns(recipe)
    return {**then, "recipe": run.inputs["recipe"]} if same else then


def changed_inputs(then: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Names of the inputs whose digests differ, including inputs that only one side has."""
    names = sorted(then.keys() | now.keys())
    return [name for name in names if then.get(name) != now.get(name)]


def rebuild(sites: Routed, structure: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> None:
    """Give every map the experts and routers that `structure` lists.

    Args:
        tensors: the tensors that will be copied into them, by name.

    Raises:
        KeyError, TypeError, ValueError, AttributeError: the structure does not fit these maps and
            tensors. Memory for the sizes that it states is not allocated then.
    """
    if structure.keys() != sites.keys():
        raise ValueError(f"a structure of the maps {', '.join(structure)}")
    for name, said in structure.items():
        _check_structure(name, said, tensors)
    for name, site in sites.items():
        site.rebuild(structure[name])


def _check_structure(site: str, said: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> None:
    """Raise an error if the structure of one map is invalid."""
    for number, expert in said["experts"].items():
        # Compared with the tensor, since a damaged number could require any amount of memory.
        rank = tensors[f"{site}.experts.{int(number)}.a"].shape[0]
        if expert["rank"] != rank or type(expert["frozen"]) is not bool:
            raise ValueError(f"expert {number} of '{site}' is {expert}")
        if type(expert["owner"]) is not int:
            raise ValueError(f"expert {number} of '{site}' belongs to {expert['owner']!r}")
    # `born` counts deleted experts too, so that no number is used twice.
    newest = max(map(int, said["experts"]), default=-1)
    if type(said["born"]) is not int or said["born"] <= newest:
        raise ValueError(f"{said['born']!r} experts were born in '{site}'")
    for task, router in said["routers"].items():
        chosen, top = router["experts"], router["top"]
        if int(task) < 0 or not chosen or not {str(n) for n in chosen} <= said["experts"].keys():
            raise ValueError(f"the router {task} of '{site}' has the experts {chosen}")
        fits = top is None or (type(top) is int and top >= 1)
        if not fits or type(router["constant"]) is not bool:
            raise ValueError(f"the router {task} of '{site}' is {router}")


def gaussian_tensors(gaussians: list[Gaussian]) -> dict[str, Tensor]:
    """Means [T, D], directions [T, D, r], variances [T, r], noises and thresholds [T] by name.

    The result is empty if there are no tasks.
    """
    tensors = {}
    for name in _GAUSSIAN if gaussians else ():
        tensors[f"tasks.{name}"] = torch.stack([getattr(g, name) for g in gaussians])
    return tensors


def gaussians_from(tensors: Mapping[str, Tensor]) -> list[Gaussian]:
    """The Gaussians from the tensors of `gaussian_tensors`."""
    if "tasks.mean" not in tensors:
        return []
    parts = [tensors[f"tasks.{name}"] for name in _GAUSSIAN]  # of all tasks, [T, ...] each
    found = []
    for one in zip(*parts, strict=True):
        # Cloned, because a view of one task would keep the tensors of all tasks in memory.
        found.append(Gaussian(*(t.clone() for t in one)))
    return found
