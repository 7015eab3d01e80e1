"""A LoRA (arXiv 2106.09685) for each task, which shares nothing with the others; its scale learns,
as in all learners here.
"""

from __future__ import annotations

from aegis_cli.continual.learners.base import Learner, TaskContext, keep_experts, learn


def begin(context: TaskContext) -> None:
    for site in context.sites.values():
        own = site.add_expert(context.options["rank"], context.task, context.generator)
        learn(site, context.task, [own], context)


LEARNER = Learner(
    "isolated-lora", "a low-rank term a task", frozen=True, begin=begin, finish=keep_experts
)
