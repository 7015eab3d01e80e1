"""Second moments of the inputs of every map of a model while it answers questions."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from aegis_cli.anchors import kept_work, passes, second_moments
from aegis_cli.anchors.hooks import SharedInput, describe_use, modules_of_sites, watch_uses
from aegis_cli.anchors.second_moments import SecondMoments
from aegis_cli.common import memory as memory_of_process
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, ignore
from aegis_cli.common.kept_tensors import Kept
from aegis_cli.common.ranks import ALONE, Ranks
from aegis_cli.core import moment_sums
from aegis_cli.core.numerics import widened
from aegis_cli.core.spectrum import DENSE, Spectrum, channel_moment, lone_row
from aegis_cli.models import structure
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.models.wrappers import plain_names

if TYPE_CHECKING:  # the guard imports this module and needs no scene renderer
    from aegis_cli.data.vqa.dataset import VQASet

_LARGE = 10**8  # bytes of sums
_DRAWS = "draws"  # the key of the generator's state


@dataclass
class Reading(SharedInput):
    """What a dense map has just read, until another tensor is read: other maps may read it too.

    Attributes:
        keep: which of its rows count, [rows] bool; None: all.
        rows: a copy of the rows that count, [n, d].
    """

    keep: Tensor | None
    rows: Tensor


@dataclass(frozen=True)
class Drawn:
    """Which rows count: a share of the rows of each call, drawn without replacement.

    The share is rounded to whole rows per call, so short calls may count a little more or less than
    long ones; with some hundred rows this is negligible.

    Attributes:
        share: in (0, 1]; 1: all rows count and nothing is drawn.
        seed: seed of the draws.
    """

    share: float = 1.0
    seed: int = 0

    def of_process(self, rank: int) -> Drawn:
        """The draws of the process of this rank; rank 0 draws as a single process does."""
        if rank == 0:
            return self
        # A generator on the CPU uses 32 bits of its seed, so the rank has to be mixed in.
        mixed = np.random.SeedSequence([self.seed, rank]).generate_state(1)
        return replace(self, seed=int(mixed[0]))

    def generator(self) -> torch.Generator:
        return torch.Generator().manual_seed(self.seed)

    def of(self, rows: Tensor, generator: torch.Generator) -> Tensor:
        """A copy of the rows of [n, d] that count, at least one; if all count, no copy is made."""
        if self.share == 1:
            return rows
        count = max(1, round(self.share * len(rows)))
        chosen = torch.randperm(len(rows), generator=generator, device="cpu")[:count]
        return rows[chosen.to(rows.device)]


ALL = Drawn()


class InputRecorder:
    """Sums the second moments of what every map reads in watched passes, padding left out.

    A second moment is E[x x^T] [d, d] of the rows x that a map multiplies, with a 1 appended if the
    map has a bias (GPM, arXiv 2103.09762; core/spectrum.py). Linear maps that read the same tensor
    one after the other (queries, keys and values; gate and up) share one.

    Outside `vision`, a map's rows are those of the mask: its calls in one pass cover the T tokens
    in order, once or several times. If the mask leaves tokens out, any other map is refused. For a
    table, only which rows are read matters; if it reads something other than the tokens (such as
    positions), all of it counts, which protects more, never less.

    Attributes:
        unmeasured: maps and tables that were read in a way that no hook sees -> how.
    """

    def __init__(
        self,
        model: nn.Module,
        maps: structure.Maps,
        vision: Sequence[str] = (),
        *,
        follow_uses: bool = True,
        whole: int = moment_sums.WHOLE,
        drawn: Drawn = ALL,
    ) -> None:
        """Prepare; hooks are on the model only while a pass is watched.

        Args:
            maps: the maps to measure.
            vision: dotted names of the modules that read pixels, to which no mask applies.
            follow_uses: also look for parameters that are used outside their module's forward. A
                backbone that names its tied heads itself does not need this search.
            whole: as for `SecondMoments`.
            drawn: which rows of linear maps, convolutions and tied heads count.
        """
        self._drawn, self._generator = drawn, drawn.generator()
        self._model, self._vision, self._maps = model, vision, maps
        self._plain = plain_names(model)
        self._follow_uses, self._sums = follow_uses, SecondMoments(whole)
        self._mask: Tensor | None = None
        self._reading: Reading | None = None
        self._covered: dict[str, int] = {}  # tokens of the mask that a map's calls have passed
        self._ids: dict[str, list[Tensor]] = {}
        self.unmeasured: dict[str, str] = {}
        self._modules = structure.site_modules(model, maps.kinds)
        self._lone = {
            site: model.get_parameter(site) for site in maps.kinds if site not in self._modules
        }

    @contextlib.contextmanager
    def watch(self, mask: Tensor | None) -> Generator[None]:
        """Count what is read inside the block.

        Args:
            mask: [B, T] bool, true at the tokens that count; None: all do.
        """
        # If all tokens count, no map's rows have to be told apart, whatever their shape.
        self._mask = None if mask is None or mask.all() else mask
        self._covered, self._ids, self._reading = {}, {}, None
        with contextlib.ExitStack() as hooks:
            if self._follow_uses:
                hooks.enter_context(watch_uses(self._model, self._count_use))
            for name, site in modules_of_sites(self._model, self._maps).items():
                # Before the call, since a module may change its input in place.
                before = partial(self._count_call, name, site)
                module = self._model.get_submodule(name)
                hooks.callback(module.register_forward_pre_hook(before, with_kwargs=True).remove)
            for table, head in self._maps.heads.items():
                after = partial(self._count_head, table, head)
                module = self._model.get_submodule(head)
                hooks.callback(module.register_forward_hook(after, with_kwargs=True).remove)
            yield
        self._count_reading()
        self._check_covered()
        for site, read in self._ids.items():
            self._count_table(site, read)

    def kept(self) -> Kept:
        """The sums so far and the state of the draws, for saving between two passes."""
        self._count_reading()  # the last tensor read is still waiting for other readers
        sums = self._sums.kept()
        return Kept(sums.figures, {**sums.tensors, _DRAWS: self._generator.get_state()})

    def restore(self, kept: Kept, device: torch.device) -> None:
        """Continue from saved sums, before the first pass."""
        self._sums.restore(kept, device)
        self._generator.set_state(kept.tensors[_DRAWS])

    def add_up(self, ranks: Ranks) -> None:
        """Add the sums of all processes, each of which had its own passes."""
        self._sums.add_up(ranks)

    def check_complete(self) -> None:
        """Raise AegisError unless every module of the maps has read something."""
        self._sums.check(self._modules)

    def spectra(
        self,
        energy: float,
        release: bool = False,
        stage: str = "spectra",
        on_event: OnEvent = ignore,
    ) -> dict[str, Spectrum]:
        """The spectrum of each map that read something, by its plain name.

        A tied head's spectrum is named after its table, `TABLE.scores`.

        Args:
            energy: share of each map's input energy up to which eigenvectors are kept.
            release: release each sum once it is no longer needed.
            stage: name of the stage in progress events.

        Raises:
            AegisError: no map read anything.
        """
        read = self._sums.spectra(energy, self.unmeasured, release, stage, on_event)
        if not read:
            raise AegisError(
                "no map that read anything",
                "VQA passes inside `with measured.watch(mask):`",
                "run the questions first",
            )
        read |= {site: lone_row() for site in self._lone}
        return {self._plain(name): spectrum for name, spectrum in read.items()}

    # --- hooks ------------------------------------------------------------------------------------

    def _count_call(
        self,
        name: str,
        site: str,
        module: nn.Module,
        arguments: tuple[Any, ...],
        named: Mapping[str, Any],
    ) -> None:
        x = _first(arguments, named)
        if isinstance(module, nn.Embedding) and self._mask is not None:
            # Which tokens a table reads is known only after all of its calls.
            self._ids.setdefault(site, []).append(x)
        elif isinstance(module, nn.Embedding):
            self._sums.add(site, *moment(module, x))
        elif isinstance(module, DENSE):
            self._read(site, module, x, self._rows(name, x))
        else:
            self._sums.add(site, *moment(module, x, self._rows(name, x)))

    def _count_head(
        self,
        table: str,
        name: str,
        module: nn.Module,
        arguments: tuple[Any, ...],
        named: Mapping[str, Any],
        output: Tensor,
    ) -> None:
        """Count a tied head's input: that of a linear map, or the output of any other module."""
        scored = _first(arguments, named) if isinstance(module, nn.Linear) else output
        self._count_scores(table, name, scored)

    def _count_use(
        self,
        function: Callable[..., Any],
        parameter: nn.Parameter,
        names: Sequence[str],
        arguments: tuple[Any, ...],
    ) -> None:
        """Count a tied head; note any other use of a parameter outside its module's forward.

        A lone row is frozen, so its uses do not matter.
        """
        if any(row is parameter for row in self._lone.values()):
            return
        site = next((name for name in names if name in self._maps.kinds), names[0])
        # x W^T without a bias, with a table for W: a head that is tied to the word embeddings.
        scores = (
            function is F.linear
            and len(arguments) == 2
            and arguments[1] is parameter
            and isinstance(self._modules.get(site), nn.Embedding)
        )
        if scores:
            self._count_scores(site, f"{site}.scores", arguments[0])
        else:
            self.unmeasured[site] = describe_use(function)

    # --- rows -------------------------------------------------------------------------------------

    def _count_scores(self, table: str, name: str, x: Tensor) -> None:
        """Count what a tied head multiplies by the table's rows."""
        keep, rows = self._rows(name, x), x.flatten(0, -2)
        rows = rows if keep is None else rows[keep]
        self._sums.add_rows([f"{table}.scores"], self._drawn.of(rows, self._generator))

    def _read(self, site: str, module: nn.Module, x: Tensor, keep: Tensor | None) -> None:
        """Note what a linear map or convolution reads."""
        self._sums.note(site)
        last = self._reading
        if last is not None and last.serves(site, module, x) and _same(keep, last.keep):
            last.sites.append(site)
            return
        self._count_reading()
        rows = dense_rows(module, x)
        rows = self._drawn.of(rows if keep is None else rows[keep], self._generator)
        if rows.data_ptr() == x.data_ptr():
            rows = rows.clone()  # the model may change them in place
        self._reading = Reading(x, module, [site], keep, rows)

    def _count_reading(self) -> None:
        """Add what was read last, once all of its readers are known."""
        if self._reading is not None:
            done, self._reading = self._reading, None
            self._sums.add_rows(done.sites, done.rows, done.of_convolution)

    def _rows(self, name: str, x: Tensor) -> Tensor | None:
        """Which of a map's rows are tokens that count, [rows] bool; None: all.

        The mask is read from the token that the map's earlier calls in this pass have reached.
        """
        if self._mask is None or structure.under(self._plain(name), self._vision):
            return None
        batch, length = self._mask.shape
        if x.ndim > 3 and x.shape[:2] == self._mask.shape:  # several rows per token, such as heads
            self._covered[name] = self._covered.get(name, 0) + length
            per_token = x.shape[2:-1].numel()  # of [B, T, ..., d]
            return self._mask.flatten().repeat_interleave(per_token).to(x.device)
        # A map that is called again after all T tokens starts over with the first one.
        begun, rows = self._covered.get(name, 0) % length, x.shape[:-1].numel()
        tokens = rows // batch  # of each text; x is [B, tokens, d], or flat, [B * tokens, d]
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
            if whole.shape == self._mask.shape:
                read = [whole[self._mask.to(whole.device)]]
        # If the calls do not cover exactly the tokens of the mask, everything read counts.
        for ids in read:
            self._sums.add(site, *moment(self._modules[site], ids))


@torch.no_grad()
def measure(
    model: Backbone,
    asked: VQASet,
    energy: float,
    batch_size: int = passes.IMAGES,
    on_event: OnEvent = ignore,
    memory: int | None = None,
    whole: int = moment_sums.WHOLE,
    ranks: Ranks = ALONE,
    drawn: Drawn = ALL,
    work: kept_work.Work = kept_work.NOTHING,
) -> dict[str, Spectrum]:
    """Measure the inputs of every site of one of our backbones, and of each tied head.

    The rows are those of images, questions and answers; a tied head's spectrum is `SITE.scores`.

    Args:
        memory: bytes that the sums may take; groups of maps are measured one after the other, each
            with passes of its own. None: all maps at once.
        whole: as for `SecondMoments`.
        ranks: the processes that share the passes.
        drawn: as for `InputRecorder`; each process draws by itself.
        work: the saved state of an interrupted measurement, and of this one.

    Raises:
        AegisError: modules that inputs cannot describe, or that these questions do not use.
    """
    found: dict[str, Spectrum] = {}
    sized = partial(_size, whole)
    with contextlib.ExitStack() as until_measured:
        if sum(sized(module) for module in model.site_modules().values()) > _LARGE:
            # Sums lie between blocks that the passes free, so much freed memory would be kept.
            until_measured.enter_context(memory_of_process.returned())
        for maps, stage in passes.groups(model, "anchor inputs", memory, sized):
            piece = work.piece(stage)
            if (known := piece.finished()) is not None:
                passes.tell_known(asked, stage, on_event)
                found |= second_moments.from_kept(known)
                continue
            own = drawn.of_process(ranks.rank)
            recorder = InputRecorder(model, maps, follow_uses=False, whole=whole, drawn=own)
            done = 0
            if (begun := piece.begun()) is not None:
                recorder.restore(begun, model.device)
                done = begun.figures["done"]
                del begun  # whose copy on the CPU takes as much memory as the sums
            with recorder.watch(None), piece.going(recorder.kept) as passed:
                for _ in passes.run(model, asked, batch_size, stage, on_event, ranks, done, passed):
                    pass
            recorder.add_up(ranks)
            recorder.check_complete()
            spectra = recorder.spectra(energy, True, f"{stage} spectra", on_event)
            piece.finish(second_moments.to_keep(spectra))
            found |= spectra
    return found


def _size(whole: int, module: nn.Module) -> int:
    """Bytes of the sum of what a module reads."""
    width, convolution = dense_width(module), not isinstance(module, nn.Linear)
    return 0 if width is None else moment_sums.size(width, convolution, whole)


def kept_share(inputs: Mapping[str, Spectrum]) -> float | None:
    """Share of all maps' input directions whose eigenvectors are stored; None if no map has any.

    A table needs no eigenvectors and stores none.
    """
    directions = kept = 0
    for spectrum in inputs.values():
        if spectrum.vectors is None:
            continue
        directions += spectrum.values.numel()
        # A normalisation keeps all its directions, at most two per channel.
        whole = spectrum.vectors.ndim == 3
        kept += spectrum.values.numel() if whole else spectrum.vectors.shape[1]
    return kept / directions if directions else None


def moment(module: nn.Module, x: Tensor, keep: Tensor | None = None) -> tuple[Tensor, int]:
    """Summed second moment of what a normalisation's or table's parameters multiply, and row count.

    Args:
        x: its input: [..., d] for a normalisation, ids for a table.
        keep: [rows] bool: which rows count (for a table: look-ups), one per output token; None:
            all.
    """
    if isinstance(module, nn.Embedding):
        ids = x.flatten() if keep is None else x.flatten()[keep]
        return torch.bincount(ids, minlength=module.num_embeddings).double(), ids.numel()
    rows, bias = rows_of(module, x), getattr(module, "bias", None) is not None
    rows = rows if keep is None else rows[keep]
    return channel_moment(rows, bias), len(rows)


def dense_rows(module: nn.Module, x: Tensor) -> Tensor:
    """What a linear map or convolution multiplies [n, d], with a 1 appended if it has a bias.

    Rows narrower than float32 are widened.
    """
    rows = widened(rows_of(module, x))
    if getattr(module, "bias", None) is None:
        return rows
    # W x + b = (W, b) (x, 1): a bias is one more column, whose input is always 1.
    return torch.cat([rows, rows.new_ones(len(rows), 1)], dim=1)


def dense_width(module: nn.Module) -> int | None:
    """The width d of these rows; None for any other module."""
    if not isinstance(module, DENSE):
        return None
    # A weight is [o, d], or [o, c, k, k] for a convolution, where each output reads c * k * k.
    return module.weight[0].numel() + (module.bias is not None)


def rows_of(module: nn.Module, x: Tensor) -> Tensor:
    """What the module's parameters multiply, one row per output token: [n, d].

    Raises:
        AegisError: a volume that is larger than the kernel of a 3-D convolution.
    """
    if isinstance(module, nn.Conv2d):
        padding = 0 if module.padding == "valid" else module.padding
        assert not isinstance(padding, str)  # "same" is no map: `structure.site_kind`
        patches = F.unfold(x, module.kernel_size, module.dilation, padding, module.stride)
        return patches.transpose(1, 2).flatten(0, 1)  # [B, d, n] -> [B*n, d]
    if isinstance(module, nn.Conv3d):
        # PyTorch cannot unfold volumes; vision towers apply these to one patch at a time.
        if tuple(x.shape[2:]) != module.kernel_size:
            raise AegisError(
                f"a 3-D convolution over {tuple(x.shape[2:])} with a kernel of "
                f"{module.kernel_size}",
                "patches of the kernel's size",
                "leave the inputs out: aegis anchor --parts moments",
            )
        return x.flatten(1)
    if isinstance(module, nn.Linear):
        return x.flatten(0, -2)
    if isinstance(module, nn.LayerNorm):
        # Computed without weight and bias: this is what they multiply and shift.
        return F.layer_norm(x, module.normalized_shape, eps=module.eps).flatten(0, -2)
    return structure.rms_normed(module, x).flatten(0, -2)


def _same(a: Tensor | None, b: Tensor | None) -> bool:
    if a is None or b is None:
        return a is b
    return torch.equal(a, b)


def _first(arguments: tuple[Any, ...], named: Mapping[str, Any]) -> Any:
    """A module's first argument, whether passed by position or by name."""
    return arguments[0] if arguments else next(iter(named.values()), None)


def _misfit(name: str, shape: Sequence[int], mask: Sequence[int]) -> AegisError:
    return AegisError(
        f"'{name}' reads {list(shape)}, which a mask {list(mask)} with padding does not fit",
        "one row per token",
        f'vision=("{name}", ...) if it reads pixels; else batches without padding and mask None',
    )
