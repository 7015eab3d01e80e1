"""An optimizer's state as named tensors, for a safetensors file instead of a pickle."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from aegis_cli.common.errors import AegisError
from aegis_cli.common.kinds import quoted
from aegis_cli.common.ranks import sharded_as
from aegis_cli.common.state_dicts import AS_WRITTEN, check_state
from aegis_cli.training import eight_bit

WEIGHT = "weight."  # prefix of a weight's name in a file
_OPTIMIZER = "optimizer."
STATELESS = "stateless"  # in a file's meta: trainable parameters without optimizer state
# What each optimizer keeps per parameter: a step count, and tensors of the parameter's shape.
_COUNT = "step"
_KEPT: dict[type[torch.optim.Optimizer], tuple[str, ...]] = {
    torch.optim.AdamW: (_COUNT, "exp_avg", "exp_avg_sq"),
    torch.optim.Muon: ("momentum_buffer",),
    torch.optim.SGD: ("momentum_buffer",),
}
# Squares, counts, and the scales of 8-bit codes.
_NOT_NEGATIVE = ("exp_avg_sq", _COUNT, "state2", "absmax1", "absmax2")

Optimizers = Sequence[torch.optim.Optimizer]


def to_tensors(parameters: Mapping[str, nn.Parameter], optimizers: Optimizers) -> dict[str, Tensor]:
    """The weights and every optimizer's state (moments, step counts) by parameter name."""
    name_of = {id(p): name for name, p in parameters.items()}
    tensors = {WEIGHT + name: p.detach() for name, p in parameters.items()}
    for optimizer in optimizers:
        coded = eight_bit.owns(optimizer)
        for parameter, state in optimizer.state.items():
            kept = eight_bit.to_tensors(state) if coded else state
            for key, value in kept.items():
                tensors[f"{_OPTIMIZER}{key}/{name_of[id(parameter)]}"] = value
    return tensors


def stateless(parameters: Mapping[str, nn.Parameter], optimizers: Optimizers) -> list[str]:
    """Names of the parameters without optimizer state, because they have had no gradient yet."""
    name_of = {id(p): name for name, p in parameters.items()}
    return sorted(name_of[id(p)] for o in optimizers for p in _learned(o) if p not in o.state)


def said_stateless(meta: Mapping[str, Any]) -> list[str] | None:
    """The entry `stateless` of a file's meta; None if there is none.

    Raises:
        TypeError: it is no list of names.
    """
    said = meta.get(STATELESS)
    if said is not None and not (isinstance(said, list) and all(isinstance(n, str) for n in said)):
        raise TypeError(f"'{STATELESS}' is {said!r}")
    return said


@torch.no_grad()
def from_tensors(
    tensors: Mapping[str, Tensor],
    parameters: Mapping[str, nn.Parameter],
    optimizers: Optimizers,
    source: str = "the saved state",
    without: Iterable[str] | None = None,
) -> None:
    """Restore what `to_tensors` saved; the optimizers continue as if nothing had happened.

    Args:
        source: what the tensors were read from, for errors.
        without: what `stateless` returned; None: not known, as in an earlier version's file.

    Raises:
        AegisError: the tensors do not belong to these parameters and optimizers; nothing was
            restored.
    """
    owner: dict[int, tuple[torch.optim.Optimizer, dict[str, Any]]] = {}
    for optimizer in optimizers:
        for group in optimizer.param_groups:
            for parameter in group["params"]:
                owner[id(parameter)] = optimizer, group
    states = {label for label in tensors if label.startswith(_OPTIMIZER)}
    expected = {n: p for n, p in parameters.items() if id(p) in owner}
    # Every parameter has all of its optimizer state, or none. An earlier version's file does not
    # say which have none, so a parameter whose state was lost is taken for one of those.
    has_some = {label.partition("/")[2] for label in states}
    bare = expected.keys() - has_some if without is None else set(without)
    wanted: dict[str, Tensor] = {WEIGHT + name: p for name, p in parameters.items()}
    for name, parameter in expected.items():
        if name not in bare:
            wanted |= _state_of(name, parameter, owner[id(parameter)][0])
    check_state(source, tensors, wanted)
    _check_values(source, tensors, known=without is not None, due=bool(expected))

    for name, parameter in parameters.items():
        parameter.copy_(sharded_as(tensors[WEIGHT + name].to(parameter.device), parameter))
    coded: dict[str, dict[str, Tensor]] = {}
    for label in sorted(states):
        key, name = label.removeprefix(_OPTIMIZER).split("/", 1)
        parameter = parameters[name]
        optimizer, group = owner[id(parameter)]
        if eight_bit.owns(optimizer):
            coded.setdefault(name, {})[key] = tensors[label]
            continue
        # PyTorch counts steps on the CPU, but a fused kernel reads the count on the parameter's
        # device.
        device = "cpu" if key == _COUNT and not group.get("fused") else parameter.device
        # A copy, since the file is memory-mapped and the optimizer writes into its state.
        value = tensors[label].to(device, copy=True)
        optimizer.state[parameter][key] = value if key == _COUNT else sharded_as(value, parameter)
    for name, saved in coded.items():
        eight_bit.put_back(owner[id(parameters[name])][0], parameters[name], saved)


def _state_of(
    name: str, parameter: nn.Parameter, optimizer: torch.optim.Optimizer
) -> dict[str, Tensor]:
    """The tensors that an optimizer keeps for a parameter; only their shapes and dtypes count."""
    if eight_bit.owns(optimizer):
        kept = eight_bit.kept(parameter)
        return {f"{_OPTIMIZER}{key}/{name}": tensor for key, tensor in kept.items()}
    count = torch.zeros((), dtype=torch.float32)
    return {
        f"{_OPTIMIZER}{key}/{name}": count if key == _COUNT else parameter
        for key in _KEPT[type(optimizer)]
    }


def _check_values(source: str, tensors: Mapping[str, Tensor], known: bool, due: bool) -> None:
    """Raise AegisError for values that no optimizer state can have.

    Args:
        known: whether it is known which parameters have no state.
        due: whether an optimizer needs state.
    """
    squares = tuple(f"{_OPTIMIZER}{key}/" for key in _NOT_NEGATIVE)
    negative = [n for n, t in tensors.items() if n.startswith(squares) and (t < 0).any()]
    if negative:
        raise AegisError(
            f"{source}: {quoted(negative[:1])} is negative", "squares and counts", AS_WRITTEN
        )
    if due and not known and not any(name.startswith(_OPTIMIZER) for name in tensors):
        raise AegisError(f"{source} without an optimizer's state", "one that has it", AS_WRITTEN)


def _learned(optimizer: torch.optim.Optimizer) -> list[nn.Parameter]:
    """The parameters that an optimizer updates."""
    return [p for group in optimizer.param_groups for p in group["params"]]
