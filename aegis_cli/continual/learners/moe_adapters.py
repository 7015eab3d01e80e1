"""In the style of MoE-Adapters (arXiv 2403.11549): a pool of experts, and a router per task.

From their abstract and repository: low-rank experts beside CLIP's frozen maps, one linear router
per task with a softmax over its top two, a static pool (22 experts for 11 tasks), and freezing the
experts that a task has used most.

Ours: the sites, which are the same for all learners here; a router that reads the mean of the
sequence instead of its first token, and nothing in the text tower (under CLIP's causal mask the
first token is the same in every text, so theirs makes a constant choice there); and the way the
task is inferred at test time, which is the same for all learners (theirs uses autoencoders). We
claim none of their figures.
"""

from __future__ import annotations

from aegis_cli.continual.learners.base import Flows, Learner, TaskContext, route_task
from aegis_cli.models.backbones.dual import DualEncoder


def begin(context: TaskContext) -> None:
    """Add the whole pool with the first task; an expert has no owner until a task freezes it."""
    assert isinstance(context.model, DualEncoder)
    options = context.options
    pool = options["experts_per_task"] * context.tasks
    for name, site in context.sites.items():
        if context.task == 0:
            for _ in range(pool):
                # Tasks are numbered from 0, so their count as an owner means "no task".
                site.add_expert(options["rank"], context.tasks, context.generator)
        constant = context.model.in_text(name)
        numbers, top = site.numbers, options["top"]
        route_task(site, context.task, numbers, context, top=top, constant=constant)


def finish(context: TaskContext, flows: Flows) -> None:
    """Freeze the `top` experts that the task used most; the others learn with the next task."""
    for name, site in context.sites.items():
        mass = flows[name].mass
        count = min(context.options["top"], len(mass))
        most = mass.topk(count).indices.tolist()
        # A task's router has the whole pool as its columns, in the order of the expert numbers.
        for expert in site.of([site.numbers[i] for i in most]):
            if not expert.frozen:
                expert.owner, expert.frozen = context.task, True


LEARNER = Learner(
    "moe-adapters",
    "a pool of experts, two per example, the most used frozen",
    begin=begin,
    finish=finish,
)
