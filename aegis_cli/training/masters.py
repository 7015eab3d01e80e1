"""Float32 weights of a backbone whose passes see them rounded to bfloat16.

Rounded to eight bits, a weight loses every step that is smaller than half the distance to its
neighbour, and an update that was projected is no longer orthogonal to anything. So the parameters
stay float32 wherever they are read or changed: by the optimizer, by the method, in a checkpoint.
Only forward and backward passes find them rounded, in half the memory and at half the traffic. This
is mixed-precision training with master weights (Micikevicius et al. 2018, arXiv 1710.03740).
"""

from __future__ import annotations

import contextlib
from collections.abc import Generator, Iterable, Mapping

import torch
from torch import Tensor, nn

from aegis_cli.common.errors import AegisError
from aegis_cli.common.ranks import Ranks
from aegis_cli.models import structure
from aegis_cli.recipes import Train

BF16 = torch.bfloat16
BF16_MASTER = "bf16-master"  # the value of `train.weights`


def check_masters(settings: Train, ranks: Ranks) -> None:
    """Refuse float32 masters of sharded weights.

    Raises:
        AegisError: that is asked for.
    """
    if settings.weights == BF16_MASTER and settings.parallel == "fsdp" and ranks.several:
        raise AegisError(
            f"train.parallel: fsdp with train.weights: {BF16_MASTER}",
            "weights that are whole in every process",
            "--set train.weights=float32, which fsdp gathers in bfloat16 where train.precision is; "
            "or --set train.parallel=ddp",
        )


class Masters:
    """The float32 weights that passes see rounded.

    Without parameters nothing is rounded, and nothing costs anything.
    """

    def __init__(
        self, parameters: Iterable[nn.Parameter] = (), still: Iterable[nn.Parameter] = ()
    ) -> None:
        """Hold on to what learns, and beside it to what is rounded for good."""
        self._parameters, self._still = list(parameters), list(still)

    @classmethod
    def of(cls, own: Iterable[nn.Parameter]) -> Masters:
        """The masters among a backbone's own parameters, once it is known which of them learn.

        What does not learn needs no master: it is rounded here, once and for good.
        """
        learning, still = [], []
        for parameter in own:
            if parameter.requires_grad:
                learning.append(parameter)
            else:
                parameter.data = parameter.data.to(BF16)
                still.append(parameter)
        return cls(learning, still)

    @property
    def rounded_bytes(self) -> int:
        """Bytes of the rounded weights, and as many of their gradients."""
        return sum(p.numel() * BF16.itemsize for p in self._parameters)

    @contextlib.contextmanager
    def rounded(self) -> Generator[None]:
        """Let passes inside the block see the weights rounded.

        Afterwards the parameters are float32 again, with the values that they had, and so are their
        gradients: what the block's backward passes leave is added to what was there.
        """
        # A parameter that changes its type may have no gradient, which is of the same type.
        before = _taken(self._parameters)
        with structure.of_type(self._parameters, BF16):
            try:
                yield
            finally:
                found = _taken(self._parameters)
        # All of them are widened at once, in few kernels, and dealt out again in the same order.
        present = [gradient for gradient in found if gradient is not None]
        wide = iter(structure.of_one_type(present, torch.float32))
        for parameter, known, new in zip(self._parameters, before, found, strict=True):
            parameter.grad = _sum(known, None if new is None else next(wide))

    @contextlib.contextmanager
    def as_written(self) -> Generator[None]:
        """Let passes inside the block see all weights in float32, as a checkpoint has them.

        Outside `rounded` a model has two types, which no pass of its own takes. Where nothing
        learns, all are in bfloat16 and stay so.
        """
        with structure.of_type(self._still if self._parameters else [], torch.float32):
            yield

    def wide(self, gradients: Mapping[int, Tensor | None]) -> Mapping[int, Tensor | None]:
        """Gradients of the block that do not lie in `.grad`, in float32 too."""
        if not self._parameters:
            return gradients
        return {i: None if g is None else g.float() for i, g in gradients.items()}


def _taken(parameters: Iterable[nn.Parameter]) -> list[Tensor | None]:
    """The gradients, which the parameters then have no more."""
    found = []
    for parameter in parameters:
        found.append(parameter.grad)
        parameter.grad = None
    return found


def _sum(known: Tensor | None, found: Tensor | None) -> Tensor | None:
    """The sum of two gradients, as far as there are any."""
    if found is None or known is None:
        return found if known is None else known
    return known.add_(found)


NONE = Masters()
