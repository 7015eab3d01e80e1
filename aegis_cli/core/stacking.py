"""Several maps stacked into one, where launching a GPU kernel takes longer than running it.

Maps of one shape [o, d] are stacked to [n, o, d], and their bases with them. A basis with fewer
directions than others is padded with zeros, along which nothing is read or removed.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Sequence

import torch
from torch import Tensor

from aegis_cli.core.pairs import Pair

# Most weight entries in one stack. Larger weights keep a GPU busy by themselves.
MOST = 2**24


def groups(
    sites: Iterable[str],
    kind: Callable[[str], Hashable],
    size: Callable[[str], tuple[int, int]],
    most: int = MOST,
) -> list[list[str]]:
    """The sites in groups of one kind, each of at most `most` entries or alone.

    Args:
        kind: a site -> what must be equal within a group.
        size: a site -> the number of entries of its weight and of its directions; sites with
            similar numbers of directions are grouped, which keeps the padding small.
    """
    by_kind: dict[Hashable, list[str]] = {}
    for site in sites:
        by_kind.setdefault(kind(site), []).append(site)
    found = []
    for alike in by_kind.values():
        room = 0  # a new kind begins a new group
        for site in sorted(alike, key=lambda one: size(one)[1]):
            entries = size(site)[0]
            if entries > room:
                found.append([])
                room = most
            found[-1].append(site)
            room -= entries  # negative after a site larger than `most`, which thus stays alone
    return found


def kind_of(pair: Pair) -> Hashable:
    """What maps must have in common to be stacked."""
    weight, bias = pair
    of_bias = None if bias is None else bias.dtype
    # In a user's own loop, the layers may be spread over several GPUs.
    return _flat(weight).shape, weight.dtype, weight.device, of_bias


def stacked(pairs: Sequence[Pair]) -> Pair:
    """Maps of one shape as one, [n, o, d] and [n, o]; a single one is returned as it is."""
    if len(pairs) == 1:
        return pairs[0]
    weights = torch.stack([_flat(weight) for weight, _ in pairs])
    biases = [bias for _, bias in pairs if bias is not None]
    return weights, torch.stack(biases) if biases else None


def apart(pair: Pair, like: Sequence[Pair]) -> list[Pair]:
    """Split a result for stacked maps into one pair per map, in the map's own shape."""
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
    """Subtract from each map its part of a result for the stack, in place."""
    values, by = [], []
    for own, part in zip(pairs, apart(taken, pairs), strict=True):
        for value, difference in zip(own, part, strict=True):
            if value is not None and difference is not None:
                values.append(value.data)
                by.append(difference.to(value.dtype))
    torch._foreach_sub_(values, by)


def padded(matrices: Sequence[Tensor]) -> Tensor:
    """Matrices [d, k] or rows [k] stacked; narrower ones are padded with zeros at the end."""
    width = max(matrix.shape[-1] for matrix in matrices)
    wide = matrices[0].new_zeros(len(matrices), *matrices[0].shape[:-1], width)
    for into, matrix in zip(wide, matrices, strict=True):
        into[..., : matrix.shape[-1]] = matrix
    return wide


def rests(values: Sequence[float], like: Tensor) -> float | Tensor:
    """One number per stacked map, [n, 1]; 0 if all are 0."""
    return like.new_tensor(values)[:, None] if any(values) else 0.0
