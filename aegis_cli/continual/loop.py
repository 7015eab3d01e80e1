"""One task of a stream: the loop over its steps, the end of its first phase, and what is frozen
after it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from aegis_cli.common import device as devices
from aegis_cli.common.errors import check_finite
from aegis_cli.common.events import OnEvent, Progress
from aegis_cli.continual import state
from aegis_cli.continual.learners.base import Arrival, Constraint, Flows
from aegis_cli.continual.report import SiteRouting, TaskRecord, history_mass, record_from, untouched
from aegis_cli.continual.state import Base, Material
from aegis_cli.core.identification import Flow, flow, read, total_variation
from aegis_cli.core.routing import activate, traced
from aegis_cli.training import folder, prefetch
from aegis_cli.training.schedule import BatchOrder, warmup_cosine

NOTHING = Flow(
    torch.empty(0), torch.empty(0)
)  # where the task has no router: no loss reads the map


@dataclass
class Lesson:
    """A task while it is being learned.

    Attributes:
        arrival: what the learner is told of it.
        material: what it is learned from.
        order: which examples a step sees.
        slower: what to do if it diverges.
    """

    arrival: Arrival
    material: Material
    order: BatchOrder
    optimizer: torch.optim.Optimizer
    slower: str
    constraint: Constraint | None = None


def learn(
    run: Base,
    prototypes: Sequence[Tensor],
    optimizer: torch.optim.Optimizer | None,
    on_event: OnEvent,
) -> TaskRecord:
    """Train the task at `run.place` from its step on; everything is frozen afterwards.

    Args:
        prototypes: mean feature of each task so far in the bare encoder, this one's last.
        optimizer: of a task that has begun before.

    Raises:
        Diverged: a loss or gradient that is not finite; the state on disk is of the last good
            checkpoint.
    """
    place, settings = run.place, run.recipe.train
    lesson = _prepare(run, prototypes, optimizer)
    loss: float | None = None
    window: list[float] = []
    started = time.perf_counter()

    def fetch(step: int) -> Any:
        return lesson.material.fetch(torch.from_numpy(lesson.order.rows(step)))

    steps = settings.steps if run.learner.trains != "nothing" else 0
    with prefetch.ahead(fetch, range(place.step, steps)) as batches:
        for step in range(place.step, steps):
            loss = _step(run, lesson, step, next(batches))
            window.append(loss)
            place.step = step + 1
            if place.phase == 1:
                _watch(run, lesson)
            if place.step % settings.log_every == 0 or place.step == steps:
                line = {
                    "task": place.task,
                    "step": place.step,
                    "phase": place.phase,
                    "loss": sum(window) / len(window),
                }
                folder.append_metrics(run.out, line | {"seconds": time.perf_counter() - started})
                window, started = [], time.perf_counter()
            # after the last step the state waits for the evaluation, so that a task's end is one
            # place
            if place.step % settings.checkpoint_every == 0 and place.step < steps:
                state.save(run, [lesson.optimizer])
            on_event(
                Progress(
                    f"task {place.task + 1} {lesson.material.name}",
                    place.step,
                    steps,
                    "steps",
                    {"loss": loss},
                )
            )
    return _finish(run, lesson, loss)


# --- before ---------------------------------------------------------------------------------------


def _prepare(
    run: Base, prototypes: Sequence[Tensor], optimizer: torch.optim.Optimizer | None
) -> Lesson:
    """Let the learner begin the task, unless it has done so before the run was interrupted."""
    place, material = run.place, run.material(run.place.task)
    generator = torch.Generator().manual_seed(run.recipe.seed * 1_000_003 + place.task)
    means = torch.stack(list(prototypes)) if prototypes else torch.empty(0)
    sites = run.growing(place.task)
    arrival = Arrival(place.task, len(run.names), run.model, sites, run.options, means, generator)
    if place.step == 0:
        run.learner.begin(arrival)
        run.begun()
        if run.learner.identification is not None:
            place.phase, place.trained_phase1 = 1, _learning_maps(run)
            place.learning_phase1 = sum(p.numel() for p in run.learning().values())
    order = BatchOrder(
        material.size, run.recipe.train.batch_size, run.recipe.seed * 1009 + place.task
    )
    if optimizer is None and run.learner.trains != "nothing":
        optimizer = state.optimizer(run)
    run.model.train()
    lesson = Lesson(arrival, material, order, optimizer, run.slower(run.learning()))
    if place.phase == 2:
        lesson.constraint = run.learner.constrain(arrival)
    return lesson


def _learning_maps(run: Base) -> dict[str, int]:
    """Parameters that learn beside each map's own."""
    return {
        name: sum(
            p.numel()
            for part in (site.experts, site.routers)
            for p in part.parameters()
            if p.requires_grad
        )
        for name, site in run.sites.items()
    }


# --- a step ---------------------------------------------------------------------------------------


def _step(run: Base, lesson: Lesson, step: int, batch: Any) -> float:
    """One step; the task's own loss before it. Nothing moves if anything is not finite."""
    settings, place = run.recipe.train, run.place
    factor = warmup_cosine(step, settings.steps, settings.warmup, settings.final_lr_share)
    for group in lesson.optimizer.param_groups:
        group["lr"] = group["peak"] * factor
    lesson.optimizer.zero_grad()
    activate(run.sites, run.learner.router(place.task))
    identification = run.learner.identification if place.phase == 1 else None
    with devices.autocast(run.device, settings.precision):
        if identification is None:
            loss = total = lesson.material.loss(batch, step)
        else:
            with traced(run.sites) as traces:
                loss = lesson.material.loss(batch, step)
            total = loss + identification.penalty(lesson.arrival, traces)
    total.backward()
    learning = [p for group in lesson.optimizer.param_groups for p in group["params"]]
    norm = nn.utils.clip_grad_norm_(learning, settings.clip_norm)
    figures = {"loss": loss.item(), "gradient norm": norm.item()}
    where = f"at step {step + 1} of task '{lesson.material.name}'"
    check_finite(figures, where, lesson.slower, step)
    if lesson.constraint is not None:
        lesson.constraint.gradient()
    lesson.optimizer.step()
    if lesson.constraint is not None:
        lesson.constraint.update()
    return figures["loss"]


# --- the end of phase 1 ---------------------------------------------------------------------------


def _watch(run: Base, lesson: Lesson) -> None:
    """At a check: have the routers converged? Then, or when phase 1 has had its share of the steps,
    settle.
    """
    place, options = run.place, run.options
    limit = max(1, round(options["identify"] * run.recipe.train.steps))
    check = place.step % options["check_every"] == 0
    if not check and place.step < limit:
        return
    flows = measure(run, lesson)
    masses = {name: found.mass.tolist() for name, found in flows.items()}
    if check:
        place.quiet = place.quiet + 1 if _moved(place.masses, masses) < options["tolerance"] else 0
        place.masses = masses
    if place.quiet >= options["checks"] or place.step >= limit:
        _settle(run, lesson, flows)


def _moved(before: dict[str, list[float]], after: dict[str, list[float]]) -> float:
    """Mean over maps of the total variation since the last check; infinite at the first."""
    if not before:
        return math.inf
    return sum(
        total_variation(torch.tensor(before[n]), torch.tensor(after[n])) for n in after
    ) / len(after)


def _settle(run: Base, lesson: Lesson, flows: Flows) -> None:
    """Fix the structure and note who left; what still learns keeps its moments, as in a learner
    with one phase.
    """
    place = run.place
    before = {name: _used(run, name) for name in run.sites}
    run.learner.identification.settle(lesson.arrival, flows)
    for name, site in run.sites.items():
        gone = [n for n in before[name] if n not in _used(run, name)]
        place.dropped[name] = [n for n in gone if n in site.numbers]
        place.pruned[name] = [n for n in gone if n not in site.numbers]
    place.phase, place.phase1_steps, place.quiet, place.masses = 2, place.step, 0, {}
    lesson.material.changed()
    lesson.optimizer = state.optimizer(run, before=lesson.optimizer)
    lesson.constraint = run.learner.constrain(lesson.arrival)


def _used(run: Base, site: str) -> tuple[int, ...]:
    router = run.sites[site].router(run.learner.router(run.place.task))
    return () if router is None else router.experts


def measure(run: Base, lesson: Lesson) -> Flows:
    """What flows where in each map that the task has a router in, on the inputs that gauge it."""
    task = run.learner.router(run.place.task)
    activate(run.sites, task)
    run.model.eval()
    with devices.autocast(run.device, run.recipe.train.precision), traced(run.sites) as traces:
        loss = lesson.material.gauge()
    run.model.train()
    passes = read(
        {name: traces[name] for name, site in run.sites.items() if site.router(task) is not None},
        loss,
    )
    return {
        name: flow(passes[name], run.sites[name].of(run.sites[name].router(task).experts))
        for name in passes
    }


# --- after ----------------------------------------------------------------------------------------


def _finish(run: Base, lesson: Lesson, loss: float | None) -> TaskRecord:
    """Let the learner end the task, freeze everything, and say what was learned."""
    place, steps = run.place, run.recipe.train.steps
    flows = measure(run, lesson) if run.sites else {}
    trained, maps = sum(p.numel() for p in run.learning().values()), _learning_maps(run)
    run.learner.finish(lesson.arrival, flows)
    run.model.requires_grad_(False)
    sites = tuple(
        _routing(run, name, flows.get(name, NOTHING), maps[name]) for name in lesson.arrival.sites
    )
    first, trained_first = place.phase1_steps or 0, place.learning_phase1
    masses = history_mass(sites, [record_from(raw) for raw in place.records])
    return TaskRecord(
        task=lesson.material.name,
        phase1_steps=place.phase1_steps,
        trained_phase1=trained_first,
        trained=trained,
        trained_mean=((trained_first or 0) * first + trained * (steps - first)) / steps,
        added=run.stored() - sum(r["added"] for r in place.records),
        history_mass=sum(masses) / len(masses) if masses else None,
        untouched=untouched(sites, place.task),
        loss=loss,
        sites=sites,
    )


def _routing(run: Base, name: str, found: Flow, trained: int) -> SiteRouting:
    site, used, place = run.sites[name], _used(run, name), run.place
    before = sum(s["added"] for r in place.records for s in r["sites"] if s["site"] == name)
    return SiteRouting(
        site=name,
        experts=used,
        owners=tuple(e.owner for e in site.of(used)),
        mass=tuple(found.mass.tolist()),
        load=tuple(found.load.tolist()),
        pruned=tuple(place.pruned.get(name, ())),
        dropped=tuple(place.dropped.get(name, ())),
        trained_phase1=(place.trained_phase1 or {}).get(name),
        trained=trained,
        added=site.count() - before,
    )
