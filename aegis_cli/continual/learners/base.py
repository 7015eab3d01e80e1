"""The parts of a stream's learner: what a task adds, what learns, what is frozen afterwards."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from aegis_cli.core.identification import Flow
from aegis_cli.core.routing import Routed, RoutedLinear, Router, Traced

Traces = Mapping[str, Sequence[Traced]]
Flows = Mapping[str, Flow]  # per map; columns as in its router of the task


@dataclass(frozen=True)
class TaskContext:
    """A task that is about to be learned, or is being learned.

    Attributes:
        task: its number, from 0.
        tasks: how many the stream has.
        model: the dual encoder, or the policy of a robot.
        sites: its maps with their experts and routers; empty for a learner without experts.
        options: the learner's own part of the recipe.
        prototypes: mean feature of each task's training images in the bare model, this task's last
            [task + 1, D]; empty for a learner that does not compare them.
        generator: draws the weights of new experts; depends only on the seed and the task.
    """

    task: int
    tasks: int
    model: nn.Module
    sites: Routed
    options: Mapping[str, Any]
    prototypes: Tensor
    generator: torch.Generator


@dataclass(frozen=True)
class Identification:
    """A first phase, in which the routers decide what the task needs.

    Its options are `identify` (the largest share of a task's steps that it may take), `check_every`
    (steps), `tolerance` and `checks`: it ends as soon as the routers' mean weights have moved by
    less than `tolerance` (total variation, mean over maps) in `checks` consecutive checks.

    Attributes:
        penalty: the term added to the task's loss in a pass that is the given share of a step. It
            also charges the traces, which adds to the gradient in the backward pass.
        settle: fixes the structure for the remaining steps, given the flows.
    """

    penalty: Callable[[TaskContext, Traces, float], Tensor]
    settle: Callable[[TaskContext, Flows], None]


@dataclass(frozen=True)
class Constraint:
    """Keeps a task's last phase in a subspace; both functions are called at every step.

    Attributes:
        gradient: changes `.grad` before the optimizer reads it.
        update: corrects the update that the optimizer has just made.
    """

    gradient: Callable[[], None]
    update: Callable[[], None]


@dataclass(frozen=True)
class Learner:
    """One way to learn a stream.

    Attributes:
        name: as users write it; its options are the recipe's key of that name, with '_' for '-'.
        summary: one line for tables and help.
        trains: `nothing`, the whole `model`, or `experts` beside frozen maps.
        shared: one state serves all tasks, including future ones; otherwise each task has its own
            router, and a task that has not come yet gets the bare model.
        frozen: the weights that serve a learned task never change again.
        compares: it needs the tasks' prototypes.
        begin: adds what the task needs and makes its parameters trainable; everything is frozen
            before the call.
        router: maps the number of a task to the number of the router that serves it.
        identification: the first of two phases; None for a learner with one phase.
        constrain: called at the beginning of the last phase.
        finish: called with the flows after the last step, before everything is frozen.
    """

    name: str
    summary: str
    trains: str = "experts"
    shared: bool = False
    frozen: bool = False
    compares: bool = False
    begin: Callable[[TaskContext], None] = lambda context: None
    router: Callable[[int], int] = lambda task: task
    identification: Identification | None = None
    constrain: Callable[[TaskContext], Constraint | None] = lambda context: None
    finish: Callable[[TaskContext, Flows], None] = lambda context, flows: None


def route_task(
    site: RoutedLinear,
    task: int,
    used: Sequence[int],
    context: TaskContext,
    top: int | None = None,
    constant: bool = False,
) -> Router:
    """Give `task` a router over the experts `used`, and return it.

    The router learns, and so does each of these experts that is not frozen.
    """
    router = site.add_router(task, used, context.generator, top, constant)
    router.requires_grad_(True)
    for expert in site.of(used):
        expert.requires_grad_(not expert.frozen)
    return router


def keep_experts(context: TaskContext, _: Flows) -> None:
    """Freeze all experts."""
    for site in context.sites.values():
        for expert in site.of(site.numbers):
            expert.frozen = True
