"""Losses, norms and ledger rows of the last steps, kept on the device until they are read.

Reading a number from a GPU is a *sync*: the program waits for all queued work, and then the GPU
idles. So on a GPU the figures of `train.log_every` steps are read at once. Still, a step whose
figures are not finite must not update the weights: a flag on the device tells the optimizers to
skip that step and those after it, until the figures are read. A counter on the device tells the
method and the weights' average how many steps have updated the weights.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.optim import Optimizer

from aegis_cli.common import devices
from aegis_cli.methods.base import Parts
from aegis_cli.training.step import LedgerRow, StepGradients


@dataclass(frozen=True)
class StepFigures:
    """The figures of one step, on the CPU.

    Attributes:
        index: of the step, from 0.
        checked: what has to be finite, by name. It includes the ledger's row: W2 can overflow
            before the loss does.
        row: of the ledger, float64; None for a method that reads no anchor gradient.
    """

    index: int
    checked: dict[str, float]
    row: LedgerRow | None

    @property
    def finite(self) -> bool:
        return all(map(math.isfinite, self.checked.values()))


@dataclass
class UnreadFigures:
    """Figures of steps that have not been read yet.

    Attributes:
        deferred: whether reading them is deferred.
        moves: 1 if the step noted last updates the weights, 0 from the first non-finite step on, []
            float64; None if nothing is deferred, since such a step then ends the run.
        moved: how many steps have updated the weights since the run began, once the optimizers have
            taken the one noted last; [] float64 if reading is deferred.
    """

    deferred: bool = False
    moves: Tensor | None = None
    moved: int | Tensor = 0
    _steps: list[tuple[int, Tensor, list[int]]] = field(default_factory=list)
    _broken: Tensor | None = None

    @classmethod
    def of(
        cls, device: torch.device, optimizers: Sequence[Optimizer], parts: Parts, sharded: bool
    ) -> UnreadFigures:
        """Defer reading on a GPU, unless a non-finite step would then update the weights.

        AdamW's fused kernel can be told to skip a step; other optimizers, and AdamW with sharded
        weights, cannot. A method that constrains the update by the anchor gradient would change the
        weights itself. A method that reuses an anchor gradient would have taken a new one by the
        time figures are read, and the last good step's checkpoint would hold that one.
        """
        told = all(isinstance(o, torch.optim.AdamW) for o in optimizers) and not sharded
        itself = parts.penalty is not None and parts.constrain is not None
        reuses = parts.refresh > 1
        return cls(deferred=devices.reading_stalls(device) and told and not itself and not reuses)

    def __len__(self) -> int:
        return len(self._steps)

    def note(self, index: int, found: StepGradients, norm: Tensor) -> None:
        """Keep a step's figures."""
        parts = [found.loss.reshape(1), norm.reshape(1)]
        if found.row is not None:
            parts += [found.row.tt, found.row.ta, found.row.aa, found.row.w2]
        # One tensor [2 + 3 G + L] per step, so that `taken` needs one transfer for all steps.
        figures = torch.cat([part.detach().double() for part in parts])
        self._steps.append((index, figures, [len(part) for part in parts]))
        if self.deferred:
            # Arithmetic on the device replaces an `if`, which would have to read the flag.
            broken = (~figures.isfinite().all()).float()
            # Once 1 it stays 1: the run ends at the first broken step, and what was queued after it
            # may not move the weights either.
            self._broken = broken if self._broken is None else self._broken.maximum(broken)
            before = index if self.moves is None else self.moved
            self.moves = 1 - self._broken.double()
            self.moved = self.moves * (index + 1) + (1 - self.moves) * before
        else:
            self.moved = index + 1

    def stop(self, optimizers: Sequence[Optimizer]) -> None:
        """Make the optimizers skip all steps from the first non-finite one on."""
        if self.deferred:
            for optimizer in optimizers:
                # As a GradScaler does: the fused kernel then skips the step and does not count it.
                optimizer.found_inf = self._broken  # type: ignore[attr-defined]

    def taken(self) -> Iterator[StepFigures]:
        """The figures in order of the steps, read in one transfer and then removed."""
        steps, self._steps = self._steps, []
        if not steps:
            return
        every = torch.cat([figures for _, figures, _ in steps]).cpu()
        found = every.split([sum(sizes) for _, _, sizes in steps])
        for (index, _, sizes), figures in zip(steps, found, strict=True):
            loss, norm, *columns = figures.split(sizes)  # columns: tt, ta, aa [G] and w2 [L]
            row = LedgerRow(*columns) if columns else None
            checked = {"loss": float(loss), "gradient norm": float(norm)}
            if row is not None:
                # The largest entry represents its column: PyTorch's max is NaN if any entry is.
                checked |= {f"largest {n}": float(x.abs().max()) for n, x in vars(row).items()}
            yield StepFigures(index, checked, row)
