"""bitsandbytes' AdamW, whose moments take one byte each (Dettmers et al. 2022, arXiv 2110.02861).

Moments are kept as 8-bit codes, with a scale for each block of them, and computed in float32. Those
of small parameters stay float32. The tables that map codes to values are not saved in checkpoints,
since the library makes them anew.
"""

from __future__ import annotations

import importlib.util
import logging
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from aegis_cli.common.errors import AegisError
from aegis_cli.common.ranks import Ranks
from aegis_cli.recipes import Train

STATES = "8bit"  # the value of `train.states`, and a mark in each group of parameters
_COUNT = "step"
_SMALLEST = 4096  # the fewest entries of a parameter whose moments are codes
_BLOCK = 256  # entries that share a scale
_TABLES = {"qmap1": "dynamic", "qmap2": "udynamic"}  # of a state -> of the optimizer


def check(settings: Train, ranks: Ranks) -> None:
    """Refuse 8-bit states if they are not possible.

    Raises:
        AegisError: another optimizer, sharded weights, or no bitsandbytes.
    """
    if settings.states != STATES:
        return
    float32 = "--set train.states=float32"
    if settings.optimizer != "adamw":
        found = f"train.states: {STATES} with train.optimizer: {settings.optimizer}"
        raise AegisError(found, "the optimizer adamw", float32)
    if settings.parallel == "fsdp" and ranks.several:
        raise AegisError(
            f"train.states: {STATES} with train.parallel: fsdp",
            "weights that are whole in every process",
            f"{float32}, or train.parallel=ddp",
        )
    if importlib.util.find_spec("bitsandbytes") is None:
        raise AegisError(
            f"train.states: {STATES}, and no package 'bitsandbytes'",
            "the extra 'low-memory'",
            f"pip install 'aegis-vla[low-memory]', or {float32}",
        )


def adamw(groups: list[dict[str, Any]], settings: Train) -> Optimizer:
    """The 8-bit AdamW of these parameter groups, each of which is marked."""
    # The library warns of a kernel that has nothing to do with optimizers.
    logging.getLogger("bitsandbytes").setLevel(logging.ERROR)
    from bitsandbytes.optim import AdamW8bit

    marked = [{**group, "states": STATES} for group in groups]
    return AdamW8bit(
        marked,
        betas=settings.betas,
        eps=settings.eps,
        weight_decay=settings.weight_decay,
        min_8bit_size=_SMALLEST,
    )


def is_marked(group: dict[str, Any]) -> bool:
    """Whether a group's optimizer is this one."""
    return group.get("states") == STATES


def owns(optimizer: Optimizer) -> bool:
    """Whether an optimizer is this one."""
    return any(is_marked(group) for group in optimizer.param_groups)


def kept(parameter: Tensor) -> dict[str, Tensor]:
    """A parameter's state as a checkpoint holds it: shapes and dtypes only."""
    coded = parameter.numel() >= _SMALLEST
    kind = torch.uint8 if coded else torch.float32
    moment = torch.empty_like(parameter, dtype=kind, device="meta")
    found = {_COUNT: torch.empty((), device="meta"), "state1": moment, "state2": moment}
    if coded:
        blocks = -(-parameter.numel() // _BLOCK)  # rounded up: the last one may be short
        scales = torch.empty(blocks, device="meta")
        found |= {"absmax1": scales, "absmax2": scales}
    return found


def state_bytes(parameter: Tensor) -> int:
    """Bytes of a parameter's state, without the step count."""
    return sum(tensor.nbytes for name, tensor in kept(parameter).items() if name != _COUNT)


def to_tensors(state: dict[str, Any]) -> dict[str, Tensor]:
    """A parameter's state as a checkpoint holds it; the library's step count is a plain number."""
    found = {name: value for name, value in state.items() if name not in _TABLES}
    return {**found, _COUNT: torch.tensor(float(state[_COUNT]))}


def put_back(optimizer: Any, parameter: nn.Parameter, saved: dict[str, Tensor]) -> None:
    """Give the optimizer a parameter's state, as saved by `to_tensors`."""
    device = parameter.device
    state: dict[str, Any] = {n: t.to(device, copy=True) for n, t in saved.items()}
    state[_COUNT] = int(saved[_COUNT])
    if state["state1"].dtype == torch.uint8:
        for name, table in _TABLES.items():
            optimizer.name2qmap[table] = optimizer.name2qmap[table].to(device)
            state[name] = optimizer.name2qmap[table]
    optimizer.state[parameter] = state
