"""The optimizers that a recipe asks for: its choice for the backbone, and AdamW for the expert."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from aegis_cli.common.ranks import rows_here
from aegis_cli.models.policy import Policy
from aegis_cli.recipes import Train
from aegis_cli.training import eight_bit

Groups = list[dict[str, Any]]


def make(policy: Policy, settings: Train, rate_per_parameter: bool) -> list[Optimizer]:
    """One optimizer for all that is trained; with SGD, one each for backbone and expert.

    The expert starts from random weights and learns far more slowly with SGD
    (recipes/results/LOG.md): with SGD for both, methods would be compared on policies that fail.

    Args:
        rate_per_parameter: give each of the backbone's parameters its own group.
    """
    learning = [p for p in policy.backbone.parameters() if p.requires_grad]
    parts = [[p] for p in learning] if rate_per_parameter else [learning]
    # No group may be empty, even if nothing of the backbone is trainable: a step looks up a group's
    # share of its learning rate by its first parameter.
    backbone = [_group("backbone", part, settings.backbone_lr) for part in parts if part]
    expert = [_group("expert", list(policy.expert.parameters()), settings.expert_lr)]
    if settings.optimizer == "adamw":
        return [_adamw(backbone + expert, settings)]
    if not backbone:
        return [_adamw(expert, settings)]
    return [_sgd(backbone, settings), _adamw(expert, settings)]


def state_bytes(optimizers: Sequence[Optimizer], here: bool = False) -> int:
    """Bytes of optimizer state after the first step, without counters.

    Args:
        here: for sharded weights, count only this process's rows.
    """
    total = 0
    for optimizer in optimizers:
        for group in optimizer.param_groups:
            for parameter in group["params"]:
                total += _state_bytes(group, rows_here(parameter) if here else parameter)
    return total


def _state_bytes(group: dict[str, Any], parameter: Tensor) -> int:
    if eight_bit.is_marked(group):
        return eight_bit.state_bytes(parameter)
    return _moments(group) * parameter.nbytes


def _moments(group: dict[str, Any]) -> int:
    """Numbers kept per trainable weight: AdamW's two moments, or SGD's momentum."""
    if "betas" in group:
        return 2
    return 1 if group["momentum"] else 0


def _group(name: str, parameters: list[nn.Parameter], rate: float) -> dict[str, Any]:
    # `lr` is set in each step; the schedule scales `peak`.
    return {"params": parameters, "lr": rate, "peak": rate, "name": name}


def _adamw(groups: Groups, settings: Train) -> Optimizer:
    if settings.states == eight_bit.STATES:
        return eight_bit.adamw(groups, settings)
    # Only PyTorch's fused AdamW heeds `found_inf`, with which step_figures.py stops it.
    return torch.optim.AdamW(
        groups,
        betas=settings.betas,
        eps=settings.eps,
        weight_decay=settings.weight_decay,
        fused=True,
    )


def _sgd(groups: Groups, settings: Train) -> Optimizer:
    # Not fused: that kernel fails if a parameter's first gradient comes later than the others',
    # which happens if only a projection moves it.
    return torch.optim.SGD(groups, momentum=settings.momentum, weight_decay=settings.weight_decay)
