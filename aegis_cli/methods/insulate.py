"""Knowledge insulation as published (Driess et al. 2025, arXiv 2505.23705).

The expert's gradient stops at the backbone's keys and values, as under `stop-gradient`. The
backbone still learns from robot frames, but with its pre-training loss: given the instruction, it
has to answer with the actions as text,

    loss + weight * mean(-log p(actions as text | image, instruction)),

in nats per number. The third part of the paper is training on VQA data at the same time: with
`vqa_weight`, a batch of questions per step adds its cross-entropy, and the method is a ceiling.

Our differences: the paper writes actions as FAST tokens. Here each normalised action falls into one
of `bins` equal bins between -`limit` and `limit` and is written as the number of that bin, as in
RT-2 (arXiv 2307.15818), for `horizon` steps of the chunk. `prompt` may ask for actions in different
words than questions use. The text needs a second pass over the image, where the paper shares one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from aegis_cli.common.errors import AegisError
from aegis_cli.data.batch import RobotBatch
from aegis_cli.methods.base import Method, MethodContext, Parts, Pass, train_all
from aegis_cli.models.backbones.base import Backbone


@dataclass(frozen=True)
class _Written:
    """The actions of some frames as text.

    Attributes:
        asked: the prompt of each frame.
        texts: the answer to be learned for each frame.
        numbers: total count of numbers in all texts, int64 [].
        answered: the result of `Backbone.prepare_answers` for them.
    """

    asked: Sequence[str]
    texts: Sequence[str]
    numbers: Tensor
    answered: Any


def start(context: MethodContext[Backbone]) -> Parts:
    """Let the backbone learn actions as text, and questions if `vqa_weight` is above 0.

    Raises:
        AegisError: there are more bins than the backbone has texts for, or an instruction leaves no
            room for its actions.
    """
    weight, vqa_weight = context.options["weight"], context.options["vqa_weight"]
    terms: list[Callable[[Pass], Tensor]] = []
    write = None
    if weight > 0:
        write = _writing(context)
        action_loss = _action_loss(context, write)
        terms.append(lambda seen: weight * action_loss(seen))
    if vqa_weight > 0:
        vqa_loss = context.vqa_loss
        assert vqa_loss is not None
        terms.append(lambda seen: vqa_weight * vqa_loss(seen))
    if not terms:
        return Parts()

    def auxiliary(seen: Pass) -> Tensor:
        return torch.stack([term(seen) for term in terms]).sum()

    return Parts(auxiliary=auxiliary, prepare=write)


def _action_loss(
    context: MethodContext[Backbone], write: Callable[[RobotBatch], _Written]
) -> Callable[[Pass], Tensor]:
    """A pass over robot frames -> mean cross-entropy per number, in nats, with its graph."""
    backbone = context.backbone

    def loss(seen: Pass) -> Tensor:
        frames = seen.frames
        assert frames is not None
        written = seen.prepared or write(frames)  # None if nothing was prepared ahead
        said = backbone.answer_log_likelihood(
            frames.images, written.asked, written.texts, written.answered
        )
        count = written.numbers
        if seen.total is not None:
            # Divide by the count of all processes, so that their contributions add up to the mean.
            count = seen.total(count.to(said.device))
        return -said.sum() / count

    return loss


def _writing(context: MethodContext[Backbone]) -> Callable[[RobotBatch], _Written]:
    """Robot frames -> their actions as text; on the CPU, so reading them needs no GPU sync."""
    backbone, targets = context.backbone, context.targets
    limit, horizon, prompt = (context.options[name] for name in ("limit", "horizon", "prompt"))
    assert targets is not None
    numbers = _numbers(context)
    # No number has more digits than the last, so no text of actions is longer.
    longest = " ".join(numbers[-1:] * (horizon * context.actions))
    _check_room(context, longest)

    def write(frames: RobotBatch) -> _Written:
        chosen = spread(frames.actions.shape[1], horizon)
        bins = binned(targets(frames)[:, chosen], limit, len(numbers))  # [B, S, A]
        # Actions past the end of an episode were never demonstrated.
        shown = ~frames.is_pad[:, chosen]  # [B, S]
        texts = as_texts(bins, shown, numbers)
        asked = [prompt.replace("{}", text) for text in frames.instructions]
        answered = backbone.prepare_answers(frames.images, asked, texts)
        return _Written(asked, texts, shown.sum() * bins.shape[-1], answered)

    return write


def spread(chunk: int, horizon: int) -> Tensor:
    """Indices of the steps of a chunk that are written, int64: evenly spread from the first.

    There are `horizon` of them, or all steps of a shorter chunk.
    """
    return torch.linspace(0, chunk - 1, min(horizon, chunk)).round().long()


def binned(actions: Tensor, limit: float, count: int) -> Tensor:
    """The bin of each normalised action, int64 from 0 to `count` - 1; the outer bins are open."""
    share = (actions + limit) / (2 * limit)  # 0 at -limit, 1 at limit
    return (share * count).floor().clamp(0, count - 1).long()


def as_texts(bins: Tensor, shown: Tensor, numbers: Sequence[str]) -> list[str]:
    """The numbers of each frame's actions, step by step, separated by spaces.

    Args:
        bins: [B, S, A] int64.
        shown: [B, S] bool; steps where it is false are not written.
        numbers: the text of each bin.
    """
    texts = []
    for steps, valid in zip(bins, shown, strict=True):
        chosen = steps[valid].flatten().tolist()  # A numbers per step
        texts.append(" ".join(numbers[i] for i in chosen))
    return texts


def _numbers(context: MethodContext[Backbone]) -> Sequence[str]:
    """The text of each bin, as the backbone writes numbers."""
    known = context.backbone.numbers
    count = known if context.options["bins"] is None else context.options["bins"]
    if count > known:
        raise AegisError(
            f"insulate.bins: {count} with a backbone that has texts for {known} numbers",
            f"at most {known} bins",
            f"--set insulate.bins={known}",
        )
    return context.backbone.number_texts(count)


def _check_room(context: MethodContext[Backbone], longest: str) -> None:
    """Raise AegisError if an instruction leaves no room for the longest text of actions."""
    for instruction in context.instructions:
        asked = context.options["prompt"].replace("{}", instruction)
        try:
            context.backbone.check_text(asked, longest)
        except AegisError as error:
            raise AegisError(
                f"the actions of '{asked}' as the text '{longest}': {error.found}",
                error.expected,
                "--set insulate.horizon=1, or fewer insulate.bins: up to 8 have shorter texts",
            ) from error


METHOD = Method(
    "insulate",
    "learns actions as text; the expert's gradient does not reach it",
    train_all,
    start=start,
    vqa_weight="vqa_weight",
    stop_gradient=True,
)
