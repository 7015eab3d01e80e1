"""A LoRA (arXiv 2106.09685) for each task, which shares nothing with the others; its scale learns,
as in all learners here.
"""

from __future__ import annotations

from aegis_cli.continual.learners.base import Arrival, Learner, keep_experts, learn


def begin(arrival: Arrival) -> None:
    for site in arrival.sites.values():
        own = site.add_expert(arrival.options["rank"], arrival.task, arrival.generator)
        learn(site, arrival.task, [own], arrival)


LEARNER = Learner(
    "isolated-lora", "a low-rank term a task", frozen=True, begin=begin, finish=keep_experts
)
