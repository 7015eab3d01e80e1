"""Per-step record of a training run: inner products per parameter group and W2^2 per layer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from aegis_cli.core import projection
from aegis_cli.core.numerics import ratio

COLUMNS = ("tt", "ta", "aa", "w2")
_LEAST_ROWS = 64  # rows that a ledger allocates at a time, at least


@dataclass(frozen=True)
class GroupSummary:
    """One parameter group over all steps.

    Attributes:
        energy_shed_mean, energy_shed_max: fraction of the gradient's energy that the projection
            removes: cos^2 in a conflict, otherwise 0.
        conflict: fraction of the steps in which the two gradients conflict.
    """

    name: str
    energy_shed_mean: float
    energy_shed_max: float
    conflict: float


class Ledger:
    """Rows of (step, tt [G], ta [G], aa [G], w2 [L]), kept in float64 in the order of the steps.

    They are kept in buffers that double when full: one tensor per row would take ten times the
    memory of its numbers, and the ledger of a long run would take seconds to assemble.
    """

    def __init__(self, groups: Sequence[str], layers: Sequence[str]) -> None:
        self.groups = tuple(groups)
        self.layers = tuple(layers)
        self._count = 0
        self._steps = torch.zeros(0, dtype=torch.int64, device="cpu")  # [capacity]
        self._rows = {
            name: torch.zeros(0, size, dtype=torch.float64, device="cpu")
            for name, size in self._sizes().items()
        }

    @classmethod
    def from_tensors(
        cls, groups: Sequence[str], layers: Sequence[str], tensors: Mapping[str, Tensor]
    ) -> Ledger:
        """The ledger that `tensors()` came from, ready for more rows."""
        ledger = cls(groups, layers)
        steps = tensors["step"]
        if (steps.diff() <= 0).any():
            raise ValueError("steps must increase")
        for name, size in ledger._sizes().items():
            _check_shape(name, tensors[name], (len(steps), size))
        # Copies, because a memory-mapped tensor keeps its file open.
        ledger._count = len(steps)
        ledger._steps = steps.to("cpu", torch.int64, copy=True)
        ledger._rows = {name: tensors[name].to("cpu", torch.float64, copy=True) for name in COLUMNS}
        return ledger

    def __len__(self) -> int:
        return self._count

    def append(self, step: int, tt: Tensor, ta: Tensor, aa: Tensor, w2: Tensor) -> None:
        """Add one step's row; steps must increase and sizes must be [G], [G], [G], [L]."""
        if self._count:
            last = int(self._steps[self._count - 1])
            if step <= last:
                raise ValueError(f"step {step} after step {last}: steps must increase")
        row = dict(zip(COLUMNS, (tt, ta, aa, w2), strict=True))
        for name, size in self._sizes().items():
            _check_shape(name, row[name], (size,))
        if self._count == len(self._steps):
            self._grow()
        for name, value in row.items():
            self._rows[name][self._count] = value.detach()
        self._steps[self._count] = step
        self._count += 1

    def truncate(self, step: int) -> None:
        """Forget every row after `step`: a resumed run repeats those steps."""
        # The numbers stay in the buffers until `append` writes over them.
        self._count = self._rows_until(step)

    def tensors(self, after: int | None = None) -> dict[str, Tensor]:
        """`step` [S] int64; `tt`, `ta`, `aa` [S, G] and `w2` [S, L] float64.

        Args:
            after: leave out the rows up to and including this step.
        """
        first = 0 if after is None else self._rows_until(after)
        rows = slice(first, self._count)
        # Clones, because a view would keep the whole buffers, and later steps may change them.
        found = {"step": self._steps[rows].clone()}
        for name, values in self._rows.items():
            found[name] = values[rows].clone()
        return found

    def _sizes(self) -> dict[str, int]:
        """How many numbers a row of each column has."""
        return {name: len(self.layers if name == "w2" else self.groups) for name in COLUMNS}

    def _rows_until(self, step: int) -> int:
        """How many rows there are up to and including `step`."""
        # The steps increase, so a binary search finds the place.
        return int(torch.searchsorted(self._steps[: self._count], step, right=True))

    def _grow(self) -> None:
        more = max(_LEAST_ROWS, self._count)  # as many again, so that appending stays cheap
        self._steps = torch.cat([self._steps, self._steps.new_zeros(more)])
        for name, rows in self._rows.items():
            self._rows[name] = torch.cat([rows, rows.new_zeros(more, rows.shape[1])])


def _check_shape(name: str, value: Tensor, expected: tuple[int, ...]) -> None:
    if value.shape != expected:
        raise ValueError(f"'{name}' has shape {list(value.shape)}, expected {list(expected)}")


def step_energy_shed(tensors: Mapping[str, Tensor]) -> Tensor:
    """Energy shed at each step [S]: removed energy over the sum of tt, both summed over groups.

    It is 0 where that sum is 0.
    """
    removed = projection.removed_energy(tensors["ta"], tensors["aa"]).sum(1)
    return ratio(removed, tensors["tt"].sum(1))


def energy_shed_mean(tensors: Mapping[str, Tensor]) -> float:
    """Mean over steps of `step_energy_shed`; 0 for a run without steps."""
    return _mean(step_energy_shed(tensors))


def conflict_share(tensors: Mapping[str, Tensor]) -> float:
    """Fraction of (step, group) pairs whose gradients conflict; 0 for a run without steps."""
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
