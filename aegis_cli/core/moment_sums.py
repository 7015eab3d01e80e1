"""Sums of x x^T over the inputs x of a map, in full or sketched, depending on the map's width.

For a map up to `whole` wide, the second moment C [d, d] is summed in full, so its eigenvectors are
exact. Up to `EXACT_SUM` the running sum is in float64. Above that, float64 would take most of the
memory, so the sum is in float32, and only the blocks on and below the diagonal are kept: the sum of
N passes is off by about sqrt(N) roundings of 6e-8 of its largest entries
(tests/core/test_moment_sums.py).

A wider map has a sketch Y = C O [d, l] instead, with a random O [d, l]. The leading directions of C
follow from it by the Nystrom approximation Y (O^T Y)^-1 Y^T (Tropp, Yurtsever, Udell & Cevher 2017,
arXiv 1706.05736, algorithm 3). The trace of C is summed as well, so the energy outside the leading
directions is known, and becomes one scalar. Both are linear in C: the sums of several passes or
processes add up.

For a side wider than `SKETCHED`, such as the outputs of a vocabulary head, only the trace is kept.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from functools import lru_cache

import torch
from torch import Tensor

from aegis_cli.core.numerics import widened
from aegis_cli.core.spectrum import Spectrum, decompose, second_moment, with_rest

EXACT_SUM = 512  # widest second moment that is summed in float64
WHOLE = 1024  # widest that is summed in full, unless another limit is given
# An unfolded convolution may be wider: models have only a few, and a stem's inputs are delicate.
WHOLE_CONVOLUTION = 4096
SKETCHED = 16384  # widest that is sketched
_FEWEST_COLUMNS, _MOST_COLUMNS = 384, 1024  # of a sketch; in between, an eighth of the width
_STRIP = 256  # columns in one block of a float32 sum
_ROWS = 4096  # multiplied in float32 at a time
_WIDE_ROWS = 512  # rows of a sketch that are in float64 at a time
_SHIFTS = 8  # attempts, each ten times the last: the largest is a fraction of the moment itself
_ROUNDING = torch.finfo(torch.float32).eps


class MomentSum(ABC):
    """A sum of x x^T over rows x, or what is kept of it."""

    @abstractmethod
    def add(self, rows: Tensor) -> None:
        """Add rows [n, d]; dtypes narrower than float32 are upcast first."""

    @abstractmethod
    def plus(self, other: MomentSum) -> MomentSum:
        """A new sum of both; `other` must have the same kind and width."""

    @abstractmethod
    def parts(self) -> list[Tensor]:
        """Its tensors, to which those of other processes are added in place."""

    @abstractmethod
    def restore(self, parts: Sequence[Tensor]) -> None:
        """Go on from what another sum of this kind and width consisted of."""

    @abstractmethod
    def spectrum(self, count: int, energy: float) -> Spectrum:
        """The spectrum of the mean over `count` rows, on the CPU.

        Args:
            energy: fraction of the trace up to which eigenvectors are kept.
        """


def make(
    width: int, device: torch.device, convolution: bool = False, whole: int = WHOLE
) -> MomentSum:
    """An empty sum for rows of this width.

    Args:
        convolution: whether the rows are unfolded patches.
        whole: widest other rows that are summed in full.
    """
    if width <= _limit(convolution, whole):
        return FullSum(width, device)
    return Sketch(width, device) if width <= SKETCHED else TraceOnly(width, device)


def size(width: int, convolution: bool = False, whole: int = WHOLE) -> int:
    """Size in bytes of the sum that `make` returns."""
    if width <= min(EXACT_SUM, _limit(convolution, whole)):
        return 8 * width**2
    if width <= _limit(convolution, whole):
        return 4 * sum((width - start) * (stop - start) for start, stop in _strips(width))
    return 4 * width * columns(width) if width <= SKETCHED else 8


def columns(width: int) -> int:
    """Columns of the sketch for a map of this width."""
    return min(max(width // 8, _FEWEST_COLUMNS), _MOST_COLUMNS, width)


def _limit(convolution: bool, whole: int) -> int:
    # A sketch of a narrower map would have as many columns as the full sum.
    return max(whole, WHOLE_CONVOLUTION if convolution else _FEWEST_COLUMNS)


class FullSum(MomentSum):
    """The second moment itself, in strips of columns that start at the diagonal."""

    def __init__(self, width: int, device: torch.device) -> None:
        self._width, self._device = width, device
        self._sums: list[Tensor] = []  # [d - start, stop - start] for each strip
        self._strips = [(0, width)] if width <= EXACT_SUM else _strips(width)

    @torch.no_grad()
    def add(self, rows: Tensor) -> None:
        x = widened(rows)
        if self._width <= EXACT_SUM:
            moment = second_moment(x)
            self._sums = [self._sums[0] + moment if self._sums else moment]
            return
        if not self._sums:
            self._sums = [
                x.new_zeros(self._width - start, stop - start) for start, stop in self._strips
            ]
        with torch.autocast(x.device.type, enabled=False):
            for block in x.split(_ROWS):
                for (start, stop), total in zip(self._strips, self._sums, strict=True):
                    # The rows above a strip's diagonal block mirror those of an earlier strip.
                    total.addmm_(block[:, start:].T, block[:, start:stop])

    def plus(self, other: MomentSum) -> MomentSum:
        assert isinstance(other, FullSum)
        both = FullSum(self._width, self._device)
        both._sums = [a + b for a, b in zip(self._sums, other._sums, strict=True)]
        return both

    def parts(self) -> list[Tensor]:
        return self._sums

    def restore(self, parts: Sequence[Tensor]) -> None:
        self._sums = list(parts)

    def spectrum(self, count: int, energy: float) -> Spectrum:
        found = decompose(self.matrix() / count, energy)
        assert found.vectors is not None
        # Files store float32 at most, and wide float64 vectors would take much memory until then.
        exact = self._width <= EXACT_SUM
        vectors = found.vectors if exact else found.vectors.float()
        return Spectrum(found.values.cpu(), vectors.cpu())

    def matrix(self) -> Tensor:
        """The full sum [d, d], float64."""
        if self._width <= EXACT_SUM:
            return self._sums[0]
        whole = torch.zeros(self._width, self._width, dtype=torch.float64, device=self._device)
        for (start, stop), total in zip(self._strips, self._sums, strict=True):
            whole[start:, start:stop] = total
        return torch.tril(whole) + torch.tril(whole, -1).T


class Sketch(MomentSum):
    """A second moment times a random matrix, and its trace."""

    def __init__(self, width: int, device: torch.device) -> None:
        self._width, self._device = width, device
        count = columns(width)
        # Y [d, l], float32 even if the program has set another default dtype.
        self._seen = torch.zeros(width, count, dtype=torch.float32, device=device)
        self._trace = torch.zeros((), dtype=torch.float64, device=device)

    @torch.no_grad()
    def add(self, rows: Tensor) -> None:
        x = rows.to(self._seen.dtype)  # rounding loses far less than the sketch does
        probe = _probe(self._width, columns(self._width), str(self._device))
        with torch.autocast(x.device.type, enabled=False):
            for block in x.split(_ROWS):
                # X^T (X O) instead of C O, so that no [d, d] matrix is ever made.
                self._seen.addmm_(block.T, block @ probe)
                self._trace += _energy(block)

    def plus(self, other: MomentSum) -> MomentSum:
        assert isinstance(other, Sketch)
        both = Sketch(self._width, self._device)
        both._seen, both._trace = self._seen + other._seen, self._trace + other._trace
        return both

    def parts(self) -> list[Tensor]:
        return [self._seen, self._trace]

    def restore(self, parts: Sequence[Tensor]) -> None:
        self._seen, self._trace = parts

    @torch.no_grad()
    def spectrum(self, count: int, energy: float) -> Spectrum:
        trace = (self._trace / count).cpu()
        # A shift by the rounding of the sum keeps the inverted matrix positive; undone below.
        shift = float(torch.linalg.matrix_norm(self._seen)) / count * _ROUNDING
        if shift == 0:  # all rows were zero: no directions and no energy
            return with_rest(trace.new_zeros(0), self._seen[:, :0].cpu(), trace * 0)
        root, shift = self._root(count, shift)
        gram = sum(half.T @ half for half in self._halves(root, count, shift))  # B^T B, [l, l]
        rising, turn = torch.linalg.eigh(gram)  # B^T B has the eigenvalues of B B^T
        values, turn = rising.flip(0), turn.flip(1)
        # A value of which the shift makes up half or more is rounding.
        resolved = int((values > 2 * shift).sum())
        # With B = U S V^T, the eigenvectors are U = B V S^-1 and the eigenvalues S^2.
        scaled = turn[:, :resolved] / values[:resolved].sqrt()
        values = (values[:resolved] - shift).cpu()
        # As in `spectrum.rank`, but relative to the trace, which exceeds the sum of these values.
        short_of_it = int((values.cumsum(0) < energy * trace).sum())
        kept = resolved if energy >= 1 else min(resolved, short_of_it + 1)
        # U is computed in strips: B in float64 would be twice as large as the sketch.
        vectors = torch.empty(self._width, kept, dtype=torch.float32, device="cpu")
        parts = vectors.split(_WIDE_ROWS)
        for part, half in zip(parts, self._halves(root, count, shift), strict=True):
            part.copy_(half @ scaled[:, :kept])
        left = (trace - values[:kept].sum()).clamp(min=0)  # rounding may make it negative
        rest = left / (self._width - kept)
        return with_rest(values[:kept], vectors, rest)

    def _shifted(self, count: int, shift: float) -> Iterator[tuple[Tensor, Tensor]]:
        """Rows of O and of Y + shift O, in blocks: all in float64 would take several sketches."""
        probe = _probe(self._width, columns(self._width), str(self._device))
        both = zip(probe.split(_WIDE_ROWS), self._seen.split(_WIDE_ROWS), strict=True)
        for part, seen in both:
            wide = part.double()
            yield wide, seen.double() / count + shift * wide

    def _root(self, count: int, shift: float) -> tuple[Tensor, float]:
        """The Cholesky root of O^T (Y + shift O), [l, l], and the shift that it needed.

        With nearly as many columns as rows, O hardly covers some directions. There the rounding of
        the sum can outweigh the shift, so the shift grows until the core is positive.
        """
        zero = self._trace.new_zeros(())
        for _ in range(_SHIFTS):
            core = sum((part.T @ seen for part, seen in self._shifted(count, shift)), zero)
            root, failed = torch.linalg.cholesky_ex((core + core.T) / 2)
            if not failed:
                return root, shift
            shift *= 10
        raise AssertionError("a second moment is not finite")

    def _halves(self, root: Tensor, count: int, shift: float) -> Iterator[Tensor]:
        """Rows of B, where B B^T = Y (O^T Y)^-1 Y^T with the shifted Y."""
        for _, seen in self._shifted(count, shift):
            yield torch.linalg.solve_triangular(root, seen.T, upper=False).T


class TraceOnly(MomentSum):
    """The trace of a second moment."""

    def __init__(self, width: int, device: torch.device) -> None:
        self._width, self._device = width, device
        self._trace = torch.zeros((), dtype=torch.float64, device=device)

    def add(self, rows: Tensor) -> None:
        self._trace += _energy(widened(rows))

    def plus(self, other: MomentSum) -> MomentSum:
        assert isinstance(other, TraceOnly)
        both = TraceOnly(self._width, self._device)
        both._trace = self._trace + other._trace
        return both

    def parts(self) -> list[Tensor]:
        return [self._trace]

    def restore(self, parts: Sequence[Tensor]) -> None:
        (self._trace,) = parts

    def spectrum(self, count: int, energy: float) -> Spectrum:
        rest = self._trace.cpu() / count / self._width
        none = torch.zeros(self._width, 0, dtype=torch.float32, device="cpu")
        return with_rest(rest.new_zeros(0), none, rest)


def merged(sums: Sequence[MomentSum]) -> MomentSum:
    """The sum of several sums; a single one is returned as it is."""
    whole = sums[0]
    for other in sums[1:]:
        whole = whole.plus(other)
    return whole


def _energy(rows: Tensor) -> Tensor:
    """The sum of squares of rows [n, d], float64; the norm of each row is taken in float32."""
    return torch.linalg.vector_norm(rows, dim=1).double().square().sum()


def _strips(width: int) -> list[tuple[int, int]]:
    """Column ranges of about `_STRIP` each that cover the width."""
    pieces = max(2, round(width / _STRIP))
    edges = [width * i // pieces for i in range(pieces + 1)]
    return list(zip(edges[:-1], edges[1:], strict=True))


@lru_cache(maxsize=8)
def _probe(width: int, count: int, device: str) -> Tensor:
    """Random columns [d, l] of length about 1; the same for every map of that width.

    A few random vectors in many dimensions are nearly orthogonal, which is all that is needed.
    """
    # Sketches of several passes or processes add up only if all use the same O. So the seed is the
    # width, and the numbers are always drawn on the CPU.
    generator = torch.Generator("cpu").manual_seed(width)
    drawn = torch.randn(width, count, generator=generator, dtype=torch.float32, device="cpu")
    return drawn.mul_(width**-0.5).to(device)
