"""What a router's weights say about a new task: where its gradient flows, which experts it needs,
what lies inside the old.

All rules here are choices of this package: of iGSP (arXiv 2605.19301) nothing but the abstract was
read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from aegis_cli.core.routing import Expert, Traced


@dataclass(frozen=True)
class Flow:
    """What a map's router does on a batch.

    Attributes:
        mass: mean weight of each expert [E] float64; sums to 1, or is all 0 where there is no
            position.
        load: share of each expert in the sum of mean p_e ||B_e A_e x|| [E] float64; all 0 where no
            expert says anything.
    """

    mass: Tensor
    load: Tensor


@torch.no_grad()
def flow(passes: Sequence[Traced], experts: Sequence[Expert]) -> Flow:
    """Mass and load of each expert over all positions of `passes`."""
    weights = torch.cat([p.weights.flatten(0, -2) for p in passes]).double()
    codes = torch.cat([p.codes.flatten(0, -3) for p in passes]).double()
    grams = torch.stack([e.b.double().T @ e.b.double() for e in experts])
    # ||B c||^2 = c^T (B^T B) c, without ever making B c [n, d_out]
    norms = torch.einsum("ner,ers,nes->ne", codes, grams, codes).clamp(min=0).sqrt()
    return Flow(_shares(weights.sum(0)), _shares((weights * norms).sum(0)))


def _shares(parts: Tensor) -> Tensor:
    """Of the sum of what is not negative; all 0 of 0. A pass in bfloat16 has weights that sum to 1
    but roughly.
    """
    return (parts / parts.sum() if parts.sum() > 0 else parts).cpu()


def read(passes: Mapping[str, Sequence[Traced]], loss: Tensor) -> dict[str, list[Traced]]:
    """The passes of each map, with the positions alone that the loss reads: [n, E], [n, E, r] and
    [n, d_out].

    It reads those at whose output its gradient is not 0. Padding, what follows a text's end, and in
    the last layers all but the token that becomes the feature say nothing of what a task needs, and
    can be nearly all there is.
    """
    outputs = [p.outputs for name in passes for p in passes[name]]
    found = iter(
        torch.autograd.grad(loss, outputs, materialize_grads=True)
    )  # 0 where the loss does not read the map at all
    return {name: [_at(_is_read(next(found)), p) for p in passes[name]] for name in passes}


def _is_read(gradient: Tensor) -> Tensor:
    """[...] bool, of a gradient [..., d_out]."""
    return (
        gradient.abs().amax(-1).ne(0)
    )  # a quarter of the time of ne(0).any(-1); NaN is not 0 either


def _at(positions: Tensor, passed: Traced) -> Traced:
    return Traced(*(part[positions] for part in passed))


def charge(passed: Traced, columns: Sequence[int], price: float) -> None:
    """Let a pass's gradient become that of the loss and of the weight on some experts, where the
    loss reads the map:

        price * mean over those positions of sum_{e in columns} p_e

    Which they are is known on the way back only, from the gradient at the map's output; hence no
    term of the loss. On all positions the routers could pay where nobody reads, and leave the
    weights where somebody does as they are.
    """
    charged = passed.weights.new_zeros(passed.weights.shape[-1])
    charged[list(columns)] = price
    seen: list[
        Tensor
        # of gradients alone: hooks that hold a tensor of the graph keep the whole graph, for good
    ] = []

    def see(gradient: Tensor) -> None:
        seen.append(_is_read(gradient))

    def pay(gradient: Tensor) -> Tensor:
        positions = seen.pop()
        return gradient + positions.unsqueeze(-1) * (charged / positions.sum().clamp(min=1))

    passed.outputs.register_hook(see)
    passed.weights.register_hook(pay)


def squared_norm(expert: Expert) -> Tensor:
    """||B A||_F^2 = tr((B^T B)(A A^T)): two r x r matrices instead of one of d_out x d_in."""
    return ((expert.b.T @ expert.b) * (expert.a @ expert.a.T)).sum()


def total_variation(before: Tensor, after: Tensor) -> float:
    """Distance of two distributions over experts [E]: half the sum of absolute differences, in [0,
    1].
    """
    return float((before.double() - after.double()).abs().sum() / 2)


def needed(found: Flow, kappa: float, load: float) -> tuple[int, ...]:
    """Columns of the experts that stay.

    One goes only if its mass is under kappa / E *and* its load under `load`. Mass alone deceives: a
    router that is paid for avoiding an expert can give it little weight and let ||B A|| grow
    instead, until the expert carries the fit at a weight near zero. Zero new experts may stay; of
    weights that sum to 1 one at least is not under the limit.

    Args:
        kappa: share of the uniform weight 1 / E.
        load: share of the summed load.
    """
    limit = kappa / len(found.mass)
    return tuple(
        i for i in range(len(found.mass)) if found.mass[i] >= limit or found.load[i] >= load
    )


def basis(matrices: Sequence[Tensor]) -> Tensor:
    """Orthonormal columns [d, k] float64 of what the columns of matrices [d, r] span together."""
    joined = torch.cat([m.detach().double() for m in matrices], dim=1)
    left, values, _ = torch.linalg.svd(joined, full_matrices=False)
    return left[:, values > values.max().clamp(min=torch.finfo(torch.float64).tiny) * 1e-6]


def off(matrix: Tensor, columns: Tensor) -> Tensor:
    """matrix [d, n] without its part in the span of orthonormal `columns` [d, k]: (I - Q Q^T) M, in
    M's own type.
    """
    wide = matrix.double()
    return (wide - columns @ (columns.T @ wide)).to(matrix.dtype)
