"""What is said of a stream: a task's routing and parameters, the accuracy matrix and
its figures.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from aegis_cli.core.accuracy_matrix import StreamScores, reuse_rate, scores
from aegis_cli.data.streams import mtil
from aegis_cli.recipes import TEST


@dataclass(frozen=True)
class SiteRouting:
    """What one map's router does for one task, at the task's end.

    Attributes:
        experts: numbers of those it uses, none where no loss reads the map; `owners`: the tasks
            that brought them.
        mass: mean weight of each over the positions that the loss reads; load: its share of the
            summed p ||B A x||.
        pruned: new experts that went after phase 1; dropped: old ones that the router forgot then.
        trained_phase1, trained: parameters here that learned in phase 1 (None without one) and in
            the last phase.
        added: numbers stored here since the task before.
    """

    site: str
    experts: tuple[int, ...]
    owners: tuple[int, ...]
    mass: tuple[float, ...]
    load: tuple[float, ...]
    pruned: tuple[int, ...]
    dropped: tuple[int, ...]
    trained_phase1: int | None
    trained: int
    added: int


@dataclass(frozen=True)
class TaskRecord:
    """One task, learned.

    Attributes:
        phase1_steps: None for a learner with one phase.
        trained_phase1, trained: parameters that learned in phase 1, and in the last (or only)
            phase.
        trained_mean: parameters that learned, mean over all steps of the task.
        added: numbers stored since the task before, those that tell the task included.
        history_mass: routing mass on experts of earlier tasks, mean over maps that have some; None
            where none has.
        untouched: share of maps that the task added no expert to; None without experts.
        loss: of the last step; None where nothing learns.
    """

    task: str
    phase1_steps: int | None
    trained_phase1: int | None
    trained: int
    trained_mean: float
    added: int
    history_mass: float | None
    untouched: float | None
    loss: float | None
    sites: tuple[SiteRouting, ...]


@dataclass(frozen=True)
class StreamReport:
    """A stream, learned.

    Attributes:
        split: the tasks' parts that accuracies are of: `test`, or `validation` where settings are
            chosen.
        oracle, inferred: R [T, T], accuracy on that part of task i after learning task t, told the
            task or inferring it from the image; for a learner with one state for all tasks they are
            the same. Of a task i > t that has not come, `oracle` is what the bare encoder reaches,
            or the current weights of a learner with one state.
        scores, inferred_scores: Transfer, Average, Last and forgetting of the two.
        parameters: numbers stored beside the bare encoder at the end, of which
            `inference_parameters` tell the task. trained_phase1, trained, trained_mean: means over
            tasks of the records' figures.
        reuse: mean over tasks after the first, and maps that earlier tasks gave experts, of the
            routing mass on these.
        inputs: digests of the recipe, the bare encoder, the image set, and the encoder that was
            trained, if it was.
        minutes: of training and evaluation; not part of the run's files, which are the same in
            every repetition.
    """

    name: str
    stream: str
    split: str
    method: str
    tasks: tuple[str, ...]
    oracle: tuple[tuple[float, ...], ...]
    inferred: tuple[tuple[float, ...], ...]
    scores: StreamScores
    inferred_scores: StreamScores
    parameters: int
    inference_parameters: int
    trained_phase1: float | None
    trained: float
    trained_mean: float
    reuse: float | None
    records: tuple[TaskRecord, ...]
    inputs: Mapping[str, str]
    out: str
    minutes: float

    @property
    def published(self) -> Mapping[str, tuple[float, float, float]]:
        """Of a stream that papers used, learned whole and in its order: by method, Transfer,
        Average and Last in percent.
        """
        whole = self.split == TEST and self.tasks == mtil.STREAMS.get(self.stream)
        return mtil.PUBLISHED.get(self.stream, {}) if whole else {}

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self) | {"published": self.published}


def history_mass(sites: Sequence[SiteRouting], before: Sequence[TaskRecord]) -> list[float]:
    """Of each map that got experts with an earlier task, and now has some, the mass on the earlier
    tasks' experts.
    """
    grown, task = {s.site for record in before for s in record.sites if s.experts}, len(before)
    return [
        sum(m for m, owner in zip(s.mass, s.owners, strict=True) if owner < task)
        for s in sites
        if s.experts and s.site in grown
    ]


def untouched(sites: Sequence[SiteRouting], task: int) -> float | None:
    """Share of maps to which the task added no expert."""
    return sum(task not in s.owners for s in sites) / len(sites) if sites else None


def assemble(
    name: str,
    stream: str,
    split: str,
    method: str,
    out: str,
    minutes: float,
    records: Sequence[TaskRecord],
    oracle: Sequence[Sequence[float]],
    inferred: Sequence[Sequence[float]],
    inference_parameters: int,
    inputs: Mapping[str, str],
) -> StreamReport:
    """The report of all tasks' records and rows."""
    return StreamReport(
        name=name,
        stream=stream,
        split=split,
        method=method,
        tasks=tuple(r.task for r in records),
        oracle=_rows(oracle),
        inferred=_rows(inferred),
        scores=scores(oracle),
        inferred_scores=scores(inferred),
        inference_parameters=inference_parameters,
        records=tuple(records),
        inputs=inputs,
        out=out,
        minutes=minutes,
        **sums(records),
    )


def sums(records: Sequence[TaskRecord]) -> dict[str, Any]:
    """What all records together say of parameters and reuse, by a report's names."""
    first = [r.trained_phase1 for r in records if r.trained_phase1 is not None]
    return {
        "parameters": sum(r.added for r in records),
        "trained_phase1": sum(first) / len(first) if first else None,
        "trained": sum(r.trained for r in records) / len(records),
        "trained_mean": sum(r.trained_mean for r in records) / len(records),
        "reuse": reuse_rate(
            [history_mass(r.sites, records[:task]) for task, r in enumerate(records)]
        ),
    }


def record_from(raw: Mapping[str, Any]) -> TaskRecord:
    """A record from its JSON."""
    sites = tuple(
        SiteRouting(**{k: tuple(v) if isinstance(v, list) else v for k, v in s.items()})
        for s in raw["sites"]
    )
    return TaskRecord(**{**raw, "sites": sites})


def _rows(rows: Sequence[Sequence[float]]) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in rows)
