"""Second moments by name, summed over passes, and the spectra that an anchor keeps of them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator

from torch import Tensor

from aegis_cli.common import devices
from aegis_cli.common.errors import AegisError
from aegis_cli.core.spectrum import Spectrum, decompose
from aegis_cli.models.structure import plain


class SecondMoments:
    """Sums of second moments in float64, so that neither batch size nor order shows in them."""

    def __init__(self) -> None:
        self._totals: dict[str, Tensor] = {}
        self._counts: dict[str, int] = {}

    def add(self, name: str, moment: Tensor, count: int) -> None:
        """Add the summed moment of `count` rows.

        Args:
            moment: float64; [d, d] of a dense map, [D, m, m] of a normalisation with m of scale
                and shift, [N] of a table's rows.
        """
        self._totals[name] = self._totals[name] + moment if name in self._totals else moment
        self._counts[name] = self._counts.get(name, 0) + count

    def check(self, names: Iterable[str]) -> None:
        """Raise AegisError unless each of them has rows."""
        if missing := [name for name in names if name not in self._totals]:
            raise AegisError(
                f"{', '.join(missing)} took no part in these questions",
                "every map's share",
                "use more samples",
            )

    def spectra(self, energy: float, leave_out: Collection[str] = ()) -> dict[str, Spectrum]:
        """The spectrum of each mean moment, by its name without torch.compile.

        They come in the order of their first rows.

        Args:
            energy: share of each moment's trace up to which eigenvectors are kept.
            leave_out: names of moments that do not count.
        """
        with devices.single_threaded():  # the eigensolver waits for its own threads
            return {
                plain(name): _spectrum(mean, energy)
                for name, mean in self._means()
                if name not in leave_out
            }

    def _means(self) -> Iterator[tuple[str, Tensor]]:
        """Each name with its mean, on the CPU.

        One at a time: of a large model all of them together do not fit beside the sums, least of
        all on a GPU.
        """
        for name, total in self._totals.items():
            yield name, total.cpu() / self._counts[name]


def _spectrum(mean: Tensor, energy: float) -> Spectrum:
    if mean.ndim == 1:
        # A look-up of a table's row serves any number of texts, so only whether it is read counts.
        return Spectrum((mean > 0).double(), None)
    return decompose(mean, energy)
