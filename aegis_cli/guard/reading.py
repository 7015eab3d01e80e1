"""What every map of a model reads in watched passes, padding left out."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.overrides import TorchFunctionMode

from aegis_cli.core.spectrum import Spectrum, lone_row, second_moment
from aegis_cli.errors import AegisError
from aegis_cli.guard import structure
from aegis_cli.stages import device as devices
from aegis_cli.stages import inputs, vqa_passes


class Reader:
    """Hooks on every map whose inputs can be measured, and an eye on parameters that are used elsewhere.

    Outside `vision`, a map's rows are those of the mask: its calls in one pass cover the T tokens in their order, once
    or several times. A map of which that is not so is refused where the mask leaves something out. Of a table only
    which rows are read counts; one that reads something else than the tokens (positions) counts whole, which protects
    more, never less.

    Attributes:
        unmeasured: maps and tables that have been read in a way that no hook sees -> how.
    """

    def __init__(self, model: nn.Module, vision: Sequence[str]) -> None:
        self._maps, self._vision = structure.find_maps(model, vision), vision
        self._sums = vqa_passes.Sums()
        self._open, self._mask = False, None
        self._covered: dict[str, int] = {}  # tokens of the mask that a map's calls have passed
        self._ids: dict[str, list[Tensor]] = {}
        self._inside: list[str] = []  # the modules with parameters whose forward is running
        self.unmeasured: dict[str, str] = {}
        modules = structure.site_modules(model, self._maps.kinds)
        self._lone = {site: model.get_parameter(site) for site in self._maps.kinds if site not in modules}
        self._tables = {name: module for name, module in modules.items() if isinstance(module, nn.Embedding)}
        self._owners = structure.owners(model)
        self._handles = [handle for name in structure.owning(model) for handle in self._hooks(model, name)]

    def remove(self) -> None:
        """Take the hooks off."""
        for handle in self._handles:
            handle.remove()

    @contextlib.contextmanager
    def watch(self, mask: Tensor | None) -> Iterator[None]:
        """Count what is read inside the block, at the tokens of the mask [B, T]; None: all of it."""
        self._mask = None if mask is None or mask.all() else mask
        self._covered, self._ids, self._inside, self._open = {}, {}, [], True
        try:
            with _Uses(self._used):
                yield
            self._check_covered()
            for site, read in self._ids.items():
                self._count_table(site, read)
        finally:
            self._open = False

    def spectra(self, energy: float) -> dict[str, Spectrum]:
        """The spectrum of each map that read something, by its name without torch.compile.

        Raises:
            AegisError: none did.
        """
        means = {site: mean for site, mean in self._sums.means([]).items() if site not in self.unmeasured}
        if not means:
            raise AegisError(
                "no map that read anything", "VQA passes inside `with measured.watch(mask):`", "run the questions first"
            )
        with devices.single_threaded():
            read = {structure.plain(site): inputs.spectrum(mean.cpu(), energy) for site, mean in means.items()}
        return read | {structure.plain(site): lone_row() for site in self._lone}

    # --- hooks ------------------------------------------------------------------------------------

    def _hooks(self, model: nn.Module, name: str) -> list[Any]:
        module = model.get_submodule(name)
        site = self._maps.twins.get(name, name)
        heads = {head: table for table, head in self._maps.heads.items()}
        before = partial(self._begin, name, site if site in self._maps.kinds else None, heads.get(name))
        return [
            module.register_forward_pre_hook(before, with_kwargs=True),
            module.register_forward_hook(self._end),
        ]

    def _begin(
        self, name: str, site: str | None, table: str | None, module: nn.Module, arguments: tuple[Any, ...],
        named: Mapping[str, Any],
    ) -> None:  # fmt: skip
        if not self._open:
            return
        self._inside.append(name)
        x = arguments[0] if arguments else next(iter(named.values()), None)
        if table is not None:
            self._count_scores(table, name, x)
        elif site is not None and isinstance(module, nn.Embedding):
            self._ids.setdefault(site, []).append(x)
        elif site is not None:
            self._sums.add(site, *inputs.moment(module, x, self._rows(name, x)))

    def _end(self, *_: Any) -> None:
        if self._open:
            self._inside.pop()

    def _used(self, function: Callable[..., Any], parameter: nn.Parameter, arguments: tuple[Any, ...]) -> None:
        """A parameter was given to a function; outside its module's forward only a tied head is understood."""
        names = self._owners.get(id(parameter), ())
        if not names or (self._inside and self._inside[-1] in names) or any(row is parameter for row in self._lone.values()):
            return  # a lone row is held still, whoever reads it
        site = next((name for name in names if name in self._maps.kinds), names[0])
        scores = function is F.linear and len(arguments) == 2 and arguments[1] is parameter and site in self._tables
        if scores:
            self._count_scores(site, f"{site}.scores", arguments[0])
        else:
            self.unmeasured[site] = f"{getattr(function, '__name__', function)} reads its parameters outside its forward"

    # --- rows -------------------------------------------------------------------------------------

    def _count_scores(self, table: str, name: str, x: Tensor) -> None:
        """What a tied head reads before it scores against the table's rows."""
        keep, rows = self._rows(name, x), x.flatten(0, -2)
        rows = rows if keep is None else rows[keep]
        self._sums.add(f"{table}.scores", second_moment(rows, bias=False), len(rows))

    def _rows(self, name: str, x: Tensor) -> Tensor | None:
        """Which of a map's rows are tokens that count: those of the mask at which its calls have arrived; None: all."""
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


class _Uses(TorchFunctionMode):
    """Reports each parameter that is given to a function which makes a tensor of it."""

    def __init__(self, report: Callable[[Callable[..., Any], nn.Parameter, tuple[Any, ...]], None]) -> None:
        super().__init__()
        self._report = report

    def __torch_function__(
        self, func: Callable[..., Any], types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        result = func(*args, **(kwargs or {}))
        if isinstance(result, (Tensor, list, tuple)):  # shapes and dtypes are nobody's business
            for given in (*args, *(kwargs or {}).values()):
                for x in given if isinstance(given, (list, tuple)) else (given,):
                    if isinstance(x, nn.Parameter):
                        self._report(func, x, args)
        return result


def _misfit(name: str, shape: Sequence[int], mask: Sequence[int]) -> AegisError:
    return AegisError(
        f"'{name}' reads {list(shape)}, which a mask {list(mask)} with padding does not fit",
        "one row a token",
        f'vision=("{name}", ...) if it reads pixels; else batches without padding and mask None',
    )
