"""What the method did at every step: the inner products of each parameter group and W2 of each
layer.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from aegis_cli.core import projection

COLUMNS = ("tt", "ta", "aa", "w2")


@dataclass(frozen=True)
class GroupSummary:
    """One group over all steps: its energy shed (cos^2 where in conflict) and the share of steps in
    conflict.
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
            # a copy: the caller may reuse its buffer, and a memory-mapped row would pin its file
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
        widths = dict.fromkeys(COLUMNS, len(self.groups)) | {"w2": len(self.layers)}
        rows = {
            name: torch.stack(values)
            if values
            else torch.zeros(0, widths[name], dtype=torch.float64)
            for name, values in self._rows.items()
        }
        return {"step": torch.tensor(self._steps, dtype=torch.int64), **rows}


def step_energy_shed(tensors: Mapping[str, Tensor]) -> Tensor:
    """Each step's energy shed [S]: removed energy summed over groups, over the sum of tt (0 where
    that is 0).
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
    """One summary a group, in the order of `groups`."""
    shed = projection.energy_shed(tensors["tt"], tensors["ta"], tensors["aa"])
    conflicts = projection.conflict(tensors["ta"])
    return [
        GroupSummary(
            name,
            _mean(shed[:, i]),
            float(shed[:, i].max()) if len(shed) else 0.0,
            _mean(conflicts[:, i]),
        )
        for i, name in enumerate(groups)
    ]


def _mean(values: Tensor) -> float:
    return float(values.double().mean()) if values.numel() else 0.0
