"""A LoRA (arXiv 2106.09685) per task, which shares nothing with the others.

Its scale learns, as in all learners here.
"""

from __future__ import annotations

from aegis_cli.continual.learners.base import Learner, TaskContext, keep_experts, route_task


def begin(context: TaskContext) -> None:
    """Give each map one expert, which only this task uses."""
    for site in context.sites.values():
        own = site.add_expert(context.options["rank"], context.task, context.generator)
        route_task(site, context.task, [own], context)


LEARNER = Learner(
    "isolated-lora", "a low-rank term per task", frozen=True, begin=begin, finish=keep_experts
)
