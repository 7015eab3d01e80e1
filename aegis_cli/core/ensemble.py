"""Temporal ensembling: each action is a weighted mean over all chunks that have predicted it.

Zhao, Kumar, Levine, Finn: Learning Fine-Grained Bimanual Manipulation with Low-Cost Hardware
(arXiv 2304.13705), Algorithm 2. A chunk of H actions is predicted at every step. With the n <= H
predictions A_t[0..n-1] of the action at step t, oldest first, the executed action is

    a_t = sum_i w_i A_t[i] / sum_i w_i,    w_i = exp(-m i).

So with m > 0 the oldest prediction weighs most, with m = 0 all weigh alike, and with m < 0 the
newest weighs most.
"""

from __future__ import annotations

import math
from collections import deque

import torch
from torch import Tensor

from aegis_cli.common.errors import AegisError


def check(decay: float) -> None:
    """Raise AegisError for a decay that is not finite."""
    if not math.isfinite(decay):
        raise AegisError(
            f"a temporal ensemble with decay {decay}", "a finite number", "use e.g. 0.01"
        )


class TemporalEnsemble:
    """The predictions of one episode, or of several in step with each other.

    Args:
        decay: m; ACT uses 0.01.

    Raises:
        AegisError: it is not finite.
    """

    def __init__(self, decay: float) -> None:
        check(decay)
        self._decay = decay
        self._chunks: deque[Tensor] = deque()  # the oldest first

    def reset(self) -> None:
        """Begin an episode."""
        self._chunks.clear()

    def next(self, chunk: Tensor) -> Tensor:
        """The action [..., A] of the current step.

        Args:
            chunk: [..., H, A], predicted at this step; every step of an episode must pass one.
        """
        # The oldest of H chunks ends at the step before this one.
        if len(self._chunks) == chunk.shape[-2]:
            self._chunks.popleft()
        self._chunks.append(chunk)
        # A chunk that was predicted `age` steps ago has this step's action at index `age`.
        ages = range(len(self._chunks) - 1, -1, -1)
        found = []
        for age, predicted in zip(ages, self._chunks, strict=True):
            found.append(predicted[..., age, :])
        predictions = torch.stack(found)  # [n, ..., A], the oldest first
        # The softmax is the same quotient, and stays finite for any decay.
        order = torch.arange(len(predictions), dtype=torch.float64, device=predictions.device)
        weights = torch.softmax(-self._decay * order, 0)
        return torch.tensordot(weights, predictions.double(), dims=1).to(chunk.dtype)
