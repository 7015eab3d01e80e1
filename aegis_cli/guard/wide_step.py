"""An optimizer's step on float32 masters of weights that somebody else keeps in half precision.

Programs such as LeRobot load a VLM in bfloat16. Its parameters stay as they are for the program's
passes. Within a step they are float32, with float32 gradients; the masters are part of the
optimizer's state, so that a resumed training has them.
"""

from __future__ import annotations

import contextlib
from collections.abc import Generator, Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from aegis_cli.common.errors import AegisError
from aegis_cli.guard import process_groups
from aegis_cli.models import structure

MASTER = "aegis_master"  # in a parameter's state: its value in float32
_WIDE = (torch.float32, torch.float64)


class WideStep:
    """The parameters of an optimizer that have masters: those in half precision among some."""

    def __init__(self, optimizer: Optimizer, parameters: Iterable[Tensor]) -> None:
        self._optimizer = optimizer
        self._half: list[Tensor] = []
        for parameter in parameters:
            if parameter.dtype not in _WIDE:
                self._half.append(parameter)

    @contextlib.contextmanager
    def taken(self) -> Generator[None]:
        """Let the parameters be their masters inside the block, and then those rounded.

        A parameter that somebody has changed since has its master anew, from what it is now.

        Raises:
            AegisError: several processes, whose DistributedDataParallel would no longer see the
                gradients of parameters that have been of another type.
        """
        if self._half and process_groups.count() > 1:
            raise AegisError(
                f"weights in {str(self._half[0].dtype).removeprefix('torch.')} in one of "
                f"{process_groups.count()} processes",
                "float32 weights, or one process",
                "load the model in float32",
            )
        narrow = [p.data for p in self._half]
        given = [p.grad for p in self._half]
        for parameter, master in zip(self._half, self._masters(), strict=True):
            # A gradient has its parameter's type, so that it is taken off while that changes.
            gradient, parameter.grad = parameter.grad, None
            parameter.data = master
            parameter.grad = None if gradient is None else gradient.float()
        try:
            yield
        finally:
            for parameter, values, gradient in zip(self._half, narrow, given, strict=True):
                master = parameter.data
                parameter.grad = None
                parameter.data = values.copy_(master)  # where the program may hold a view of it
                parameter.grad = gradient
                # The optimizer fills an empty state by itself, so nothing may be there before.
                if state := self._optimizer.state.get(parameter):
                    state[MASTER] = master

    def _masters(self) -> list[Tensor]:
        """Each parameter's master, as the last step left it."""
        known = []
        for parameter in self._half:
            known.append(self._optimizer.state.get(parameter, {}).get(MASTER))
        same = self._rounded_alike(known)
        found = []
        for parameter, master, stays in zip(self._half, known, same, strict=True):
            found.append(master if stays else parameter.data.float())
        return found

    def _rounded_alike(self, masters: Sequence[Tensor | None]) -> list[bool]:
        """Whether each parameter is its master rounded, by one transfer from the device."""
        if not masters:
            return []
        flags = []
        for parameter, master in zip(self._half, masters, strict=True):
            if master is None:
                flags.append(torch.zeros((), dtype=torch.bool, device=parameter.device))
            else:
                flags.append((master.to(parameter.dtype) == parameter.data).all())
        # The program may have its layers on several GPUs.
        return torch.stack([flag.to(flags[0].device) for flag in flags]).tolist()


@contextlib.contextmanager
def loading(optimizer: Optimizer, state: Mapping[str, Any]) -> Generator[None]:
    """Let parameters with masters be float32 while their state is loaded.

    PyTorch casts what it loads to the type of the parameter.
    """
    ordered = [p for group in optimizer.param_groups for p in group["params"]]
    numbers = [number for group in state["param_groups"] for number in group["params"]]
    wide: list[nn.Parameter] = []
    # Not strict: PyTorch has an error of its own for a state of other groups.
    for number, parameter in zip(numbers, ordered, strict=False):
        if MASTER in state["state"].get(number, {}):
            wide.append(parameter)
    with structure.of_type(wide, torch.float32):
        yield
