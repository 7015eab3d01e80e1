"""Feature distillation: on robot frames, hold each layer's output to that of the pre-trained one.

FitNets (arXiv 1412.6550) with a frozen copy of the backbone as the teacher, as in Anchor-Align's
vision-language anchoring (arXiv 2607.13429):

    loss + weight mean_l ( sum_t |h_l,t - h0_l,t|^2 / sum_t |h0_l,t - mean_t h0_l,t|^2 )

over valid tokens t. Dividing each layer by the variance of the teacher is our choice: deep residual
streams do not dominate shallow ones. No VQA data is read; every step costs a forward pass of the
copy.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from aegis_cli.common import devices
from aegis_cli.core.numerics import widened
from aegis_cli.methods.base import Method, MethodContext, Parts, Pass, train_all
from aegis_cli.models.backbones.base import Backbone


def start(context: MethodContext[Backbone]) -> Parts:
    """Copy the trainable part of the backbone, as it is now."""
    weight = context.options["weight"]
    if weight == 0:  # the same as naive, without the cost of a copy
        return Parts()
    backbone = context.backbone  # not the context, which would keep the whole anchor in memory
    frozen = _teacher(backbone)  # now, while the weights are still the pre-trained ones

    def auxiliary(seen: Pass) -> Tensor:
        _round_alike(frozen, backbone)
        with torch.no_grad():
            taught = frozen.encode(seen.inputs).hidden  # L tensors [B, T, D]
        return weight * relative_distance(seen.hidden, taught, seen.mask, seen.total)

    return Parts(auxiliary=auxiliary)


def _teacher(backbone: Backbone) -> Backbone:
    """A frozen copy of the backbone that shares its frozen parameters."""
    shared = {id(p): p for p in backbone.parameters() if not p.requires_grad}
    # deepcopy does not copy objects in its memo.
    return copy.deepcopy(backbone, shared).eval().requires_grad_(False)


def _round_alike(frozen: nn.Module, backbone: nn.Module) -> None:
    """Cast the teacher's weights to the dtypes of the backbone's weights in this pass.

    With `train.weights: bf16-master` a pass uses rounded weights. A float32 teacher would train the
    student to undo the rounding.
    """
    own = dict(backbone.named_parameters())
    for name, copied in frozen.named_parameters():
        if name in own and own[name].dtype != copied.dtype:
            copied.data = copied.data.to(own[name].dtype)


def relative_distance(
    hidden: Sequence[Tensor],
    taught: Sequence[Tensor],
    mask: Tensor,
    total: Callable[[Tensor], Tensor] | None = None,
) -> Tensor:
    """Squared distance of student and teacher over the teacher's variance, averaged over layers.

    Args:
        hidden, taught: L tensors [B, T, D] each, of the student and of the teacher.
        mask: [B, T] bool; tokens where it is false do not count.
        total: sums a tensor over the processes, each of which has a share of the batch; the result
            is then the contribution of this share.
    """
    layers = []
    if devices.reading_stalls(mask.device):
        # Selecting rows would force a GPU sync.
        for h, h0 in zip(hidden, taught, strict=True):
            layers.append(_relative_padded(widened(h), widened(h0), mask[..., None], total))
        return torch.stack(layers).mean()
    index = mask.flatten().nonzero().squeeze(1)  # indices [n] of the valid tokens in [B*T]
    for h, h0 in zip(hidden, taught, strict=True):
        layers.append(_relative(_rows(h, index), _rows(h0, index), total))
    return torch.stack(layers).mean()


def _relative(student: Tensor, teacher: Tensor, total: Callable[[Tensor], Tensor] | None) -> Tensor:
    """Squared distance of a student's tokens [n, D] from a teacher's, over their variance."""
    off = (student - teacher).square().sum()
    if total is None:
        return off / (teacher - teacher.mean(0)).square().sum()
    # The distance is that of this share, the variance that of the whole batch: shares add up.
    count = total(teacher.new_tensor(len(teacher)))
    mean = total(teacher.sum(0)) / count
    return off / total((teacher - mean).square().sum())


def _relative_padded(
    student: Tensor, teacher: Tensor, valid: Tensor, total: Callable[[Tensor], Tensor] | None
) -> Tensor:
    """Like `_relative`, but for tokens [B, T, D], of which those in `valid` [B, T, 1] count."""
    add_up = total or (lambda x: x)
    off = (student - teacher).masked_fill(~valid, 0).square().sum()
    shown = teacher.masked_fill(~valid, 0)
    count = add_up(valid.sum().to(shown.dtype))
    mean = add_up(shown.sum((0, 1))) / count  # [D]
    # Masked again, because padding is 0 here, and 0 - mean would count.
    deviations = (shown - mean).masked_fill(~valid, 0)
    return off / add_up(deviations.square().sum())


def _rows(h: Tensor, index: Tensor) -> Tensor:
    """[B, T, D] -> [n, D]."""
    return widened(h.flatten(0, 1).index_select(0, index))


METHOD = Method(
    "distill",
    "hidden states held to a frozen copy's, on robot frames",
    train_all,
    start=start,
    shards=False,  # the copy would be whole in every process
)
