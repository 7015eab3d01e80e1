"""Co-training: loss + weight x cross-entropy of VQA answers, one batch of questions per step.

Robot policies with web data are trained so (RT-2, arXiv 2307.15818). It is a ceiling (an upper
bound): it trains on data that the other methods do without.
"""

from __future__ import annotations

from torch import Tensor

from aegis_cli.methods.base import Method, MethodContext, Parts, Pass, train_all


def start(context: MethodContext) -> Parts:
    """Add the questions' loss to every step; what is asked is the caller's choice."""
    weight, vqa_loss = context.options["weight"], context.vqa_loss
    if weight == 0:
        return Parts()
    assert vqa_loss is not None

    def auxiliary(seen: Pass) -> Tensor:
        return weight * vqa_loss(seen)

    return Parts(auxiliary=auxiliary)


METHOD = Method(
    "cotrain",
    "trains on VQA questions too: the ceiling",
    train_all,
    start=start,
    vqa_weight="weight",
)
