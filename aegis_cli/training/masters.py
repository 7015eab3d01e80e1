"""Float32 weights of a backbone whose passes see them rounded to bfloat16.

Rounded to eight bits, a weight loses every step that is smaller than half the distance to its
neighbour, and an update that was projected is no longer orthogonal to anything. So the parameters
stay float32 wherever they are read or changed: in the optimizer, in the method, in a checkpoint.
Only forward and backward passes see them rounded, with half the memory and half the traffic. This
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
    """Refuse float32 master weights with sharding.

    Raises:
        AegisError: both are asked for.
    """
    if settings.weights == BF16_MASTER and settings.parallel == "fsdp" and ranks.several:
        raise AegisError(
            f"train.parallel: fsdp with train.weights: {BF16_MASTER}",
            "weights that are whole in every process",
            "--set train.weights=float32, which fsdp gathers in bfloat16 where train.precision is; "
            "or --set train.parallel=ddp",
        )


class Masters:
    """The float32 master weights, which passes see rounded to bfloat16.

    Without parameters nothing is rounded, at no cost.
    """

    def __init__(
        self, parameters: Iterable[nn.Parameter] = (), still: Iterable[nn.Parameter] = ()
    ) -> None:
        """Keep the trainable parameters, and beside them those that are rounded permanently."""
        self._parameters, self._still = list(parameters), list(still)

    @classmethod
    def of(cls, own: Iterable[nn.Parameter]) -> Masters:
        """The masters among a backbone's own parameters, once it is known which are trainable.

        Frozen parameters need no master: they are rounded here, permanently.
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
        """Bytes of the rounded weights; their gradients take the same."""
        return sum(p.numel() * BF16.itemsize for p in self._parameters)

    @contextlib.contextmanager
    def rounded(self) -> Generator[None]:
        """Let passes inside the block see the weights rounded.

        Afterwards the parameters are float32 again, with their values from before, and so are their
        gradients: those of the block's backward passes are added to the earlier ones.
        """
        # A parameter whose dtype changes must not have a gradient of the old dtype.
        before = _taken(self._parameters)
        with structure.of_type(self._parameters, BF16):
            try:
                yield
            finally:
                found = _taken(self._parameters)
        # All gradients are cast together, in few kernels, and handed out again in the same order.
        present = [gradient for gradient in found if gradient is not None]
        wide = iter(structure.of_one_type(present, torch.float32))
        for parameter, known, new in zip(self._parameters, before, found, strict=True):
            parameter.grad = _sum(known, None if new is None else next(wide))

    @contextlib.contextmanager
    def as_written(self) -> Generator[None]:
        """Let passes inside the block see all weights in float32, as a checkpoint has them.

        Outside `rounded` a model has weights of two dtypes, which no pass can use. If nothing is
        trainable, all weights are bfloat16 and stay so.
        """
        with structure.of_type(self._still if self._parameters else [], torch.float32):
            yield

    def wide(self, gradients: Mapping[int, Tensor | None]) -> Mapping[int, Tensor | None]:
        """Gradients of a `rounded` block that are not in `.grad`, cast to float32 too."""
        if not self._parameters:
            return gradients
        return {i: None if g is None else g.float() for i, g in gradients.items()}


def _taken(parameters: Iterable[nn.Parameter]) -> list[Tensor | None]:
    """Take the gradients out of the parameters."""
    found = []
    for parameter in parameters:
        found.append(parameter.grad)
        parameter.grad = None
    return found


def _sum(known: Tensor | None, found: Tensor | None) -> Tensor | None:
    """The sum of two gradients, either of which may be None."""
    if found is None or known is None:
        return found if known is None else known
    return known.add_(found)


NONE = Masters()
