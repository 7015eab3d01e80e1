"""Squared ReLU (So et al. 2021, arXiv 2109.08668).

On our models it performs as well as GELU, and a training step on a CPU is a sixth cheaper.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable


class _SquaredReLU(torch.autograd.Function):
    """max(x, 0)^2 with the derivative 2 max(x, 0); only max(x, 0) is saved for the backward pass.

    Forward and backward together take three quarters of the time of `relu(x).square()` on a CPU
    (3.6 against 4.8 ms at [32, 75, 768], 2 cores).
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        positive = x.clamp(min=0)
        ctx.save_for_backward(positive)
        return positive * positive

    @staticmethod
    @once_differentiable  # `positive` is not an input: a second derivative would miss its term
    # pyrefly: ignore[bad-override]: torch's has any number of them, the decorator hides a name
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (positive,) = ctx.saved_tensors
        return gradient.mul(positive).mul_(2)


def squared_relu(x: Tensor) -> Tensor:
    """max(x, 0)^2, elementwise."""
    if torch.compiler.is_compiling():
        return torch.relu(x).square()  # the compiler fuses the plain form by itself
    return _SquaredReLU.apply(x)
