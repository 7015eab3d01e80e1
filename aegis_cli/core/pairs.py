"""A map's weight and bias as one value, and operations on such pairs."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from aegis_cli.core.numerics import widened

Pair = tuple[Tensor, Tensor | None]  # a map's weight [out, ...] and bias [out]


def present(pair: Pair) -> Sequence[Tensor]:
    """The weight, and the bias if there is one."""
    weight, bias = pair
    return (weight,) if bias is None else (weight, bias)


def copied(pair: Pair) -> Pair:
    """A copy of the values, unaffected by later changes to the parameters."""
    weight, bias = pair
    copied_bias = None if bias is None else bias.detach().clone()
    return weight.detach().clone(), copied_bias


def copied_small(pair: Pair) -> Pair:
    """A copy; in bfloat16 if that is lossless, as for weights that were stored in it."""
    weight, bias = pair
    return _small(weight), None if bias is None else _small(bias)


def _small(x: Tensor) -> Tensor:
    half = x.detach().to(torch.bfloat16)
    loses_nothing = torch.equal(half.to(x.dtype), x)
    return half if loses_nothing else x.detach().clone()


def minus(a: Pair, b: Pair) -> Pair:
    """The differences a - b of weights and of biases, in float32 or wider."""
    (weight, bias), (other_weight, other_bias) = a, b
    if bias is None or other_bias is None:
        return _difference(weight, other_weight), None
    return _difference(weight, other_weight), _difference(bias, other_bias)


def _difference(a: Tensor, b: Tensor) -> Tensor:
    # In half precision the difference itself would be rounded. b is upcast by type promotion.
    return widened(a) - b


def matrix(pair: Pair) -> Tensor:
    """A map's weight [o, ...] as a matrix [o, d], with its bias as the last column."""
    weight, bias = pair
    flat = weight.flatten(1)
    return flat if bias is None else torch.cat([flat, bias[:, None]], 1)


def from_matrix(flat: Tensor, pair: Pair) -> Pair:
    """A matrix [o, d] as a weight and a bias, in the shapes, dtype and device of the pair."""
    weight, bias = pair
    width = weight[0].numel()
    flat = flat.to(weight)
    last_column = None if bias is None else flat[:, width]
    return flat[:, :width].reshape(weight.shape), last_column
