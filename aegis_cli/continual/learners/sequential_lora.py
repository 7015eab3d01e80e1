"""One LoRA (arXiv 2106.09685) for all tasks, which goes on learning with each."""

from __future__ import annotations

from aegis_cli.continual.learners.base import Arrival, Learner, learn

_ONLY = 0  # number of the router that serves every task


def begin(arrival: Arrival) -> None:
    for site in arrival.sites.values():
        if arrival.task == 0:
            learn(
                site,
                _ONLY,
                [site.add_expert(arrival.options["rank"], _ONLY, arrival.generator)],
                arrival,
            )
        site.experts.requires_grad_(True)
        site.routers.requires_grad_(True)


LEARNER = Learner(
    "sequential-lora",
    "one low-rank term, task after task",
    shared=True,
    begin=begin,
    router=lambda task: _ONLY,
)
