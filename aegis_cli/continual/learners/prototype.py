"""Sharing by image similarity: tasks whose mean features are close share an expert.

This is a simple form of what iGSP (arXiv 2605.19301) calls similarity-driven sharing; the rule is
ours. A shared expert goes on learning, so the new task also changes it for the earlier tasks.
"""

from __future__ import annotations

import torch
from torch import Tensor

from aegis_cli.continual.learners.base import Learner, TaskContext, route_task


def begin(context: TaskContext) -> None:
    """Continue the experts of the nearest earlier task, or add new ones."""
    partner = nearest(context.prototypes, context.options["similarity"])
    for site in context.sites.values():
        known = None if partner is None else site.router(partner)
        if known is None:  # also if the partner has no router at this map
            own = site.add_expert(context.options["rank"], context.task, context.generator)
            route_task(site, context.task, [own], context)
            continue
        router = route_task(site, context.task, known.experts, context)
        with torch.no_grad():
            router.scale.copy_(known.scale)


def nearest(prototypes: Tensor, similarity: float) -> int | None:
    """The earlier task whose prototype has the largest cosine with the last of [T, D].

    The result is None if that cosine is below `similarity`.
    """
    if len(prototypes) == 1:
        return None
    cosines = torch.nn.functional.cosine_similarity(prototypes[:-1], prototypes[-1:], dim=-1)
    return int(cosines.argmax()) if cosines.max() >= similarity else None


LEARNER = Learner(
    "prototype", "an expert for tasks whose images look alike", compares=True, begin=begin
)
