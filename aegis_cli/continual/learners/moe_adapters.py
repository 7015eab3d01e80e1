"""In the style of MoE-Adapters (arXiv 2403.11549): a pool of experts, a router a task, and the most
used are frozen.

From their abstract and repository: low-rank experts beside CLIP's frozen maps, one linear router a
task with a softmax over its top two, a static pool (22 experts for 11 tasks), experts frozen once a
task has used them most. Ours: the sites, which are those of all learners here; a router that reads
the mean of the sequence instead of its first token, and in the
text tower nothing: under CLIP's causal mask the first token is the same in every text, so that
theirs is a constant choice there; and the way a task is told at test time, the same for all
learners (theirs are autoencoders). No figure of theirs is claimed.
"""

from __future__ import annotations

from aegis_cli.continual.learners.base import Flows, Learner, TaskContext, learn


def begin(context: TaskContext) -> None:
    """The whole pool comes with the first task; an expert belongs to none until one freezes it."""
    rank, pool = context.options["rank"], context.options["experts_per_task"] * context.tasks
    for name, site in context.sites.items():
        if context.task == 0:
            for _ in range(pool):
                site.add_expert(rank, context.tasks, context.generator)
        constant = context.model.in_text(name)
        learn(
            site, context.task, site.numbers, context, top=context.options["top"], constant=constant
        )


def finish(context: TaskContext, flows: Flows) -> None:
    """Freeze the `top` experts that the task has used most; the others go on learning with the next
    task.
    """
    for name, site in context.sites.items():
        most = (
            flows[name]
            .mass.topk(min(context.options["top"], len(flows[name].mass)))
            .indices.tolist()
        )
        for expert in site.of([site.numbers[i] for i in most]):
            if not expert.frozen:
                expert.owner, expert.frozen = context.task, True


LEARNER = Learner(
    "moe-adapters",
    "a pool of experts, two an example, the most used frozen",
    begin=begin,
    finish=finish,
)
