"""Mean and variance of hidden states over valid tokens.

masked_moments  of one batch, in float64, to be merged; for measuring an anchor
batch_moments   of one batch, with its graph; for penalties
padded_moments  the same by masking, without a GPU sync
joint_moments   `padded_moments` of every layer, in few kernels
shared_moments  of a batch that several processes share
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from aegis_cli.core import stacking
from aegis_cli.core.numerics import widened

# Rows summed in float32 before the sum moves to float64. Centred rows of one block lose at most
# ~64 rounding errors of 6e-8 (measured on 5,000 rows: 2e-8 relative on the variance), at half the
# cost of converting every row to float64.
_BLOCK = 64


@dataclass(frozen=True)
class Moments:
    """A diagonal Gaussian fitted to `count` tokens.

    Attributes:
        mean: [D] float64.
        var: population variance [D] float64.
    """

    count: int
    mean: Tensor
    var: Tensor

    def to(self, like: Tensor | torch.device) -> Moments:
        """The same moments on a device, or on the device and in the dtype of a tensor."""
        return Moments(self.count, self.mean.to(like), self.var.to(like))


def empty(width: int) -> Moments:
    """The moments of no tokens: the neutral element of `merge`."""
    zeros = torch.zeros(width, dtype=torch.float64, device="cpu")
    return Moments(0, zeros, zeros)


@torch.no_grad()
def masked_moments(h: Tensor, mask: Tensor) -> Moments:
    """Moments of one batch, over its valid tokens only.

    The rows are centred before they are squared, so a mean of 1e3 with a deviation of 0.1 costs no
    digits; E[x^2] - E[x]^2 in float32 returns anything from 0 to 0.66 there.

    Args:
        h: hidden states [B, T, D], any float dtype.
        mask: [B, T] bool, true at valid tokens; values elsewhere (even NaN) never count.
    """
    x = _valid_rows(h, mask)  # [n, D]
    n = len(x)
    if n == 0:
        return empty(h.shape[-1])
    shift = x.mean(0)  # need not be exact: `rest` corrects its error
    x = x - shift
    rest = _sum_rows(x) / n
    var = _sum_rows(x.square_()) / n - rest.square()
    return Moments(n, shift.double() + rest, var.clamp_(min=0))


def merge(a: Moments, b: Moments) -> Moments:
    """Moments of the union of two token sets (Chan, Golub & LeVeque 1979, eq. 2.1).

    Associative and commutative up to float64 rounding: batches, workers and ranks agree.
    """
    if a.count == 0 or b.count == 0:
        return a if b.count == 0 else b
    n = a.count + b.count
    share = b.count / n
    delta = b.mean - a.mean
    within = a.var * (1 - share) + b.var * share
    between = delta.square() * (share * (1 - share))
    return Moments(n, a.mean + delta * share, within + between)


def add_moments(found: Sequence[Moments], hidden: Sequence[Tensor], mask: Tensor) -> list[Moments]:
    """Moments merged, layer by layer, with those of one more batch.

    Args:
        found: moments so far, one per layer.
        hidden: hidden states [B, T, D], one per layer.
        mask: valid tokens, [B, T] bool.
    """
    merged = []
    for so_far, h in zip(found, hidden, strict=True):
        merged.append(merge(so_far, masked_moments(h, mask)))
    return merged


def batch_moments(h: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Differentiable mean [D] and population variance [D] of a batch's valid tokens, two-pass.

    Args:
        h: hidden states [B, T, D]; half precision is upcast to float32.
        mask: [B, T] bool with at least one true entry (without any, both results are NaN).
    """
    x = _valid_rows(h, mask)
    mean = x.mean(0)
    return mean, (x - mean).square().mean(0)


def padded_moments(h: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """`batch_moments` by masking instead of selecting rows, which avoids a GPU sync.

    Args:
        h: hidden states [B, T, D], or [n, B, T, D] of n layers, with results [n, D].
        mask: [B, T] bool.
    """
    x, valid = _all_rows(h, mask)
    count = valid.sum()
    # Filled, not multiplied by 0: values at padding may be NaN.
    mean = x.masked_fill(~valid, 0).sum(-2) / count
    deviations = (x - mean.unsqueeze(-2)).masked_fill(~valid, 0)
    return mean, deviations.square().sum(-2) / count


def joint_moments(hidden: Sequence[Tensor], mask: Tensor) -> list[tuple[Tensor, Tensor]]:
    """`padded_moments` of each layer; layers of one shape are stacked, so that fewer kernels run.

    Args:
        hidden: each layer's output, L tensors [B, T, D].
        mask: [B, T] bool.
    """
    found: list[tuple[Tensor, Tensor]] = []
    for layers in _together(hidden):
        means, variances = padded_moments(layers, mask)
        found.extend(zip(means.unbind(), variances.unbind(), strict=True))
    return found


def shared_moments(
    hidden: Sequence[Tensor],
    mask: Tensor,
    total: Callable[[Tensor], Tensor],
    reads: bool = True,
) -> list[tuple[Tensor, Tensor]]:
    """Each layer's mean [D] and variance [D] over a batch that several processes share.

    Mean and variance are those of all shares. Their gradients reach only the tokens of this
    process, so the gradients of all processes add up to that of the batch.

    Args:
        hidden: each layer's output, L tensors [B, T, D].
        mask: [B, T] bool.
        total: sums a tensor over the processes.
        reads: whether the number of valid tokens may be read, which forces a GPU sync.
    """
    rows, masks, here = _selected(hidden, mask) if reads else _zeroed(hidden, mask)
    count = total(here)
    # Each sum covers all layers at once, because each call of `total` is a message.
    means = total(torch.cat([x.sum(1) for x in rows])) / count  # [L, D]
    squares = []
    # The centre is detached: its gradient is 0 over all tokens, but not over a share of them.
    centres = means.detach().split([len(x) for x in rows])
    for x, centre, valid in zip(rows, centres, masks, strict=True):
        deviations = x - centre.unsqueeze(1)
        if valid is not None:
            deviations = deviations.masked_fill(~valid, 0)
        squares.append(deviations.square().sum(1))
    variances = total(torch.cat(squares)) / count  # [L, D]
    return list(zip(means, variances, strict=True))


# The rows of some layers [n, rows, D], which rows are valid [rows, 1] (None: all), and how many.
_LayerRows = tuple[list[Tensor], Sequence[Tensor | None], Tensor]


def _selected(hidden: Sequence[Tensor], mask: Tensor) -> _LayerRows:
    """Only the valid rows, layer by layer."""
    rows = [_valid_rows(h, mask).unsqueeze(0) for h in hidden]
    return rows, [None] * len(rows), rows[0].new_tensor(rows[0].shape[1])


def _zeroed(hidden: Sequence[Tensor], mask: Tensor) -> _LayerRows:
    """All rows, with invalid ones set to zero; nothing is read from the device."""
    rows, valids = list[Tensor](), list[Tensor]()
    for layers in _together(hidden):
        x, valid = _all_rows(layers, mask)
        rows.append(x.masked_fill(~valid, 0))
        valids.append(valid)
    return rows, valids, valids[-1].sum().to(rows[0].dtype)


def _together(hidden: Sequence[Tensor]) -> list[Tensor]:
    """Consecutive layers, stacked [n, B, T, D] as long as their shapes are equal.

    A stack has at most `stacking.MOST` entries: larger layers keep a GPU busy by themselves.
    """
    groups: list[list[Tensor]] = []
    for h in hidden:
        last = groups[-1] if groups else []
        alike = bool(last) and _kind(last[0]) == _kind(h)
        if not alike or (len(last) + 1) * h.numel() > stacking.MOST:
            groups.append([])
        groups[-1].append(h)
    return [torch.stack(group) for group in groups]


def _kind(h: Tensor) -> tuple[torch.Size, torch.dtype, torch.device]:
    """What hidden states must have in common to be stacked; a model may span several GPUs."""
    return h.shape, h.dtype, h.device


def _all_rows(h: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """All rows [..., n, D] of hidden states [..., B, T, D], and which are valid [n, 1].

    They are in float32, or float64 if h is.
    """
    x = h.flatten(-3, -2)
    valid = mask.to(h.device).flatten()[:, None]
    return widened(x), valid


def _valid_rows(h: Tensor, mask: Tensor) -> Tensor:
    """The valid rows [n, D] of hidden states [B, T, D], in float32, or float64 if h is."""
    # On a CPU, the backward pass of index_select takes half as long as that of h[mask].
    index = mask.flatten().nonzero().squeeze(1).to(h.device)
    return widened(h.flatten(0, 1).index_select(0, index))


def _sum_rows(x: Tensor) -> Tensor:
    """The sum [D] float64 over rows [n, D]."""
    whole = len(x) // _BLOCK
    in_blocks, left_over = x[: whole * _BLOCK], x[whole * _BLOCK :]
    blocks = in_blocks.view(whole, _BLOCK, x.shape[1]).sum(1)  # [whole, D]
    return blocks.double().sum(0) + left_over.double().sum(0)
