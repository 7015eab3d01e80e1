"""`aegis compare`: several runs in one table."""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aegis_cli import inspection, recipes
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Warned, ignore
from aegis_cli.evaluation import results
from aegis_cli.inspection import InspectReport
from aegis_cli.studies import table
from aegis_cli.studies.pipeline import PipelineReport
from aegis_cli.training import folder

Interval = tuple[float, float] | None


@dataclass(frozen=True)
class ComparedRun:
    """One run's figures; None for what was not measured of it.

    Shares are in [0, 1], the drop in percentage points, times in seconds, W2^2 a mean over layers.
    The figures of VQA are those of one probe, on the question set `vqa`.
    """

    run: str
    method: str
    task: str | None
    steps: int | None
    vqa: str | None
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

    @property
    def question_sets(self) -> list[str]:
        """Those that the figures of VQA are of."""
        return list(dict.fromkeys(row.vqa for row in self.rows if row.vqa is not None))

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


def run(paths: Sequence[Path], on_event: OnEvent = ignore) -> Comparison:
    """Read what was measured of each run.

    Of several question sets, the first that every run was probed on is compared. Where there is
    none, each run's own first is shown, and a warning says so.

    Raises:
        AegisError: a path that is no run of a policy, and no job of such.
    """
    found = [(path, _inspected(path)) for given in paths for path in _runs(Path(given))]
    probed = [_by_set(path, one) for path, one in found]
    asked = [own for own in probed if own]
    shared = [name for name in next(iter(asked), {}) if all(name in own for own in asked)]
    rows = []
    for (path, one), own in zip(found, probed, strict=True):
        name = shared[0] if shared else next(iter(own), None)
        rows.append(_compared(path, one, name if own else None, own))
    made = Comparison(rows)
    if len(made.question_sets) > 1:
        text = f"VQA is of different questions: {', '.join(made.question_sets)}"
        on_event(Warned("compare", f"{text}; aegis probe --vqa measures each run on one set"))
    return made


def _inspected(path: Path) -> InspectReport:
    found = inspection.run(path)
    assert isinstance(found, InspectReport)  # a stream's run is refused before
    return found


def _by_set(path: Path, found: InspectReport) -> dict[str, results.Result]:
    """The run's probes by their question sets, the first of each."""
    recipe, probed = results.recipe_of(path), dict[str, results.Result]()
    for result in found.probes:
        probed.setdefault(results.question_set(result, recipe), result)
    return probed


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


def _compared(
    path: Path, found: InspectReport, vqa: str | None, by_set: Mapping[str, results.Result]
) -> ComparedRun:
    """A run's row.

    Args:
        vqa: the question set to show; None where the run was probed on none.
    """
    probed = {} if vqa is None else by_set[vqa].figures
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
        vqa=vqa,
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
