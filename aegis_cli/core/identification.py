"""Which experts a new task needs, and what is new in it, as told by a router's weights.

The rules here are our own: only the abstract of iGSP (arXiv 2605.19301) was available.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from aegis_cli.core.routing import Expert, Traced


@dataclass(frozen=True)
class Flow:
    """How a map's router distributes a batch among its experts.

    Attributes:
        mass: mean weight of each expert [E] float64; it sums to 1, or is all 0 if there are no
            positions.
        load: share of each expert in the sum of mean p_e ||B_e A_e x||, [E] float64; all 0 if every
            expert's output is 0.
    """

    mass: Tensor
    load: Tensor


@torch.no_grad()
def flow(passes: Sequence[Traced], experts: Sequence[Expert]) -> Flow:
    """Mass and load of each expert over all positions of `passes`."""
    weights = torch.cat([p.weights.flatten(0, -2) for p in passes]).double()  # [n, E]
    codes = torch.cat([p.codes.flatten(0, -3) for p in passes]).double()  # [n, E, r]
    inner = []
    for expert in experts:
        b = expert.b.double()  # [d_out, r]
        inner.append(b.T @ b)
    grams = torch.stack(inner)  # [E, r, r]
    # ||B c||^2 = c^T (B^T B) c needs no B c, which would be [n, d_out] for each expert.
    squares = torch.einsum("ner,ers,nes->ne", codes, grams, codes)
    norms = squares.clamp(min=0).sqrt()  # rounding can leave a square a little below 0
    mass = _shares(weights.sum(0))
    load = _shares((weights * norms).sum(0))
    return Flow(mass, load)


def _shares(parts: Tensor) -> Tensor:
    """Non-negative parts [E] divided by their sum; all 0 if that is 0.

    Weights need it too, because those of a bfloat16 pass sum to 1 only roughly.
    """
    total = parts.sum()
    shares = parts / total if total > 0 else parts
    return shares.cpu()


def where_read(passes: Mapping[str, Sequence[Traced]], loss: Tensor) -> dict[str, list[Traced]]:
    """The passes of each map at the positions that the loss reads.

    The loss reads a position if its gradient at the map's output there is not 0. All other
    positions say nothing about what a task needs, and they can be nearly all of them: padding, what
    follows the end of a text, and in the last layers everything but the token that becomes the
    feature.

    Returns:
        Passes with weights [n, E], codes [n, E, r] and outputs [n, d_out], by the map's name.
    """
    outputs = [p.outputs for name in passes for p in passes[name]]
    # Materialized, the gradient is 0 instead of None if the loss does not read the map at all.
    gradients = iter(torch.autograd.grad(loss, outputs, materialize_grads=True))
    found: dict[str, list[Traced]] = {}
    for name in passes:
        found[name] = []
        for passed in passes[name]:
            gradient = next(gradients)  # in the order of `outputs` above
            found[name].append(_at(_is_read(gradient), passed))
    return found


def _is_read(gradient: Tensor) -> Tensor:
    """Whether a gradient [..., d_out] is nonzero at each position, [...] bool; NaN is nonzero."""
    return gradient.abs().amax(-1).ne(0)  # takes a quarter of the time of ne(0).any(-1)


def _at(positions: Tensor, passed: Traced) -> Traced:
    return Traced(*(part[positions] for part in passed))


def charge(passed: Traced, columns: Sequence[int], price: float) -> None:
    """Add the gradient of a price on the weights of some experts to that of a pass.

    The price is

        price * mean over positions of sum_{e in columns} p_e

    over the positions at which the loss reads the map. If all positions counted, the routers could
    save the price at positions that nothing reads, and leave the weights elsewhere as they are.
    Which positions are read is known only during the backward pass, from the gradient at the map's
    output. So hooks add the gradient, and the loss has no such term.
    """
    charged = passed.weights.new_zeros(passed.weights.shape[-1])
    charged[list(columns)] = price
    # The hooks hold gradients only: holding a tensor of the graph would keep the graph alive.
    seen: list[Tensor] = []

    def see(gradient: Tensor) -> None:
        seen.append(_is_read(gradient))

    def pay(gradient: Tensor) -> Tensor:
        positions = seen.pop()
        # The derivative with respect to p_e is price / n at each of the n positions that are read.
        share = charged / positions.sum().clamp(min=1)  # [E]
        return gradient + positions.unsqueeze(-1) * share

    # The backward pass reaches the outputs first, so `see` is called before `pay`.
    passed.outputs.register_hook(see)
    passed.weights.register_hook(pay)


def squared_norm(expert: Expert) -> Tensor:
    """||B A||_F^2 = tr((B^T B)(A A^T)), from two r x r matrices instead of a d_out x d_in one."""
    columns = expert.b.T @ expert.b  # [r, r]
    rows = expert.a @ expert.a.T
    return (columns * rows).sum()  # the trace of a product of symmetric matrices


def total_variation(before: Tensor, after: Tensor) -> float:
    """Total variation distance of two distributions over experts [E], in [0, 1]."""
    moved = (before.double() - after.double()).abs()
    # Halved, because what leaves one expert arrives at another.
    return float(moved.sum() / 2)


def needed(found: Flow, kappa: float, load: float) -> tuple[int, ...]:
    """Columns of the experts that stay.

    An expert is dropped only if its mass is below kappa / E *and* its load below `load`. Mass alone
    is misleading: a router that is charged for an expert can give it little weight and let ||B A||
    grow instead, until the expert carries the fit at a weight near zero. All new experts may be
    dropped, but never all experts, since weights that sum to 1 are not all below the limit.

    Args:
        kappa: fraction of the uniform weight 1 / E.
        load: fraction of the summed load.
    """
    limit = kappa / len(found.mass)
    stay = (found.mass >= limit) | (found.load >= load)
    return tuple(i for i, stays in enumerate(stay) if stays)


def basis(matrices: Sequence[Tensor]) -> Tensor:
    """Orthonormal columns [d, k] float64 with the span of the columns of matrices [d, r]."""
    joined = torch.cat([m.detach().double() for m in matrices], dim=1)
    left, values, _ = torch.linalg.svd(joined, full_matrices=False)
    # With the clamp, matrices of zeros span nothing: no value exceeds the limit below.
    largest = values.max().clamp(min=torch.finfo(torch.float64).tiny)
    # A smaller value may be no more than the rounding of float32 experts.
    return left[:, values > 1e-6 * largest]


def without_span(matrix: Tensor, columns: Tensor) -> Tensor:
    """A matrix M [d, n] without its part in the span of `columns` Q: (I - Q Q^T) M, in M's dtype.

    Args:
        columns: orthonormal, [d, k] float64.
    """
    wide = matrix.double()
    return (wide - columns @ (columns.T @ wide)).to(matrix.dtype)
