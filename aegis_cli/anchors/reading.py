"""What every map of a model reads in watched passes, padding left out."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.hooks import RemovableHandle

from aegis_cli.anchors import inputs, passes
from aegis_cli.anchors.uses import said, watch_uses
from aegis_cli.common import device as devices
from aegis_cli.common.errors import AegisError
from aegis_cli.core.spectrum import Spectrum, lone_row, second_moment
from aegis_cli.models import structure


class Reader:
    """Watches every map whose inputs can be measured, and an eye on parameters that are used
    elsewhere.

    Outside `vision`, a map's rows are those of the mask: its calls in one pass cover the T tokens
    in their order, once or several times. A map of which that is not so is refused where the mask
    leaves something out. Of a table only which rows are read counts; one that reads something else
    than the tokens (positions) counts whole, which protects more, never less.

    Attributes:
        unmeasured: maps and tables that have been read in a way that no hook sees -> how.
    """

    def __init__(self, model: nn.Module, vision: Sequence[str]) -> None:
        self._model, self._vision = model, vision
        self._maps, self._sums = structure.find_maps(model, vision), passes.Sums()
        self._mask: Tensor | None = None
        self._covered: dict[str, int] = {}  # tokens of the mask that a map's calls have passed
        self._ids: dict[str, list[Tensor]] = {}
        self.unmeasured: dict[str, str] = {}
        modules = structure.site_modules(model, self._maps.kinds)
        self._lone = {
            site: model.get_parameter(site) for site in self._maps.kinds if site not in modules
        }
        self._tables = {
            name: module for name, module in modules.items() if isinstance(module, nn.Embedding)
        }

    @contextlib.contextmanager
    def watch(self, mask: Tensor | None) -> Iterator[None]:
        """Count what is read inside the block, at the tokens of the mask [B, T]; None:
        all of it.
        """
        self._mask = None if mask is None or mask.all() else mask
        self._covered, self._ids = {}, {}
        with contextlib.ExitStack() as hooks:
            hooks.enter_context(watch_uses(self._model, self._used))
            for name, module in structure.owning(self._model).items():
                hooks.callback(self._hook(name, module).remove)
            yield
        self._check_covered()
        for site, read in self._ids.items():
            self._count_table(site, read)

    def spectra(self, energy: float) -> dict[str, Spectrum]:
        """The spectrum of each map that read something, by its name without torch.compile.

        Raises:
            AegisError: none did.
        """
        with devices.single_threaded():
            read = {
                structure.plain(site): inputs.spectrum(mean, energy)
                for site, mean in self._sums.means()
                if site not in self.unmeasured
            }
        if not read:
            raise AegisError(
                "no map that read anything",
                "VQA passes inside `with measured.watch(mask):`",
                "run the questions first",
            )
        return read | {structure.plain(site): lone_row() for site in self._lone}

    # --- hooks ------------------------------------------------------------------------------------

    def _hook(self, name: str, module: nn.Module) -> RemovableHandle:
        site = self._maps.twins.get(name, name)
        heads = {head: table for table, head in self._maps.heads.items()}
        before = partial(
            self._begin, name, site if site in self._maps.kinds else None, heads.get(name)
        )
        return module.register_forward_pre_hook(before, with_kwargs=True)

    def _begin(
        self,
        name: str,
        site: str | None,
        table: str | None,
        module: nn.Module,
        arguments: tuple[Any, ...],
        named: Mapping[str, Any],
    ) -> None:
        x = arguments[0] if arguments else next(iter(named.values()), None)
        if table is not None:
            self._count_scores(table, name, x)
        elif site is not None and isinstance(module, nn.Embedding):
            self._ids.setdefault(site, []).append(x)
        elif site is not None:
            self._sums.add(site, *inputs.moment(module, x, self._rows(name, x)))

    def _used(
        self,
        function: Callable[..., Any],
        parameter: nn.Parameter,
        names: Sequence[str],
        arguments: tuple[Any, ...],
    ) -> None:
        """Outside its module's forward only a tied head is understood; a lone row is held still,
        whoever reads it.
        """
        if any(row is parameter for row in self._lone.values()):
            return
        site = next((name for name in names if name in self._maps.kinds), names[0])
        scores = (
            function is F.linear
            and len(arguments) == 2
            and arguments[1] is parameter
            and site in self._tables
        )
        if scores:
            self._count_scores(site, f"{site}.scores", arguments[0])
        else:
            self.unmeasured[site] = said(function)

    # --- rows -------------------------------------------------------------------------------------

    def _count_scores(self, table: str, name: str, x: Tensor) -> None:
        """What a tied head reads before it scores against the table's rows."""
        keep, rows = self._rows(name, x), x.flatten(0, -2)
        rows = rows if keep is None else rows[keep]
        self._sums.add(f"{table}.scores", second_moment(rows, bias=False), len(rows))

    def _rows(self, name: str, x: Tensor) -> Tensor | None:
        """Which of a map's rows are tokens that count: those of the mask at which its calls have
        arrived; None: all.
        """
        if self._mask is None or structure.under(name, self._vision):
            return None
        batch, length = self._mask.shape
        begun, rows = self._covered.get(name, 0) % length, x.shape[:-1].numel()
        tokens = rows // batch
        if rows % batch or x.shape[0] not in (batch, rows) or begun + tokens > length:
            raise _misfit(name, x.shape, self._mask.shape)
        self._covered[name] = self._covered.get(name, 0) + tokens
        return self._mask[:, begun : begun + tokens].flatten().to(x.device)

    def _check_covered(self) -> None:
        for name, tokens in self._covered.items():
            if self._mask is not None and tokens % self._mask.shape[1]:
                raise _misfit(name, (self._mask.shape[0], tokens), self._mask.shape)

    def _count_table(self, site: str, read: list[Tensor]) -> None:
        if self._mask is not None and all(ids.shape[:1] == self._mask.shape[:1] for ids in read):
            whole = torch.cat([ids.flatten(1) for ids in read], dim=1)  # [B, tokens]
            read = [whole[self._mask.to(whole.device)]] if whole.shape == self._mask.shape else read
        for ids in read:
            self._sums.add(site, *inputs.moment(self._tables[site], ids))


def _misfit(name: str, shape: Sequence[int], mask: Sequence[int]) -> AegisError:
    return AegisError(
        f"'{name}' reads {list(shape)}, which a mask {list(mask)} with padding does not fit",
        "one row a token",
        f'vision=("{name}", ...) if it reads pixels; else batches without padding and mask None',
    )
