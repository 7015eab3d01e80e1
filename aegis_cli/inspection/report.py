"""The report on a path; nothing here loads torch.

For a run or ledger it shows how much gradient energy each layer shed, and when; for a stream's run,
which experts were used and which were pruned, per task and map.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from aegis_cli.common.errors import AegisError

if TYPE_CHECKING:
    from aegis_cli.continual.report import RobotMatrix, StreamReport
    from aegis_cli.data.lerobot.summary import FeatureInfo
    from aegis_cli.evaluation.results import PlayedResult, Result

BINS = 64  # bins of a run's steps in `over_time`
ENERGIES = (0.9, 0.99, 0.999)  # shares of the energy in `SiteSpectrum.kept`


@dataclass(frozen=True)
class TensorInfo:
    name: str
    shape: tuple[int, ...]
    dtype: str
    unit: str


@dataclass(frozen=True)
class LayerEnergy:
    """One parameter group over all steps.

    Attributes:
        energy_shed, energy_shed_max: mean and largest share of the gradient's energy that was shed.
        conflict: share of the steps in conflict.
    """

    name: str
    energy_shed: float
    energy_shed_max: float
    conflict: float


@dataclass(frozen=True)
class LayerMoments:
    """One layer of an anchor, in activation units.

    Attributes:
        mean_norm: |mean|.
        variance_trace: trace of the (diagonal) covariance.
    """

    name: str
    mean_norm: float
    variance_trace: float


@dataclass(frozen=True)
class SiteSpectrum:
    """The spectrum of a map's inputs on questions, or of the curvature of their answers at the map.

    Attributes:
        size: number of directions of its inputs or outputs; for a table, of rows.
        kept: how many of them hold each share in `ENERGIES` of the energy; for a table, the number
            of rows that are read.
        stored: eigenvectors in the file; None for a table, whose directions are its rows.
        same_as: the map that reads the same tensor and with which the spectrum is stored; None if
            it is this map's own.
    """

    name: str
    kind: str
    size: int
    kept: tuple[int, ...]
    stored: int | None
    same_as: str | None = None


@dataclass(frozen=True)
class Bin:
    """The steps from `first_step` to `last_step`, and the energy shed in them.

    Attributes:
        energy_shed: share of the energy of all groups together, as a mean over the steps.
        layers: mean per group.
    """

    first_step: int
    last_step: int
    energy_shed: float
    layers: tuple[float, ...]


@dataclass(frozen=True)
class CheckpointFigures:
    """What a run measured of one of its checkpoints while it trained.

    Attributes:
        name: the checkpoint's folder within `checkpoints`.
        validation_loss: None if it was not measured at this step.
        drop_points: by question set, the points of VQA accuracy lost; empty if none was asked.
        success, mean_return: in validation episodes; None if none were played.
        relative_error: of actions predicted at held-out frames; None if none were predicted.
        best: whether this is the checkpoint that `train.keep_checkpoints` keeps as the best.
    """

    name: str
    validation_loss: float | None
    drop_points: Mapping[str, float]
    success: float | None
    mean_return: float | None
    relative_error: float | None
    best: bool


class UnknownFolder(AegisError):
    """A folder that is of no known kind, whatever it contains."""


@dataclass(frozen=True)
class InspectReport:
    """The report on a path; fields that do not apply to its kind are empty or None.

    Attributes:
        kind: what the path is.
        facts: facts that are shown in one line each.
        frozen: the layers without trained parameters, which have no energies.
        energy_shed_mean: None, with `layers`, `frozen` and `over_time` empty, if no anchor gradient
            was taken.
        by_checkpoint: of a run that was not merged, what was measured of each checkpoint while it
            trained; empty if fewer than two were measured.
        probes, rollouts, open_loops: what was measured of a run's last checkpoint.
        question_sets: the question set of each probe, as the user named it.
        gate: whether the drop is within the run's `probe.max_drop` or `--max-drop`.
    """

    kind: str
    path: str
    facts: dict[str, Any]
    tensors: tuple[TensorInfo, ...] = ()
    moments: tuple[LayerMoments, ...] = ()
    inputs: tuple[SiteSpectrum, ...] = ()
    curvature: tuple[SiteSpectrum, ...] = ()
    features: tuple[FeatureInfo, ...] = ()
    layers: tuple[LayerEnergy, ...] = ()
    frozen: tuple[str, ...] = ()
    over_time: tuple[Bin, ...] = ()
    energy_shed_mean: float | None = None
    loss: float | None = None
    validation_loss: float | None = None
    by_checkpoint: tuple[CheckpointFigures, ...] = ()
    probes: tuple[Result, ...] = ()
    rollouts: tuple[PlayedResult, ...] = ()
    open_loops: tuple[Result, ...] = ()
    question_sets: tuple[str, ...] = ()
    gate: bool | None = None

    @property
    def method(self) -> str:
        """A run's method, and whether its result was merged afterwards."""
        return f"{self.facts['method']}, merged" if "merge" in self.facts else self.facts["method"]

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


def steps_taken(steps: int | None, planned: int | None) -> str:
    """In words, how many steps a run has taken, and of how many if some are left."""
    if steps is None:
        return "-"
    left = planned is not None and steps < planned
    return f"{steps:,} of {planned:,}" if left else f"{steps:,}"


@dataclass(frozen=True)
class UnfinishedStream:
    """A stream of robot tasks that is still being learned, or was interrupted.

    Attributes:
        tasks: all tasks of the stream, the first `learned` of which are learned.
        step: steps taken of the next task, as of the last checkpoint, out of `steps`.
        matrix: what was measured after the tasks so far; None before the first has ended.
    """

    kind: str
    path: str
    method: str
    tasks: tuple[str, ...]
    learned: int
    step: int
    steps: int
    matrix: RobotMatrix | None

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


@dataclass(frozen=True)
class StreamInspection:
    """The finished run of a stream, and its path."""

    kind: str
    path: str
    report: StreamReport

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)
