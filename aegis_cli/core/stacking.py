"""Several maps treated as one, where to start a product takes longer than to make it.

A GPU runs thousands of small products in less time than a processor needs to start them. Maps of
one shape [o, d] are stacked to [n, o, d], and their bases with them. Of these some have fewer
directions than others: zeros stand for what they lack, along which nothing is read or taken.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Sequence

import torch
from torch import Tensor

from aegis_cli.core.pairs import Pair

# Weights that are stacked at once. Larger ones keep a GPU busy by themselves.
MOST = 2**24


def groups(
    sites: Iterable[str],
    kind: Callable[[str], Hashable],
    size: Callable[[str], tuple[int, int]],
    most: int = MOST,
) -> list[list[str]]:
    """The sites in groups of one kind, each of at most `most` entries or alone.

    Args:
        kind: what has to be equal within a group.
        size: a site -> the entries of its weight, and how many directions it has; those with alike
            numbers come together, so that few zeros are added.
    """
    by_kind: dict[Hashable, list[str]] = {}
    for site in sites:
        by_kind.setdefault(kind(site), []).append(site)
    found = []
    for alike in by_kind.values():
        room = 0
        for site in sorted(alike, key=lambda one: size(one)[1]):
            entries = size(site)[0]
            if entries > room:
                found.append([])
                room = most
            found[-1].append(site)
            room -= entries
    return found


def kind_of(pair: Pair) -> Hashable:
    """What maps have in common that can be stacked."""
    weight, bias = pair
    of_bias = None if bias is None else bias.dtype
    # A loop of somebody else's may have its layers on several GPUs.
    return _flat(weight).shape, weight.dtype, weight.device, of_bias


def stacked(pairs: Sequence[Pair]) -> Pair:
    """Maps of one shape as one, [n, o, d] and [n, o]; a single one stays as it is."""
    if len(pairs) == 1:
        return pairs[0]
    weights = torch.stack([_flat(weight) for weight, _ in pairs])
    biases = [bias for _, bias in pairs if bias is not None]
    return weights, torch.stack(biases) if biases else None


def apart(pair: Pair, like: Sequence[Pair]) -> list[Pair]:
    """What was computed of stacked maps, of each by itself and in its shape."""
    if len(like) == 1:
        return [pair]
    weights, biases = pair
    parts = weights.contiguous().unbind()
    of_bias = [None] * len(like) if biases is None else biases.contiguous().unbind()
    found = []
    for weight, bias, (own, _) in zip(parts, of_bias, like, strict=True):
        found.append((weight.view(own.shape), bias))
    return found


def _flat(weight: Tensor) -> Tensor:
    """A map's weight [o, d], or a normalisation's [D]."""
    return weight.flatten(1) if weight.ndim > 1 else weight


@torch.no_grad()
def subtract(pairs: Sequence[Pair], taken: Pair) -> None:
    """Take what was computed of stacked maps out of the maps, in place."""
    values, by = [], []
    for own, part in zip(pairs, apart(taken, pairs), strict=True):
        for value, difference in zip(own, part, strict=True):
            if value is not None and difference is not None:
                values.append(value.data)
                by.append(difference.to(value.dtype))
    torch._foreach_sub_(values, by)


def padded(matrices: Sequence[Tensor]) -> Tensor:
    """Matrices [d, k] or rows [k] stacked; the narrower ones end with zeros."""
    width = max(matrix.shape[-1] for matrix in matrices)
    wide = matrices[0].new_zeros(len(matrices), *matrices[0].shape[:-1], width)
    for into, matrix in zip(wide, matrices, strict=True):
        into[..., : matrix.shape[-1]] = matrix
    return wide


def rests(values: Sequence[float], like: Tensor) -> float | Tensor:
    """A number of each stacked map, [n, 1]; 0 where all are 0."""
    return like.new_tensor(values)[:, None] if any(values) else 0.0
