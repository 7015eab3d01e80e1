"""Second moments by name, summed over passes, and the spectra that an anchor stores."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping

import torch
from torch import Tensor

from aegis_cli.common import devices
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Progress, ignore
from aegis_cli.common.kept_tensors import Kept
from aegis_cli.common.ranks import Ranks
from aegis_cli.core import moment_sums
from aegis_cli.core.moment_sums import MomentSum
from aegis_cli.core.spectrum import Spectrum, decompose

# What an error advises if activations are not finite.
FINITE = "measure the model in float32 or bfloat16, since float16 ends at 65,504"
Readers = tuple[str, ...]  # names of maps that have read the same rows, in alphabetical order


class SecondMoments:
    """Sums of second moments, which depend neither on batch size nor on order.

    Maps that read the same rows share one sum and, if they always do, one spectrum.
    """

    def __init__(self, whole: int = moment_sums.WHOLE) -> None:
        """Start without rows.

        Args:
            whole: largest width of rows whose second moment is summed in full; wider ones are
                sketched.
        """
        self._whole = whole
        self._rows: dict[Readers, MomentSum] = {}
        self._widths: dict[Readers, tuple[int, bool]] = {}  # and whether they are unfolded patches
        self._small: dict[str, Tensor] = {}  # those of normalisations and tables
        self._counts: dict[str, int] = {}

    def note(self, name: str) -> None:
        """Give the name its place among the others, before its rows are summed."""
        self._counts.setdefault(name, 0)

    def add(self, name: str, moment: Tensor, count: int) -> None:
        """Add the summed moment of `count` rows.

        Args:
            moment: float64; [D, m, m] for a normalisation, m counting its scale and shift, or [N]
                for a table's rows.
        """
        self._small[name] = self._small[name] + moment if name in self._small else moment
        self._counts[name] = self._counts.get(name, 0) + count

    def add_rows(self, names: Iterable[str], rows: Tensor, convolution: bool = False) -> None:
        """Add x x^T of rows x [n, d] that these maps have read."""
        # Sorted, so that the sum does not depend on which of them came first.
        readers = tuple(sorted(names))
        if readers not in self._rows:
            self._begin(readers, rows.shape[1], convolution, rows.device)
        self._rows[readers].add(rows)
        for name in readers:
            self._counts[name] = self._counts.get(name, 0) + len(rows)

    def kept(self) -> Kept:
        """The sums so far, for saving."""
        tensors: dict[str, Tensor] = {}
        rows = []
        for place, (readers, moment) in enumerate(self._rows.items()):
            parts = moment.parts()
            rows.append([readers, *self._widths[readers], len(parts)])
            tensors |= {f"rows.{place}.{i}": part for i, part in enumerate(parts)}
        tensors |= {f"small.{name}": moment for name, moment in self._small.items()}
        # In order, since spectra are listed and sums are added across processes in this order.
        figures = {"rows": rows, "small": list(self._small), "counts": list(self._counts.items())}
        return Kept(figures, tensors)

    def restore(self, kept: Kept, device: torch.device) -> None:
        """Continue from saved sums, before anything else is added."""
        for place, (names, width, convolution, count) in enumerate(kept.figures["rows"]):
            parts = [kept.tensors[f"rows.{place}.{i}"].to(device) for i in range(count)]
            self._begin(tuple(names), width, convolution, device)
            self._rows[tuple(names)].restore(parts)
        self._small = {n: kept.tensors[f"small.{n}"].to(device) for n in kept.figures["small"]}
        self._counts = dict(kept.figures["counts"])

    def _begin(self, readers: Readers, width: int, convolution: bool, device: torch.device) -> None:
        self._rows[readers] = moment_sums.make(width, device, convolution, self._whole)
        self._widths[readers] = width, convolution

    def add_up(self, ranks: Ranks) -> None:
        """Sum over the passes of all processes.

        Raises:
            AegisError: a process whose questions used other maps.
        """
        if not ranks.several:
            return
        # Sums are added by position, so all processes must have the same sums in the same order.
        names = [list(self._rows), list(self._small), list(self._counts)]
        if any(theirs != names for theirs in ranks.gathered(names)):
            raise AegisError(
                "questions that use other maps in one process than in another",
                "enough questions that each process reads of every kind",
                "more --samples, or fewer processes",
            )
        for moment in self._rows.values():
            ranks.add_up(moment.parts())
        ranks.add_up(list(self._small.values()))
        counts = ranks.gathered(self._counts)
        self._counts = {name: sum(own[name] for own in counts) for name in self._counts}

    def check(self, names: Iterable[str]) -> None:
        """Raise AegisError unless each of these names has rows."""
        if missing := [name for name in names if name not in self._counts]:
            raise AegisError(
                f"{', '.join(missing)} took no part in these questions",
                "every map's share",
                "use more samples",
            )

    def spectra(
        self,
        energy: float,
        leave_out: Collection[str] = (),
        release: bool = False,
        stage: str = "spectra",
        on_event: OnEvent = ignore,
    ) -> dict[str, Spectrum]:
        """The spectrum of each mean moment, by its name.

        They come in the order of their first rows. Maps that always read the same rows share one
        spectrum object.

        Args:
            energy: share of each moment's trace up to which eigenvectors are kept.
            leave_out: names of moments to ignore.
            release: release each sum when its spectrum is found, so that not all are in memory at
                the same time.
            stage: name of the stage in progress events; for a large model this takes minutes.

        Raises:
            AegisError: a sum that is not finite.
        """
        names = [name for name in self._counts if name not in leave_out]
        # A map may have read alone in one pass and together with others in another. Its moment is
        # the total of all sums it contributed to, and the same sums give the same spectrum.
        sums_of = {name: tuple(r for r in self._rows if name in r) for name in names}
        last_use: dict[Readers, str] = {}
        for name, sums in sums_of.items():
            for readers in sums:
                last_use[readers] = name
        shared: dict[tuple[Readers, ...], Spectrum] = {}
        found: dict[str, Spectrum] = {}
        with devices.single_threaded():  # the eigensolver waits for its own threads
            for done, (name, sums) in enumerate(sums_of.items()):
                on_event(Progress(stage, done, len(names), "spectra"))
                if name in self._small:
                    _check_finite(name, [self._small[name]])
                    found[name] = _small(self._small[name].cpu() / self._counts[name], energy)
                    continue
                if sums not in shared:
                    whole = moment_sums.merged([self._rows[readers] for readers in sums])
                    _check_finite(name, whole.parts())
                    shared[sums] = whole.spectrum(self._counts[name], energy)
                found[name] = shared[sums]
                if release:
                    for readers in sums:
                        if last_use[readers] == name:
                            del self._rows[readers]
        if names:
            on_event(Progress(stage, len(names), len(names), "spectra"))
        return found


def shared(spectra: Mapping[str, Spectrum]) -> dict[str, str]:
    """Names that share the spectrum of an earlier name -> that earlier name."""
    first: dict[int, str] = {}
    followers = {}
    for name, spectrum in spectra.items():
        # Shared spectra are one object; comparing values would be slow and would prove nothing.
        leader = first.setdefault(id(spectrum), name)
        if leader != name:
            followers[name] = leader
    return followers


def to_keep(spectra: Mapping[str, Spectrum]) -> Kept:
    """Spectra for saving; a shared one is stored once."""
    followers = shared(spectra)
    tensors: dict[str, Tensor] = {}
    for name, spectrum in spectra.items():
        if name not in followers:
            tensors[f"{name}.values"] = spectrum.values
            if spectrum.vectors is not None:
                tensors[f"{name}.vectors"] = spectrum.vectors
    leaders = [(name, followers.get(name, name), one.whole) for name, one in spectra.items()]
    return Kept({"spectra": leaders}, tensors)


def from_kept(kept: Kept) -> dict[str, Spectrum]:
    """The saved spectra; none for a process that has only figures."""
    found: dict[str, Spectrum] = {}
    for name, leader, whole in kept.figures["spectra"] if kept.tensors else ():
        if leader != name:
            found[name] = found[leader]
            continue
        values, vectors = kept.tensors[f"{name}.values"], kept.tensors.get(f"{name}.vectors")
        found[name] = Spectrum(values, vectors, whole)
    return found


def _check_finite(name: str, parts: Iterable[Tensor]) -> None:
    """Raise AegisError for a sum that is not finite, which has no eigenvectors."""
    if not all(part.isfinite().all() for part in parts):
        raise AegisError(
            f"a second moment of '{name}' that is not finite",
            "finite activations and gradients in every pass",
            f"{FINITE}, and see that its weights are finite",
        )


def _small(mean: Tensor, energy: float) -> Spectrum:
    if mean.ndim == 1:
        # Any number of texts may look up the same row, so only whether it is read counts.
        return Spectrum((mean > 0).to(torch.float64), None)
    return decompose(mean, energy)
