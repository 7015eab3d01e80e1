"""The trainable parameters of a guarded model: their device, their gradients, and what moved them.

A guard works on the parameters that it found when it was created. It refuses a model in which other
parameters have become trainable, or the same ones are on another device.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from torch import Tensor, nn
from torch.optim.optimizer import Optimizer

from aegis_cli.common.errors import AegisError
from aegis_cli.common.ranks import ALONE, Ranks, rows_here
from aegis_cli.methods.known_parameters import check_reached
from aegis_cli.models import structure


class LearningParameters:
    """The parameters that were trainable in a model when a guard was created for it.

    Attributes:
        named: the parameters by their names in the model.
    """

    def __init__(self, model: nn.Module) -> None:
        self._model = model
        self.named = structure.learning(model)
        self._devices = [p.device for p in self.named.values()]
        self._types = [p.dtype for p in self.named.values()]

    # --- refusals ---------------------------------------------------------------------------------

    def refuse_others(self) -> None:
        """Raise AegisError if other parameters learn now."""
        if structure.learning(self._model).keys() != self.named.keys():
            raise _others()

    def refuse_further(self) -> None:
        """Raise AegisError if further parameters learn now; some may have been frozen since."""
        if structure.learning(self._model).keys() - self.named.keys():
            raise _others()

    def refuse_another_place(self) -> None:
        """Raise AegisError if they are on another device now, or have another dtype.

        The tensors that constrain them were not moved with them.
        """
        devices = [p.device for p in self.named.values()]
        if devices != self._devices:
            moved = zip(self._devices, devices, strict=True)
            then, now = next((then, now) for then, now in moved if then != now)
            raise AegisError(
                f"a model that was on {then} when the guard was made, and is on {now}",
                "the same device",
                f"model.to('{now}') before Guard(...), also where a trainer would do it",
            )
        for (name, parameter), then in zip(self.named.items(), self._types, strict=True):
            if parameter.dtype != then:
                raise AegisError(
                    f"'{name}', which was in {then} when the guard was made, and is in "
                    f"{parameter.dtype}",
                    "the same type: rounding to half precision is as large as an update",
                    "leave the model as it was, with torch.autocast for fast products; in "
                    "Lightning: precision='bf16-mixed'",
                )

    def refuse_unreached(self) -> None:
        """Raise AegisError if none of them has a gradient."""
        check_reached(self.named.values())

    # --- gradients and writes ---------------------------------------------------------------------

    def gradients(self) -> list[Tensor]:
        """Their gradients, where present; for sharded ones, the local rows."""
        return [rows_here(p.grad) for p in self.named.values() if p.grad is not None]

    def gradients_finite(self, owners: Ranks = ALONE) -> bool:
        """Whether every gradient is finite, in all processes."""
        # The largest entry is finite only if all are; a NaN propagates through the maximum.
        largest = nn.utils.get_total_norm(self.gradients(), norm_type=math.inf)
        return not owners.any(not largest.isfinite())[0]

    def by_name(self, gradients: Mapping[int, Tensor | None]) -> dict[str, Tensor]:
        """Map gradients from the ids of the parameters to their names."""
        found = {name: gradients.get(id(p)) for name, p in self.named.items()}
        return {name: gradient for name, gradient in found.items() if gradient is not None}

    def versions(self) -> list[int]:
        """How often each was written to, by PyTorch's version counter."""
        return [p._version for p in self.named.values()]

    # --- optimizers -------------------------------------------------------------------------------

    def are_in(self, optimizer: Optimizer) -> bool:
        """Whether an optimizer has any of them."""
        return bool(self.groups_of(optimizer))

    def groups_of(self, optimizer: Optimizer) -> list[dict[str, Any]]:
        """The optimizer's groups that have any of them."""
        mine = self._ids()
        return [g for g in optimizer.param_groups if any(id(p) in mine for p in g["params"])]

    def are_all_in(self, optimizer: Optimizer) -> bool:
        """Whether an optimizer has all of them, so that no other one shares its step.

        False for an optimizer that is not PyTorch's, because it cannot be asked.
        """
        if not isinstance(optimizer, Optimizer):
            return False
        return self._ids() <= {id(p) for group in optimizer.param_groups for p in group["params"]}

    def shared_with(self, other: LearningParameters) -> list[str]:
        """Names, in `other`, of the parameters that both have."""
        mine = self._ids()
        return [name for name, p in other.named.items() if id(p) in mine]

    def _ids(self) -> set[int]:
        return {id(p) for p in self.named.values()}


def _others() -> AegisError:
    return AegisError(
        "different trainable parameters than when the guard was made",
        "the same",
        "freeze and unfreeze before Guard(...)",
    )
