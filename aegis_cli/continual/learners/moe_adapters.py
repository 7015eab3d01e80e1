"""In the style of MoE-Adapters (arXiv 2403.11549): a pool of experts, and a router per task.

These are from their abstract and repository: low-rank experts beside CLIP's frozen maps, one linear
router per task with a softmax over its top two, a static pool (22 experts for 11 tasks), and
experts frozen once a task has used them most.

These are ours: the sites, which are those of all learners here; a router that reads the mean of the
sequence instead of its first token, and in the text tower nothing (under CLIP's causal mask the
first token is the same in every text, so that theirs is a constant choice there); and the way a
task is told at test time, the same for all learners (theirs are autoencoders). No figure of theirs
is claimed.
"""

from __future__ import annotations

from aegis_cli.continual.learners.base import Flows, Learner, TaskContext, route_task
from aegis_cli.models.backbones.dual import DualEncoder


def begin(context: TaskContext) -> None:
    """The whole pool comes with the first task; an expert belongs to none until one freezes it."""
    assert isinstance(context.model, DualEncoder)
    options = context.options
    pool = options["experts_per_task"] * context.tasks
    for name, site in context.sites.items():
        if context.task == 0:
            for _ in range(pool):
                # Tasks count from 0, so that their number is the owner of what no task owns.
                site.add_expert(options["rank"], context.tasks, context.generator)
        constant = context.model.in_text(name)
        numbers, top = site.numbers, options["top"]
        route_task(site, context.task, numbers, context, top=top, constant=constant)


def finish(context: TaskContext, flows: Flows) -> None:
    """Freeze the `top` experts that the task has used most; the others learn with the next task."""
    for name, site in context.sites.items():
        mass = flows[name].mass
        count = min(context.options["top"], len(mass))
        most = mass.topk(count).indices.tolist()
        # A task's router has the whole pool in the order of its numbers, as its columns are.
        for expert in site.of([site.numbers[i] for i in most]):
            if not expert.frozen:
                expert.owner, expert.frozen = context.task, True


LEARNER = Learner(
    "moe-adapters",
    "a pool of experts, two per example, the most used frozen",
    begin=begin,
    finish=finish,
)
