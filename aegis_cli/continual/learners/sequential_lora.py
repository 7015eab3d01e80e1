"""One LoRA (arXiv 2106.09685) for all tasks, which goes on learning with each."""

from __future__ import annotations

from aegis_cli.continual.learners.base import Learner, TaskContext, route_task

_ONLY = 0  # number of the router that serves every task


def begin(context: TaskContext) -> None:
    """Add the only expert and router with the first task; both learn in every task."""
    for site in context.sites.values():
        if context.task == 0:
            own = site.add_expert(context.options["rank"], _ONLY, context.generator)
            route_task(site, _ONLY, [own], context)
        # After each task everything is frozen, including the only expert.
        site.experts.requires_grad_(True)
        site.routers.requires_grad_(True)


LEARNER = Learner(
    "sequential-lora",
    "one low-rank term, task after task",
    shared=True,
    begin=begin,
    router=lambda task: _ONLY,
)
