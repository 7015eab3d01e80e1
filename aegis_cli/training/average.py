"""An exponential moving average of the weights, which checkpoints hold if the recipe asks for it.

The weights of a flow-matching policy jitter with the noise of their batches, and their average acts
more steadily: diffusion policies and openpi's pi0 are evaluated with it. Training itself continues
from the raw weights. A checkpoint's backbone and expert are the average, and the validation loss is
computed with it; the training state holds both.
"""

from __future__ import annotations

import contextlib
from collections.abc import Generator, Mapping

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from aegis_cli.common.errors import AegisError
from aegis_cli.common.ranks import rows_here, sharded_as
from aegis_cli.common.state_dicts import check_state
from aegis_cli.training.masters import BF16_MASTER


class Average:
    """The average of the weights after every step; without parameters it does nothing.

    After step n the average moves by 1 - d towards the weights, where d is the smaller of the decay
    and (1 + n) / (10 + n). So it forgets its initial value sooner than with the decay alone: the
    action expert starts from random weights.

    Attributes:
        weights: the averages by parameter name, sharded like the parameters.
    """

    def __init__(self, parameters: Mapping[str, nn.Parameter] | None = None, decay: float = 0.0):
        """Start the average at the current weights.

        Raises:
            AegisError: weights are narrower than float32, in which small steps would be lost.
        """
        self._parameters = dict(parameters or {})
        self._decay = decay
        self._step: int | Tensor = 0
        narrow = [name for name, p in self._parameters.items() if p.dtype != torch.float32]
        if narrow:
            raise AegisError(
                f"train.ema_decay: {decay:g} with weights in half precision, '{narrow[0]}' first "
                f"of {len(narrow)}",
                "weights in float32: an average moves by less than half precision can hold",
                f"--set train.weights={BF16_MASTER} or float32; or --set train.ema_decay=null",
            )
        self.weights = {name: p.detach().clone() for name, p in self._parameters.items()}

    @torch.no_grad()
    def follow(self, step: int | Tensor) -> None:
        """Move towards the weights after `step` steps; does nothing if that was already done.

        Steps that a method constrains together count individually, each with the constrained
        weights.

        Args:
            step: a float64 tensor [] if reading it would wait for the GPU.
        """
        waited = step - self._step
        if not self._parameters or (not isinstance(waited, Tensor) and waited <= 0):
            return
        decay = self._decay_after(step) ** waited
        # In place through the local rows: the average stays sharded like the weights.
        means = [rows_here(mean) for mean in self.weights.values()]
        now = [rows_here(p) for p in self._parameters.values()]
        if isinstance(decay, Tensor):
            # After a step that moved nothing `waited` is 0, the decay 1, and the mean stays.
            torch._foreach_lerp_(means, now, [(1 - decay).float()] * len(means))
        else:
            get_ema_multi_avg_fn(decay)(means, now, None)
        self._step = step

    def _decay_after(self, step: int | Tensor) -> float | Tensor:
        """The decay factor of the last of `step` steps."""
        early = (1 + step) / (10 + step)
        if isinstance(early, Tensor):
            return early.clamp(max=self._decay)
        return min(self._decay, early)

    def check(self, tensors: Mapping[str, Tensor], source: str) -> None:
        """Raise AegisError if `tensors` are not an average of these weights."""
        check_state(source, tensors, self._parameters)

    @torch.no_grad()
    def put_back(self, step: int, tensors: Mapping[str, Tensor]) -> None:
        """Restore the average after `step` steps."""
        for name, mean in self.weights.items():
            mean.copy_(sharded_as(tensors[name].to(mean.device), mean))
        self._step = step

    @contextlib.contextmanager
    def in_place(self) -> Generator[None]:
        """Give the parameters the average's values inside the block, and their own after it."""
        self._exchange()
        try:
            yield
        finally:
            self._exchange()

    @torch.no_grad()
    def _exchange(self) -> None:
        """Swap the values of parameters and averages, one parameter at a time.

        Values are swapped in place: the optimizer, compiled passes and FSDP hold references to the
        memory.
        """
        for name, parameter in self._parameters.items():
            own, mean = rows_here(parameter), rows_here(self.weights[name])
            kept = own.clone()
            own.copy_(mean)
            mean.copy_(kept)
