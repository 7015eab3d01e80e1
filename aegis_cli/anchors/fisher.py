"""The diagonal Fisher information of a VLM's answers, the weights of EWC (arXiv 1612.00796)."""

from __future__ import annotations

import torch
from torch import Tensor

from aegis_cli.anchors import kept_work
from aegis_cli.common.events import OnEvent, Progress, ignore
from aegis_cli.common.kept_tensors import Kept
from aegis_cli.common.ranks import ALONE, Ranks
from aegis_cli.data import spread
from aegis_cli.data.vqa.dataset import VQASet
from aegis_cli.data.vqa.images import tensors
from aegis_cli.models.backbones.base import Backbone

_STAGE = "anchor fisher"


def measure(
    model: Backbone,
    asked: VQASet,
    samples: int,
    on_event: OnEvent = ignore,
    ranks: Ranks = ALONE,
    work: kept_work.Work = kept_work.NOTHING,
) -> dict[str, Tensor]:
    """Measure E[(d log p(answer | image, question) / d theta)^2] of each parameter.

    This is the empirical Fisher information, that of the reference answers. Each question has a
    backward pass of its own: the square of a batch's mean gradient is not the mean of squares.

    Args:
        samples: number of questions, spread evenly over the set.
        ranks: the processes, which take questions in turn.
        work: the saved state of an interrupted measurement, and of this one.

    Returns:
        Parameter name -> tensor of the parameter's shape, float32.
    """
    piece = work.piece(_STAGE)
    if (known := piece.finished()) is not None:
        on_event(Progress(_STAGE, samples, samples, "samples"))
        return {name: t.to(model.device) for name, t in known.tensors.items()}
    parameters = dict(model.named_parameters())
    # In float64: the square of a gradient of 1e-25 is 0 in float32.
    if (begun := piece.begun()) is None:
        total = {name: torch.zeros_like(p, dtype=torch.float64) for name, p in parameters.items()}
        before = 0
    else:
        total = {name: begun.tensors[name].to(p.device) for name, p in parameters.items()}
        before = begun.figures["done"]
        del begun  # whose copy on the CPU takes as much memory
    rows = spread.rows(len(asked.questions), samples)
    on_event(Progress(_STAGE, before, samples, "samples"))
    with piece.going(lambda: Kept({}, total)) as passed:
        for done, row in enumerate(rows.tolist()[before:], start=before + 1):
            if (done - 1) % ranks.count == ranks.rank:  # the processes take turns
                likelihood = _log_likelihood(model, asked, row)
                wanted = list(parameters.values())
                # Not `backward`, which would leave a gradient in every parameter.
                gradients = torch.autograd.grad(likelihood, wanted, allow_unused=True)
                for name, gradient in zip(parameters, gradients, strict=True):
                    if gradient is not None:
                        total[name] += gradient.double().square()  # widened before it is squared
            passed(done)
            if done % 50 == 0 or done == samples:
                on_event(Progress(_STAGE, done, samples, "samples"))
    ranks.add_up(list(total.values()))
    found = {name: (t / samples).float() for name, t in total.items()}
    piece.finish(Kept({}, found))
    return found


def _log_likelihood(model: Backbone, asked: VQASet, row: int) -> Tensor:
    """log p(answer) of one question, a scalar with its graph."""
    question = asked.questions[row]
    image = tensors(asked.images[asked.image_of[row : row + 1]])
    return model.answer_log_likelihood(image, [question.text], [question.answer]).sum()
