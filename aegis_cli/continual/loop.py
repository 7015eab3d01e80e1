"""One task of a stream: the loop over its steps, the end of its first phase and of the task."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from aegis_cli.common import devices, interrupts
from aegis_cli.common.errors import check_finite
from aegis_cli.common.events import OnEvent, Progress
from aegis_cli.continual import state
from aegis_cli.continual.learners.base import Constraint, Flows, TaskContext
from aegis_cli.continual.report import SiteRouting, TaskRecord, history_mass, record_from, untouched
from aegis_cli.continual.state import AnyStreamRun, Objective
from aegis_cli.core.identification import Flow, flow, total_variation, where_read
from aegis_cli.core.routing import Traced, activate, traced
from aegis_cli.data.batch import Share
from aegis_cli.training import folder
from aegis_cli.training.schedule import BatchOrder, warmup_then_decay

# the flow of a map at which the task has no router, since no loss reads the map
NOTHING = Flow(torch.empty(0), torch.empty(0))


@dataclass
class TaskTraining:
    """A task while it is being learned.

    Attributes:
        context: the task as the learner sees it.
        objective: its examples and its loss.
        order: which examples each step trains on.
        optimizer: optimizer of the trainable parameters; None if there are none.
        slower: advice for the user if training diverges.
        constraint: keeps the last phase in a subspace, if set.
    """

    context: TaskContext
    objective: Objective
    order: BatchOrder
    optimizer: torch.optim.Optimizer | None
    slower: str
    constraint: Constraint | None = None

    def fetch(self, step: int) -> Any:
        """The examples of a step."""
        return self.objective.fetch(torch.from_numpy(self.order.rows(step)), step)

    def batches(self, steps: Sequence[int]) -> AbstractContextManager[Iterator[Any]]:
        """The examples of each of these steps, fetched ahead."""
        return self.objective.ahead(self.fetch, steps)


def learn(
    run: AnyStreamRun,
    prototypes: Sequence[Tensor],
    optimizer: torch.optim.Optimizer | None,
    on_event: OnEvent,
) -> TaskRecord:
    """Train the task `run.current` from its current step on, then freeze everything.

    Args:
        prototypes: mean feature of each task so far in the bare encoder, this task's last.
        optimizer: the optimizer if the task has already begun.

    Raises:
        Diverged: a loss or gradient is not finite; the state on disk is the last good checkpoint.
        KeyboardInterrupt: a signal arrived, and the steps up to it are saved.
    """
    current, settings = run.current, run.recipe.train
    training = prepare(run, prototypes, optimizer)
    loss: float | None = None
    started, waited_s = time.perf_counter(), 0.0

    steps = settings.steps if run.learner.trains != "nothing" else 0
    ahead = training.batches(range(current.step, steps))
    stage = f"task {current.task + 1} {training.objective.name}"
    with ahead as batches, interrupts.saved_first(stage, on_event) as signaled:
        if current.step < steps:
            on_event(Progress(stage, current.step, steps, "steps"))
        for step in range(current.step, steps):
            asked = time.perf_counter()
            batch = next(batches)
            waited_s += time.perf_counter() - asked
            loss = take(run, training, step, batch)
            current.window.append(loss)
            current.step = step + 1
            if current.phase == 1:
                _watch(run, training)
            if current.step % settings.log_every == 0 or current.step == steps:
                _log(run, time.perf_counter() - started, waited_s)
                started, waited_s = time.perf_counter(), 0.0
            # After the last step the state is saved only once the task has been evaluated, so a
            # run resumes either before a task's end or after it, never in between.
            if current.step % settings.checkpoint_every == 0 and current.step < steps:
                state.save(run, training.optimizer)
            on_event(Progress(stage, current.step, steps, "steps", {"loss": loss}))
            if signaled.number is not None and current.step < steps:
                state.save(run, training.optimizer)
                signaled.leave()
    return _finish(run, training, loss)


# --- before ---------------------------------------------------------------------------------------


def prepare(
    run: AnyStreamRun, prototypes: Sequence[Tensor], optimizer: torch.optim.Optimizer | None
) -> TaskTraining:
    """Let the learner begin the task, unless it did so before the run was interrupted."""
    current, objective = run.current, run.objective(run.current.task)
    # Random draws depend only on seed and task, so a resumed run repeats them.
    generator = torch.Generator().manual_seed(run.recipe.seed * 1_000_003 + current.task)
    means = torch.stack(list(prototypes)) if prototypes else torch.empty(0)
    sites = run.growing(current.task)
    context = TaskContext(
        current.task, len(run.names), run.model, sites, run.options, means, generator
    )
    # In a resumed task, the state has restored what `begin` created.
    if current.step == 0:
        run.learner.begin(context)
        run.task_begun()
        if run.learner.identification is not None:
            current.phase, current.trained_phase1 = 1, _learning_maps(run)
            current.learning_phase1 = sum(p.numel() for p in run.learning().values())
    order_seed = run.recipe.seed * 1009 + current.task
    order = BatchOrder(objective.size, run.recipe.train.batch_size, order_seed)
    if optimizer is None and run.learner.trains != "nothing":
        optimizer = state.optimizer(run)
    run.model.train()
    training = TaskTraining(context, objective, order, optimizer, run.slower(run.learning()))
    if current.phase == 2:
        training.constraint = run.learner.constrain(context)
    return training


def _learning_maps(run: AnyStreamRun) -> dict[str, int]:
    """How many parameters learn beside each map."""
    counts = {}
    for name, site in run.sites.items():
        beside = (*site.experts.parameters(), *site.routers.parameters())
        counts[name] = sum(p.numel() for p in beside if p.requires_grad)
    return counts


# --- a step ---------------------------------------------------------------------------------------


def take(run: AnyStreamRun, training: TaskTraining, step: int, batch: Any) -> float:
    """Take one step, and return the task's own loss before it.

    Raises:
        Diverged: the loss or the gradient is not finite; no parameter has changed then.
    """
    settings, current, optimizer = run.recipe.train, run.current, training.optimizer
    assert optimizer is not None
    plan = settings.steps, settings.warmup, settings.final_lr_share, settings.schedule
    factor = warmup_then_decay(step, *plan)
    for group in optimizer.param_groups:
        group["lr"] = group["peak"] * factor
    optimizer.zero_grad()
    # A measurement may have left another task's routers active.
    activate(run.sites, run.learner.router(current.task))
    identification = run.learner.identification if current.phase == 1 else None
    losses, passes = [], training.objective.passes
    for share in (Share(number, passes) for number in range(passes)):
        with devices.autocast(run.device, settings.precision):
            if identification is None:
                loss = total = training.objective.loss(batch, step, share)
            else:
                with traced(run.sites) as traces:
                    loss = training.objective.loss(batch, step, share)
                # Each pass pays the penalty of its own positions, weighted by its share of frames.
                rows = share.rows(settings.batch_size)
                paid = (rows.stop - rows.start) / settings.batch_size
                total = loss + identification.penalty(training.context, traces, paid)
        # Outside autocast, as PyTorch advises: backward uses the dtypes of forward anyway.
        total.backward()
        losses.append(loss.detach())
    loss = torch.stack(losses).sum()
    learning = []
    for group in optimizer.param_groups:
        learning += group["params"]
    norm = nn.utils.clip_grad_norm_(learning, settings.clip_norm)
    figures = {"loss": loss.item(), "gradient norm": norm.item()}
    where = f"at step {step + 1} of task '{training.objective.name}'"
    check_finite(figures, where, training.slower, step)
    # After clipping, because a projection never makes a gradient longer.
    if training.constraint is not None:
        training.constraint.gradient()
    optimizer.step()
    if training.constraint is not None:
        training.constraint.update()
    return figures["loss"]


def _log(run: AnyStreamRun, seconds: float, waited_s: float) -> None:
    """Write a line of metrics for the steps since the last line.

    Args:
        waited_s: how much of the seconds they waited for their batches.
    """
    current = run.current
    line = {
        "task": current.task,
        "step": current.step,
        "phase": current.phase,
        "loss": sum(current.window) / len(current.window),
        "seconds": seconds,
        "data_s": waited_s,
    }
    folder.append_metrics(run.out, line)
    current.window = []


# --- the end of phase 1 ---------------------------------------------------------------------------


def _watch(run: AnyStreamRun, training: TaskTraining) -> None:
    """End phase 1 once the routers have converged, or its share of the steps is used up."""
    current, options = run.current, run.options
    limit = max(1, round(options["identify"] * run.recipe.train.steps))
    check = current.step % options["check_every"] == 0
    # Measuring takes a pass over the calibration examples, so it is done only when needed.
    if not check and current.step < limit:
        return
    flows = measure(run, training)
    masses = {name: found.mass.tolist() for name, found in flows.items()}
    if check:
        still = _moved(current.masses, masses) < options["tolerance"]
        current.quiet = current.quiet + 1 if still else 0  # counts consecutive checks
        current.masses = masses
    if current.quiet >= options["checks"] or current.step >= limit:
        _settle(run, training, flows)


def _moved(before: dict[str, list[float]], after: dict[str, list[float]]) -> float:
    """Mean over maps of the total variation since the last check; infinite at the first check."""
    if not before:
        return math.inf
    distances = []
    for name, masses in after.items():
        distances.append(total_variation(torch.tensor(before[name]), torch.tensor(masses)))
    return sum(distances) / len(distances)


def _settle(run: AnyStreamRun, training: TaskTraining, flows: Flows) -> None:
    """Fix the structure and record which experts were removed.

    Parameters that go on learning keep their moments in the optimizer, as in a learner with one
    phase.
    """
    current = run.current
    before = {name: _used(run, name) for name in run.sites}
    identification = run.learner.identification
    assert identification is not None
    identification.settle(training.context, flows)
    for name, site in run.sites.items():
        gone = [n for n in before[name] if n not in _used(run, name)]
        # Experts that an earlier task's router uses still exist; the others are deleted for good.
        current.dropped[name] = [n for n in gone if n in site.numbers]
        current.pruned[name] = [n for n in gone if n not in site.numbers]
    current.phase, current.phase1_steps = 2, current.step
    current.quiet, current.masses = 0, {}
    training.objective.trainable_changed()
    # A new optimizer, because experts are gone and routers may be frozen.
    training.optimizer = state.optimizer(run, before=training.optimizer)
    training.constraint = run.learner.constrain(training.context)


def _used(run: AnyStreamRun, site: str) -> tuple[int, ...]:
    """Numbers of the experts that the task's router of a map uses."""
    router = run.sites[site].router(run.learner.router(run.current.task))
    return () if router is None else router.experts


def measure(run: AnyStreamRun, training: TaskTraining) -> Flows:
    """The flow in each map that has a router of the task, on its calibration examples."""
    task = run.learner.router(run.current.task)
    activate(run.sites, task)
    run.model.eval()
    used = {}
    for name, site in run.sites.items():
        router = site.router(task)
        if router is not None:
            used[name] = site.of(router.experts)
    passes: dict[str, list[Traced]] = {name: [] for name in used}
    count = training.objective.calibration_passes
    for share in (Share(number, count) for number in range(count)):
        # Keeps the graph: `where_read` backpropagates from the loss to find the positions it reads.
        with devices.autocast(run.device, run.recipe.train.precision), traced(run.sites) as traces:
            loss = training.objective.calibration_loss(share)
        for name, found in where_read({name: traces[name] for name in used}, loss).items():
            passes[name] += map(_without_graph, found)
    run.model.train()
    return {name: flow(passed, used[name]) for name, passed in passes.items()}


def _without_graph(passed: Traced) -> Traced:
    """The parts of a pass that `flow` reads, without the graph and the outputs, to save memory."""
    return Traced(passed.weights.detach(), passed.codes.detach(), passed.outputs.detach()[:0])


# --- after ----------------------------------------------------------------------------------------


def _finish(run: AnyStreamRun, training: TaskTraining, loss: float | None) -> TaskRecord:
    """Let the learner end the task, freeze everything, and return the task's record."""
    current, steps = run.current, run.recipe.train.steps
    flows = measure(run, training) if run.sites else {}
    # Counted before the learner freezes anything.
    trained = sum(p.numel() for p in run.learning().values())
    maps = _learning_maps(run)
    run.learner.finish(training.context, flows)
    run.model.requires_grad_(False)
    sites = tuple(
        _routing(run, name, flows.get(name, NOTHING), maps[name]) for name in training.context.sites
    )
    first, trained_first = current.phase1_steps or 0, current.learning_phase1
    trained_steps = (trained_first or 0) * first + trained * (steps - first)
    masses = history_mass(sites, [record_from(raw) for raw in current.records])
    return TaskRecord(
        task=training.objective.name,
        phase1_steps=current.phase1_steps,
        trained_phase1=trained_first,
        trained=trained,
        trained_mean=trained_steps / steps,
        # All numbers stored now, minus those that earlier tasks have added.
        added=run.stored() - sum(r["added"] for r in current.records),
        history_mass=sum(masses) / len(masses) if masses else None,
        untouched=untouched(sites, current.task),
        loss=loss,
        sites=sites,
    )


def _routing(run: AnyStreamRun, name: str, found: Flow, trained: int) -> SiteRouting:
    """The routing of one map at the task's end; `trained` of its parameters have learned."""
    site, used, current = run.sites[name], _used(run, name), run.current
    before = 0  # numbers that earlier tasks have added here
    for record in current.records:
        before += sum(s["added"] for s in record["sites"] if s["site"] == name)
    return SiteRouting(
        site=name,
        experts=used,
        owners=tuple(e.owner for e in site.of(used)),
        mass=tuple(found.mass.tolist()),
        load=tuple(found.load.tolist()),
        pruned=tuple(current.pruned.get(name, ())),
        dropped=tuple(current.dropped.get(name, ())),
        trained_phase1=(current.trained_phase1 or {}).get(name),
        trained=trained,
        added=site.count() - before,
    )
