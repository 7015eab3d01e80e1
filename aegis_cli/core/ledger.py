"""The ledger of a training: at each step every group's inner products and every layer's W2^2."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from aegis_cli.core import projection

COLUMNS = ("tt", "ta", "aa", "w2")


@dataclass(frozen=True)
class GroupSummary:
    """One parameter group over all steps.

    Attributes:
        energy_shed_mean, energy_shed_max: share of the gradient's energy that the projection
            removes, cos^2 in a conflict and else 0.
        conflict: share of the steps in which the two gradients conflict.
    """

    name: str
    energy_shed_mean: float
    energy_shed_max: float
    conflict: float


class Ledger:
    """Rows of (step, tt [G], ta [G], aa [G], w2 [L]), kept in float64 in the order of the steps."""

    def __init__(self, groups: Sequence[str], layers: Sequence[str]) -> None:
        self.groups = tuple(groups)
        self.layers = tuple(layers)
        self._steps: list[int] = []
        self._rows: dict[str, list[Tensor]] = {name: [] for name in COLUMNS}

    @classmethod
    def from_tensors(
        cls, groups: Sequence[str], layers: Sequence[str], tensors: Mapping[str, Tensor]
    ) -> Ledger:
        """The ledger that `tensors()` came from, ready for more rows."""
        ledger = cls(groups, layers)
        for i, step in enumerate(tensors["step"].tolist()):
            ledger.append(step, *(tensors[name][i] for name in COLUMNS))
        return ledger

    def __len__(self) -> int:
        return len(self._steps)

    def append(self, step: int, tt: Tensor, ta: Tensor, aa: Tensor, w2: Tensor) -> None:
        """Add one step's row; steps must increase and sizes must be [G], [G], [G], [L]."""
        if self._steps and step <= self._steps[-1]:
            raise ValueError(f"step {step} after step {self._steps[-1]}: steps must increase")
        sizes = (len(self.groups),) * 3 + (len(self.layers),)
        for name, value, size in zip(COLUMNS, (tt, ta, aa, w2), sizes, strict=True):
            if value.shape != (size,):
                raise ValueError(f"'{name}' has shape {list(value.shape)}, expected [{size}]")
        for name, value in zip(COLUMNS, (tt, ta, aa, w2), strict=True):
            # A copy, because the caller may reuse its buffer, and a memory-mapped row would keep
            # its file open.
            self._rows[name].append(value.detach().to("cpu", torch.float64, copy=True))
        self._steps.append(step)

    def truncate(self, step: int) -> None:
        """Forget every row after `step`: a resumed run repeats those steps."""
        keep = sum(s <= step for s in self._steps)
        del self._steps[keep:]
        for rows in self._rows.values():
            del rows[keep:]

    def tensors(self) -> dict[str, Tensor]:
        """`step` [S] int64; `tt`, `ta`, `aa` [S, G] and `w2` [S, L] float64."""
        found = {"step": torch.tensor(self._steps, dtype=torch.int64)}
        for name, values in self._rows.items():
            if values:
                found[name] = torch.stack(values)
            else:
                width = len(self.layers) if name == "w2" else len(self.groups)
                found[name] = torch.zeros(0, width, dtype=torch.float64)
        return found


def step_energy_shed(tensors: Mapping[str, Tensor]) -> Tensor:
    """Energy shed at each step [S]: removed energy over the sum of tt, both summed over groups.

    It is 0 where that sum is 0.
    """
    removed = projection.removed_energy(tensors["ta"], tensors["aa"]).sum(1)
    return projection.ratio(removed, tensors["tt"].sum(1))


def energy_shed_mean(tensors: Mapping[str, Tensor]) -> float:
    """Mean over steps of `step_energy_shed`; 0 for a run without steps."""
    return _mean(step_energy_shed(tensors))


def conflict_share(tensors: Mapping[str, Tensor]) -> float:
    """Share of all (step, group) pairs whose gradients conflict; 0 for a run without steps."""
    return _mean(projection.conflict(tensors["ta"]))


def summarize_groups(groups: Sequence[str], tensors: Mapping[str, Tensor]) -> list[GroupSummary]:
    """One summary per group, in the order of `groups`."""
    shed = projection.energy_shed(tensors["tt"], tensors["ta"], tensors["aa"])  # [S, G]
    conflicts = projection.conflict(tensors["ta"])
    summaries = []
    for i, name in enumerate(groups):
        of_group = shed[:, i]
        most = float(of_group.max()) if len(shed) else 0.0
        summaries.append(GroupSummary(name, _mean(of_group), most, _mean(conflicts[:, i])))
    return summaries


def _mean(values: Tensor) -> float:
    return float(values.double().mean()) if values.numel() else 0.0
