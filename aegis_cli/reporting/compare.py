"""`aegis compare`: several runs in one table."""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aegis_cli import inspection, recipes
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, ignore
from aegis_cli.studies import table
from aegis_cli.studies.pipeline import PipelineReport
from aegis_cli.training import folder

Interval = tuple[float, float] | None


@dataclass(frozen=True)
class ComparedRun:
    """One run's figures; None for what was not measured of it.

    Shares are in [0, 1], the drop in percentage points, times in seconds, W2^2 a mean over layers.
    The figures of VQA are those of the run's first probe.
    """

    run: str
    method: str
    task: str | None
    steps: int | None
    accuracy: float | None
    baseline_accuracy: float | None
    drop_points: float | None
    drop_interval: Interval
    cross_entropy: float | None
    success_seen: float | None
    success_seen_interval: Interval
    success_held_out: float | None
    return_share: float | None
    w2: float | None
    energy_shed: float | None
    loss: float | None
    validation_loss: float | None
    step_s: float | None
    gate: bool | None


@dataclass(frozen=True)
class Comparison:
    """The runs, in the order given."""

    rows: list[ComparedRun]

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


def run(paths: Sequence[Path], on_event: OnEvent = ignore) -> Comparison:
    """Read what was measured of each run; `on_event` (there as in every stage) is never called.

    Raises:
        AegisError: a path that is no run of a policy, and no job of such.
    """
    return Comparison([_compared(path) for given in paths for path in _runs(Path(given))])


def _runs(path: Path) -> Iterator[Path]:
    """The path of a run, or those of all runs of a job."""
    if (path / table.NAME).is_file():
        found = table.load(path)
        if isinstance(found, PipelineReport):
            yield from (path / row.method for row in found.rows)
            return
    if not (path / "recipe.yaml").is_file() or recipes.is_stream_run(path):
        raise AegisError(
            f"'{path}' is no run of a policy",
            "folders that aegis train wrote, or one that aegis run made of a recipe",
            "aegis inspect shows studies and streams",
        )
    yield path


def _compared(path: Path) -> ComparedRun:
    found = inspection.run(path)
    probed = found.probes[0].figures if found.probes else {}
    played = {result.figures.get("colors"): result.figures for result in reversed(found.rollouts)}
    seen, held_out = played.get("seen", {}), played.get("held-out", {})
    # A task without colours has one rollout, by its return or its success.
    only = played.get(None, {})
    lines = folder.read_metrics(path)
    times = [line["step_s"] for line in lines if "step_s" in line]
    layers = [layer["w2"] for layer in probed.get("layers", [])]
    return ComparedRun(
        run=str(path),
        method=str(found.facts["method"]),
        task=found.facts.get("task"),
        steps=found.facts.get("steps"),
        accuracy=probed.get("accuracy"),
        baseline_accuracy=probed.get("baseline_accuracy"),
        drop_points=probed.get("drop_points"),
        drop_interval=probed.get("drop_interval"),
        cross_entropy=probed.get("cross_entropy"),
        success_seen=(seen or only).get("success"),
        success_seen_interval=(seen or only).get("interval"),
        success_held_out=held_out.get("success"),
        return_share=only.get("return_share"),
        w2=statistics.fmean(layers) if layers else None,
        energy_shed=found.energy_shed_mean,
        loss=found.loss,
        validation_loss=found.validation_loss,
        step_s=statistics.median_high(times) if times else None,
        gate=found.gate,
    )
