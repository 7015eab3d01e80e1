"""An optimizer's step on float32 master weights, if a program keeps the weights in half precision.

Programs such as LeRobot load a VLM in bfloat16. Its parameters keep that dtype for the program's
passes. Within a step they are float32, with float32 gradients; the masters are part of the
optimizer's state, so that a resumed run has them.
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
    """The half-precision parameters of an optimizer, which have float32 masters."""

    def __init__(self, optimizer: Optimizer, parameters: Iterable[Tensor]) -> None:
        self._optimizer = optimizer
        self._half: list[Tensor] = []
        for parameter in parameters:
            if parameter.dtype not in _WIDE:
                self._half.append(parameter)

    @contextlib.contextmanager
    def taken(self) -> Generator[None]:
        """Replace the parameters by their masters inside the block, and round them back afterwards.

        A parameter that was changed since the last step gets a new master from its current value.

        Raises:
            AegisError: there are several processes: DistributedDataParallel would no longer see the
                gradients of parameters whose dtype has changed.
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
            # A gradient must have its parameter's dtype, so it is detached while that changes.
            gradient, parameter.grad = parameter.grad, None
            parameter.data = master
            parameter.grad = None if gradient is None else gradient.float()
        try:
            yield
        finally:
            for parameter, values, gradient in zip(self._half, narrow, given, strict=True):
                master = parameter.data
                parameter.grad = None
                parameter.data = values.copy_(master)  # in place: the program may hold a view
                parameter.grad = gradient
                # The optimizer initialises only an empty state, so nothing may be there before.
                if state := self._optimizer.state.get(parameter):
                    state[MASTER] = master

    def _masters(self) -> list[Tensor]:
        """Each parameter's master from the last step, or a new one."""
        known = []
        for parameter in self._half:
            known.append(self._optimizer.state.get(parameter, {}).get(MASTER))
        same = self._rounded_alike(known)
        found = []
        for parameter, master, stays in zip(self._half, known, same, strict=True):
            found.append(master if stays else parameter.data.float())
        return found

    def _rounded_alike(self, masters: Sequence[Tensor | None]) -> list[bool]:
        """Whether each parameter equals its rounded master, in one transfer from the device."""
        if not masters:
            return []
        flags = []
        for parameter, master in zip(self._half, masters, strict=True):
            if master is None:
                flags.append(torch.zeros((), dtype=torch.bool, device=parameter.device))
            else:
                flags.append((master.to(parameter.dtype) == parameter.data).all())
        # The program may have spread its layers over several GPUs.
        return torch.stack([flag.to(flags[0].device) for flag in flags]).tolist()


@contextlib.contextmanager
def loading(optimizer: Optimizer, state: Mapping[str, Any]) -> Generator[None]:
    """Make parameters with masters float32 while their state is loaded.

    PyTorch casts a loaded state to the dtype of its parameter.
    """
    ordered = [p for group in optimizer.param_groups for p in group["params"]]
    numbers = [number for group in state["param_groups"] for number in group["params"]]
    wide: list[nn.Parameter] = []
    # Not strict: PyTorch itself raises an error for a state with other groups.
    for number, parameter in zip(numbers, ordered, strict=False):
        if MASTER in state["state"].get(number, {}):
            wide.append(parameter)
    with structure.of_type(wide, torch.float32):
        yield
