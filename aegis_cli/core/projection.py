"""Projection of a group's task gradient g against its anchor gradient a, by three inner products.

Two gradients give three inner products tt, ta and aa (t and a stand for task and anchor), these
give two weights, and the weights give one gradient. The inner products add up over parameters and
ranks, so sharded training needs only one all-reduce of three numbers per group.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence

import torch
from torch import Tensor

from aegis_cli.core.numerics import ratio

Gradients = Sequence[Tensor | None]
# (tt, ta, aa) [G] -> weights (wg, wa) [G] of the task and the anchor gradient
Combine = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]
# How many entries are upcast at a time. On a CPU they stay in a core's cache; on a GPU the copies
# take 0.4 GB and few kernels are launched.
_BLOCK, _GPU_BLOCK = 1 << 16, 1 << 24


@torch.no_grad()
def inner(
    gs: Gradients, as_: Gradients, device: torch.device | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """tt = <g, g>, ta = <g, a>, aa = <a, a> over one group's parameters, float64 scalars.

    A missing gradient (None) counts as zero. Products are taken in float64: the float32 square of a
    gradient of 1e-25 is 0, and the projection would silently vanish with it.

    Args:
        device: device of the result; None: that of the gradients.
    """
    device = device or _device((*gs, *as_))
    if device is not None and device.type != "cpu":
        return _inner_by_few_kernels(gs, as_, device)
    tt, ta, aa = torch.zeros(3, dtype=torch.float64, device=device)
    for g, a in zip(gs, as_, strict=True):
        for u, v in _widened(g, a):
            if u is not None:
                tt = tt + u.dot(u).to(tt.device)
            if v is not None:
                aa = aa + v.dot(v).to(aa.device)
            if u is not None and v is not None:
                ta = ta + u.dot(v).to(ta.device)
    return tt, ta, aa


def _inner_by_few_kernels(
    gs: Gradients, as_: Gradients, device: torch.device
) -> tuple[Tensor, Tensor, Tensor]:
    """The same on a GPU, where launching a kernel takes longer than running it on one bias."""
    ta = torch.zeros((), dtype=torch.float64, device=device)
    for u, v in _joined(gs, as_):
        ta = ta + u.double().dot(v.double()).to(device)
    return _energy(gs, device), ta, _energy(as_, device)


def _energy(gradients: Gradients, device: torch.device) -> Tensor:
    """<g, g> over the gradients that exist, a float64 scalar, without a float64 copy of them."""
    there = [g for g in gradients if g is not None]
    if not there:
        return torch.zeros((), dtype=torch.float64, device=device)
    norms = torch._foreach_norm(there, dtype=torch.float64)
    # In a user's own loop, the layers may be spread over several GPUs.
    return torch.stack([norm.to(device) for norm in norms]).square().sum()


def _joined(gs: Gradients, as_: Gradients) -> Iterator[tuple[Tensor, Tensor]]:
    """The entries of all pairs in blocks [n] of bounded size, with small tensors joined."""
    waiting, size = list[tuple[Tensor, Tensor]](), 0
    for g, a in zip(gs, as_, strict=True):
        if g is None or a is None:
            continue
        for block in zip(_blocks(g), _blocks(a), strict=True):
            full = size + len(block[0]) > _GPU_BLOCK
            if waiting and (full or waiting[0][0].device != block[0].device):
                yield _concatenated(waiting)
                waiting, size = [], 0
            waiting.append(block)
            size += len(block[0])
    if waiting:
        yield _concatenated(waiting)


def _concatenated(pairs: Sequence[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    """Pairs of blocks joined into one; a single one is not copied."""
    if len(pairs) == 1:
        return pairs[0]
    left, right = zip(*pairs, strict=True)
    return torch.cat(left), torch.cat(right)


def dot(x: Tensor, y: Tensor) -> Tensor:
    """<x, y> of two tensors of one shape, a float64 scalar."""
    total = torch.zeros((), dtype=torch.float64, device=x.device)
    for u, v in zip(_blocks(x), _blocks(y), strict=True):
        total = total + u.double().dot(v.double())
    return total


def _widened(g: Tensor | None, a: Tensor | None) -> Iterator[tuple[Tensor | None, Tensor | None]]:
    """Both in float64, block by block: a whole copy of a large table would be twice its size."""
    of_g, of_a = _blocks(g), _blocks(a)
    for i in range(max(len(of_g), len(of_a))):
        u = of_g[i].double() if of_g else None
        v = of_a[i].double() if of_a else None
        yield u, v


def _blocks(x: Tensor | None) -> Sequence[Tensor]:
    """The entries in blocks [n], as views; none for a missing tensor."""
    if x is None:
        return ()
    return x.flatten().split(_BLOCK if x.is_cpu else _GPU_BLOCK)


def _device(tensors: Iterable[Tensor | None]) -> torch.device | None:
    """The device of the first tensor that is not None."""
    return next((x.device for x in tensors if x is not None), None)


def gram(groups: Sequence[tuple[Gradients, Gradients]]) -> tuple[Tensor, Tensor, Tensor]:
    """The inner products of every group, stacked: tt, ta, aa [G]."""
    # A group without gradients has no device: take that of the first gradient of any group.
    device = _device(x for gs, as_ in groups for x in (*gs, *as_))
    rows = [torch.stack(inner(gs, as_, device)) for gs, as_ in groups]
    tt, ta, aa = torch.stack(rows).unbind(1)  # of [G, 3]
    return tt, ta, aa


def naive(tt: Tensor, ta: Tensor, aa: Tensor) -> tuple[Tensor, Tensor]:
    """The task gradient as it is: weights (1, 0)."""
    return torch.ones_like(tt), torch.zeros_like(tt)


def aegis(tt: Tensor, ta: Tensor, aa: Tensor) -> tuple[Tensor, Tensor]:
    """Gram-Schmidt against the anchor gradient where the two conflict: weights (1, relu(-ta) / aa).

    If ta < 0, the result is orthogonal to a; otherwise it is the task gradient itself. The
    denominator has no epsilon: with one, the result would not be orthogonal. If aa = 0, there is no
    projection.
    """
    # With d = ta < 0, g - (d / <a, a>) a is g + (-d / <a, a>) a; relu leaves out d > 0.
    return torch.ones_like(tt), ratio(torch.relu(-ta), aa)


@torch.no_grad()
def apply(
    gs: Gradients, as_: Gradients, wg: float | Tensor, wa: float | Tensor
) -> list[Tensor | None]:
    """g <- wg g + wa a for one group, in place where g exists; returns the group's gradients.

    With weights (1, 0) nothing changes, bit for bit. If g is None and a is not, the result is a new
    tensor: the projection moves parameters that the task does not. Weights that are tensors [] are
    not read (no GPU sync), so the shortcuts for (1, 0) do not apply to them.
    """
    there = [g for g in gs if g is not None]
    if there and (isinstance(wg, Tensor) or wg != 1):
        torch._foreach_mul_(there, _like(wg, there[0]))
    if not isinstance(wa, Tensor) and wa == 0:
        return list(gs)
    combined: list[Tensor | None] = []
    changed, added = list[Tensor](), list[Tensor]()
    for g, a in zip(gs, as_, strict=True):
        if g is None and a is not None:
            combined.append(scaled(a, wa))
            continue
        combined.append(g)
        if g is not None and a is not None:
            changed.append(g)
            added.append(a)
    if changed:
        add_scaled(changed, added, wa)
    return combined


def add_scaled(xs: Sequence[Tensor], ys: Sequence[Tensor], scale: float | Tensor) -> None:
    """x <- x + scale y in place, for each pair; a scale that is a tensor [] is not read."""
    if not all(_holds(y.dtype, scale) for y in ys):
        for x, y in zip(xs, ys, strict=True):
            x.add_(y.double() * scale)  # the product fits again when it is rounded to x's dtype
    elif isinstance(scale, Tensor):
        # `alpha` takes numbers only, and converting a tensor to one would read it.
        added = torch._foreach_mul(list(ys), _like(scale, ys[0]))
        torch._foreach_add_(list(xs), added)
    else:
        torch._foreach_add_(list(xs), list(ys), alpha=scale)


def scaled(y: Tensor, scale: float | Tensor) -> Tensor:
    """scale y, a new tensor of y's dtype."""
    if _holds(y.dtype, scale):
        return y * scale
    return (y.double() * scale).to(y.dtype)


def _holds(dtype: torch.dtype, scale: float | Tensor) -> bool:
    """Whether a finite scale fits into a dtype without overflow.

    A tiny anchor gradient gets a huge weight, which easily overflows float16, although their
    product is no larger than the task gradient. A tensor is not read, so for float16 it counts as
    too large. Wider dtypes overflow only if the gradients differ by 38 orders of magnitude.
    """
    if isinstance(scale, Tensor):
        return dtype != torch.float16
    return not math.isfinite(scale) or abs(scale) <= torch.finfo(dtype).max


def _like(scale: float | Tensor, x: Tensor) -> float | Tensor:
    return scale.to(x.dtype) if isinstance(scale, Tensor) else scale


def removed_energy(ta: Tensor, aa: Tensor) -> Tensor:
    """The energy |g|^2 - |projected g|^2 that each group loses: relu(-ta)^2 / aa."""
    # If ta < 0: |g|^2 - |g - (ta / aa) a|^2 = ta^2 / aa.
    return ratio(torch.relu(-ta).square(), aa)


def energy_shed(tt: Tensor, ta: Tensor, aa: Tensor) -> Tensor:
    """Fraction of each group's energy that the projection removes: relu(-cos)^2, in [0, 1]."""
    # ta^2 / (aa tt) is the squared cosine of g and a.
    return ratio(removed_energy(ta, aa), tt)


def conflict(ta: Tensor) -> Tensor:
    """Whether the task's step would raise the transport cost, to first order."""
    # A step along -g changes the cost by -<g, a>.
    return ta < 0
