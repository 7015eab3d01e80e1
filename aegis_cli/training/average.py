"""An exponential moving average of the weights; where it is asked for, checkpoints hold it.

The weights of a flow-matching policy jitter with the noise of their batches, and their average
acts more steadily: diffusion policies and openpi's pi0 are used by it. Training itself goes on from
the weights as they are. A checkpoint's backbone and expert are the average, and so is what the
validation loss is taken of; the training state has both.
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
    and (1 + n) / (10 + n). So it forgets where it began sooner than its decay alone would let it:
    the action expert begins as noise.

    Attributes:
        weights: the average by the parameters' names, sharded as they are.
    """

    def __init__(self, parameters: Mapping[str, nn.Parameter] | None = None, decay: float = 0.0):
        """Begin with the weights as they are.

        Raises:
            AegisError: weights that are narrower than float32, in which small steps are lost.
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
        """Move towards the weights after `step` steps; nothing changes where that was done.

        Steps that a method constrains together count one by one, each with the constrained weights.

        Args:
            step: a tensor [] float64 where to read it would be to wait.
        """
        waited = step - self._step
        if not self._parameters or (not isinstance(waited, Tensor) and waited <= 0):
            return
        decay = self._decay_after(step) ** waited
        # In place through the local rows: the average stays sharded as the weights are.
        means = [rows_here(mean) for mean in self.weights.values()]
        now = [rows_here(p) for p in self._parameters.values()]
        if isinstance(decay, Tensor):
            # After a step that moved nothing `waited` is 0, the decay 1, and the mean stays.
            torch._foreach_lerp_(means, now, [(1 - decay).float()] * len(means))
        else:
            get_ema_multi_avg_fn(decay)(means, now, None)
        self._step = step

    def _decay_after(self, step: int | Tensor) -> float | Tensor:
        """What one step leaves of the average, the last of `step` steps."""
        early = (1 + step) / (10 + step)
        if isinstance(early, Tensor):
            return early.clamp(max=self._decay)
        return min(self._decay, early)

    def check(self, tensors: Mapping[str, Tensor], source: str) -> None:
        """Raise AegisError for what cannot be put back, being no average of these weights."""
        check_state(source, tensors, self._parameters)

    @torch.no_grad()
    def put_back(self, step: int, tensors: Mapping[str, Tensor]) -> None:
        """Go on from the average after `step` steps."""
        for name, mean in self.weights.items():
            mean.copy_(sharded_as(tensors[name].to(mean.device), mean))
        self._step = step

    @contextlib.contextmanager
    def in_place(self) -> Generator[None]:
        """Let the parameters have the average's values inside the block, and their own after it."""
        self._exchange()
        try:
            yield
        finally:
            self._exchange()

    @torch.no_grad()
    def _exchange(self) -> None:
        """Give the parameters the average's values and the average theirs, one by one.

        Values are swapped in place: the optimizer, compiled passes and FSDP hold on to the memory.
        """
        for name, parameter in self._parameters.items():
            own, mean = rows_here(parameter), rows_here(self.weights[name])
            kept = own.clone()
            own.copy_(mean)
            mean.copy_(kept)
