"""What the answers of somebody else's model mind of every map, by ways back through
watched passes.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from aegis_cli.anchors import curvature, passes
from aegis_cli.anchors.uses import said, watch_uses
from aegis_cli.common import device as devices
from aegis_cli.common.errors import AegisError
from aegis_cli.core.spectrum import DENSE, Spectrum, decompose
from aegis_cli.models import structure


class Minder:
    """Watches every linear map and convolution. No mask is needed: the gradient at a token that no
    answer reads is 0.

    Attributes:
        unmeasured: maps that have been used in a way that no hook sees -> how.
    """

    def __init__(self, model: nn.Module, seed: int) -> None:
        maps = structure.find_maps(model, ())
        self._model, self._sums = model, passes.Sums()
        self._generator = torch.Generator().manual_seed(seed)
        self.unmeasured: dict[str, str] = {}
        self._maps = {
            name: maps.twins.get(name, name)
            for name, module in structure.owning(model).items()
            if isinstance(module, DENSE) and maps.twins.get(name, name) in maps.kinds
        }

    @contextlib.contextmanager
    def watch(self) -> Iterator[None]:
        """Follow the maps that are called inside the block."""
        with contextlib.ExitStack() as hooks:
            for name, site in self._maps.items():
                hooks.callback(
                    curvature.watch(self._sums, site, self._model.get_submodule(name)).remove
                )
            hooks.enter_context(watch_uses(self._model, self._used))
            yield

    def answer(self, scores: Tensor) -> None:
        """Go back from the likelihood of words drawn from scores [n, V]."""
        curvature.descend(
            scores, [p for p in self._model.parameters() if p.requires_grad], self._generator
        )

    def spectra(self, energy: float) -> dict[str, Spectrum]:
        """Both factors of each map that took part, by its name without torch.compile.

        Raises:
            AegisError: none did.
        """
        with devices.single_threaded():
            found = {
                structure.plain(name): decompose(mean, energy)
                for name, mean in self._sums.means()
                if name.rpartition(".")[0] not in self.unmeasured
            }
        if not found:
            raise AegisError(
                "no map that an answer reads",
                "linear maps or convolutions that learn",
                "model.requires_grad_(True), then measure",
            )
        return found

    def _used(
        self,
        function: Callable[..., Any],
        _: nn.Parameter,
        names: Sequence[str],
        __: tuple[Any, ...],
    ) -> None:
        for site in {self._maps[name] for name in names if name in self._maps}:
            self.unmeasured[site] = said(function)
