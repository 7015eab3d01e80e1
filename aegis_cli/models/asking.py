"""Ask a backbone questions, in one process or divided among several."""

from __future__ import annotations

import torch

from aegis_cli.common.events import OnEvent, ignore
from aegis_cli.common.ranks import ALONE, Ranks
from aegis_cli.data.batch import Share
from aegis_cli.data.vqa.dataset import VQASet
from aegis_cli.data.vqa.metrics import Graded, grade
from aegis_cli.models.backbones.base import Backbone


def ask(
    model: Backbone,
    asked: VQASet,
    batch_size: int,
    on_event: OnEvent = ignore,
    ranks: Ranks = ALONE,
) -> list[Graded]:
    """Every question's answer, graded.

    The arithmetic is in float32, so neither the batch size nor the number of processes affects the
    result.

    Args:
        ranks: the processes that share the questions.
    """
    own = asked.part(Share(ranks.rank, ranks.count).rows(len(asked.questions)))
    # Not inference mode: a model that is trained afterwards may keep a tensor of this pass.
    with torch.no_grad():
        graded = grade(
            model.answers,
            own.sized(model.image_size),
            batch_size,
            on_event,
        )
    # Shares are in the order of the processes, so the answers are in the order of the questions.
    return [one for part in ranks.gathered(graded) for one in part]
