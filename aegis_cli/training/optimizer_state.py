"""An optimizer's state as named tensors, for a safetensors file instead of a pickle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

_OPTIMIZER, _WEIGHT = "optimizer.", "weight."


def to_tensors(
    parameters: Mapping[str, nn.Parameter], optimizers: Sequence[torch.optim.Optimizer]
) -> dict[str, Tensor]:
    """The weights and every optimizer's state (moments, step counts) by parameter name."""
    name_of = {id(p): name for name, p in parameters.items()}
    tensors = {_WEIGHT + name: p.detach() for name, p in parameters.items()}
    for optimizer in optimizers:
        for parameter, state in optimizer.state.items():
            for key, value in state.items():
                tensors[f"{_OPTIMIZER}{key}/{name_of[id(parameter)]}"] = value
    return tensors


@torch.no_grad()
def from_tensors(
    tensors: Mapping[str, Tensor],
    parameters: Mapping[str, nn.Parameter],
    optimizers: Sequence[torch.optim.Optimizer],
) -> None:
    """Put back what `to_tensors` took; the optimizers go on as if nothing had happened."""
    for name, parameter in parameters.items():
        parameter.copy_(tensors[_WEIGHT + name])
    owner = {
        id(p): (o, group) for o in optimizers for group in o.param_groups for p in group["params"]
    }
    for label, value in tensors.items():
        if label.startswith(_OPTIMIZER):
            key, name = label.removeprefix(_OPTIMIZER).split("/", 1)
            parameter = parameters[name]
            optimizer, group = owner[id(parameter)]
            # PyTorch counts steps on the CPU, but a fused kernel reads the count where the
            # parameter is.
            device = "cpu" if key == "step" and not group.get("fused") else parameter.device
            optimizer.state[parameter][key] = value.to(device, copy=True)
