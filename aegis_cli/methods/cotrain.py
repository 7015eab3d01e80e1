"""Co-training: loss + weight x cross-entropy of VQA answers, one batch of questions per step.

Robot policies are trained this way on web data (RT-2, arXiv 2307.15818). It is a ceiling (an upper
bound), because it trains on data that the other methods do not use.
"""

from __future__ import annotations

from torch import Tensor

from aegis_cli.methods.base import Method, MethodContext, Parts, Pass, train_all


def start(context: MethodContext) -> Parts:
    """Add the loss on questions to every step; the caller chooses the questions."""
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
