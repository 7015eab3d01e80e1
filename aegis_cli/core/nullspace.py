"""The part of a parameter's update that changes outputs on VQA, and the update without it.

For inputs x in the span of U, (W + D) x = W x whenever D U = 0, however the optimizer arrived at D.
So the *applied* update is projected, weight decay included: D <- D - D A with A = U U^T. A soft
threshold has A = C (C + s)^-1 instead, with C as fractions of its trace. It leaves the X that
minimises |X - D|^2 + E|X x|^2 / s, so it is a proximal step, like that of core/curvature.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import torch
from torch import Tensor

from aegis_cli.common.errors import AegisError
from aegis_cli.core import stacking
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.numerics import ratio, wide_type
from aegis_cli.core.pairs import Pair, copied, minus
from aegis_cli.core.spectrum import Spectrum, rank

Remembered = tuple[Tensor | None, ...]  # what a protection remembers about a map's values


class Protection(Protocol):
    """How the updates of one map are protected."""

    def removed(self, weight: Tensor, bias: Tensor | None) -> Pair:
        """The protected part of an update to the map's weight and bias, in their shapes."""

    def of_rows(self, rows: slice) -> Protection:
        """The protection of these rows alone; each row is protected independently of the others."""

    def remember(self, weight: Tensor, bias: Tensor | None) -> Remembered:
        """What `hold` needs to know about the values before an update."""

    def hold(self, weight: Tensor, bias: Tensor | None, before: Remembered) -> None:
        """Remove the protected part of the change since `remember` from the values, in place."""


@dataclass(frozen=True)
class Dense:
    """Protection of a linear map or convolution: A = U f U^T + r (1 - U U^T).

    A itself [d, d] is never made. For n stacked maps (core/stacking.py) every tensor has a leading
    dimension n.

    Attributes:
        basis: U [d, k], orthonormal columns; d includes the constant input of a bias, if any.
        factor: f [k], the fraction removed along each of them, from 0 to 1.
        rest: r, the fraction removed along every other direction; for stacked maps [n, 1], or 0 for
            all.
    """

    basis: Tensor
    factor: Tensor
    rest: float | Tensor = 0.0

    def removed(self, weight: Tensor, bias: Tensor | None) -> Pair:
        # D A = r D + D U (f - r) U^T
        above_rest = (self.factor - self.rest)[..., None, :]  # [1, k]
        along = self._along(weight, bias) * above_rest
        protected, shifted = self._back(along, weight, bias)
        if isinstance(self.rest, Tensor) or self.rest:
            # For stacked maps [n, 1, 1], to match their weights [n, o, d].
            of_weight = self.rest[..., None] if isinstance(self.rest, Tensor) else self.rest
            protected = protected + of_weight * weight
            if bias is not None and shifted is not None:
                shifted = shifted + self.rest * bias
        return protected, shifted

    def changed(self, weight: Tensor, bias: Tensor | None, before: Remembered) -> Pair:
        """What `hold` removes from the values, in their shapes."""
        return self._back(self._lost(weight, bias, before), weight, bias)

    def of_rows(self, rows: slice) -> Dense:
        return self

    def remember(self, weight: Tensor, bias: Tensor | None) -> Remembered:
        return (self._along(weight, bias),)

    def hold(self, weight: Tensor, bias: Tensor | None, before: Remembered) -> None:
        """See `Protection.hold`; directions that were never resolved are left as they are.

        Finding what changed along them would take a full copy of the old values.
        """
        removed = self._lost(weight, bias, before)  # [o, k]
        width = weight.flatten(1).shape[1]
        directions = self.basis[:width].T  # [k, d]
        if weight.is_contiguous():
            # A fused product, without an [o, d] copy of what is subtracted.
            weight.view(len(weight), -1).addmm_(removed, directions, alpha=-1)
        else:
            weight.sub_((removed @ directions).view(weight.shape))
        if bias is not None:
            bias.sub_(removed @ self.basis[width])

    def _along(self, weight: Tensor, bias: Tensor | None) -> Tensor:
        """The coordinates [o, k] of a weight and a bias along the directions."""
        flat = weight.flatten(self.factor.ndim)
        width = flat.shape[-1]
        along = flat @ self.basis[..., :width, :]  # [o, k]
        if bias is None:
            return along
        # The bias is the weight of an input that is always 1; its row of U is the last.
        if along.ndim == 2:
            return along.addr(bias, self.basis[width])
        return along.addcmul(bias[..., None], self.basis[..., width:, :])

    def _lost(self, weight: Tensor, bias: Tensor | None, before: Remembered) -> Tensor:
        """The coordinates [o, k] of the protected part of what has changed since `remember`."""
        (known,) = before
        assert known is not None
        return (self._along(weight, bias) - known) * self.factor[..., None, :]

    def _back(self, along: Tensor, weight: Tensor, bias: Tensor | None) -> Pair:
        """Coordinates [o, k] as a weight and a bias, in the shapes of those given."""
        found = along @ self.basis.mT  # [o, d]
        if bias is None:
            return found.reshape(weight.shape), None
        return found[..., :-1].reshape(weight.shape), found[..., -1]


@dataclass(frozen=True)
class Elementwise:
    """Protection of a normalisation, channel by channel.

    Attributes:
        inside: [D, m, m], A of each channel's (scale, shift) for m = 2, or scale for m = 1; for n
            stacked normalisations [n, D, m, m].
    """

    inside: Tensor

    def removed(self, weight: Tensor, bias: Tensor | None) -> Pair:
        parts = (weight,) if bias is None else (weight, bias)
        both = torch.stack(parts, -1)  # [D, m]
        found = (self.inside @ both[..., None])[..., 0]  # [D, m]
        return found[..., 0], None if bias is None else found[..., 1]

    def changed(self, weight: Tensor, bias: Tensor | None, before: Remembered) -> Pair:
        """What `hold` removes from the values, in their shapes."""
        old_weight, old_bias = before
        assert old_weight is not None
        return self.removed(*minus((weight, bias), (old_weight, old_bias)))

    def of_rows(self, rows: slice) -> Elementwise:
        return Elementwise(self.inside[rows])

    def remember(self, weight: Tensor, bias: Tensor | None) -> Remembered:
        return copied((weight, bias))

    def hold(self, weight: Tensor, bias: Tensor | None, before: Remembered) -> None:
        of_weight, of_bias = self.changed(weight, bias, before)
        weight.sub_(of_weight)
        if bias is not None and of_bias is not None:
            bias.sub_(of_bias)


@dataclass(frozen=True)
class TableRows:
    """Protection of a table: no row that VQA reads may change.

    Attributes:
        used: which rows VQA reads, [N] bool; [1] for a lone row, where it stands for the whole
            weight, whatever its shape.
        scores: protection of the head that the table is tied to; it applies to the other rows.
    """

    used: Tensor
    scores: Dense | None = None

    def removed(self, weight: Tensor, bias: Tensor | None) -> Pair:
        used = self.used.reshape(-1, *[1] * (weight.ndim - 1))  # broadcasts over a row's entries
        read = (weight * used).view_as(weight)
        if self.scores is None:
            return read, bias
        # Rows that are read are held already; the head protects the rest.
        scored, _ = self.scores.removed(weight - read, None)
        return read + scored, bias

    def of_rows(self, rows: slice) -> TableRows:
        # The flag of a lone row stands for all of it, however it is sliced.
        return self if len(self.used) == 1 else TableRows(self.used[rows], self.scores)

    def remember(self, weight: Tensor, bias: Tensor | None) -> Remembered:
        read = self._read(weight)
        along = () if self.scores is None else self.scores.remember(weight, None)
        return (read.clone(), *along)

    def hold(self, weight: Tensor, bias: Tensor | None, before: Remembered) -> None:
        read, *along = before
        assert read is not None
        # Copied back, not subtracted, so that these rows stay bit for bit the same.
        if len(self.used) > 1:
            weight.index_copy_(0, self._places, read)
        elif len(self._places):
            weight.copy_(read)
        if self.scores is not None:
            # The rows that are read are unchanged again; the head protects the others.
            self.scores.hold(weight, None, tuple(along))

    def _read(self, weight: Tensor) -> Tensor:
        """The rows that VQA reads; for a lone row, its whole weight if it is read."""
        if len(self.used) == 1:
            return weight if len(self._places) else weight.flatten()[:0]
        return weight.index_select(0, self._places)

    @cached_property
    def _places(self) -> Tensor:
        """Indices [n] of the rows that VQA reads; cached, as finding them forces a GPU sync."""
        return self.used.nonzero().squeeze(1)


@dataclass(frozen=True)
class Strength:
    """How much is protected.

    Attributes:
        energy: fraction of the input energy whose leading directions are protected, in (0, 1].
        soft: if above 0, every stored direction is protected instead, by c / (c + soft), where c is
            its fraction of the energy.
    """

    energy: float = 1.0
    soft: float = 0.0


def protect(
    read: Spectrum, strength: Strength, like: Tensor, scores: Spectrum | None = None
) -> Protection:
    """The protection of one map.

    Args:
        read: spectrum of the map's inputs on VQA. A table has no directions to weigh: every row
            that was read is protected.
        strength: how much is protected.
        like: gives dtype and device of the parameters; a dtype narrower than float32 is protected
            in float32.
        scores: spectrum of the head's inputs, for a table that is tied to a head.

    Raises:
        AegisError: a spectrum holds too few eigenvectors for that fraction of the energy.
    """
    like = like.new_empty(0, dtype=wide_type(like.dtype))
    if read.kind == "rows":
        head = None
        if scores is not None:
            head = _dense(scores, strength, like)
        return TableRows((read.values > 0).to(like.device), head)
    if read.kind == "elementwise":
        return Elementwise(_channels(read, strength).to(like))
    return _dense(read, strength, like)


def _dense(spectrum: Spectrum, strength: Strength, like: Tensor) -> Dense:
    """f is 1 (or soft) along protected directions; unresolved ones share one scalar."""
    assert spectrum.vectors is not None
    stored = spectrum.vectors.shape[1]
    if strength.soft > 0:
        # Fractions of the total energy, even if only the leading directions are stored.
        energy = spectrum.values.sum()
        factor = _soft(spectrum.values[:stored], energy, strength.soft)
        rest = float(_soft(spectrum.rest, energy, strength.soft))
        # If device and dtype match, `to` copies nothing, and U is shared with the anchor.
        return Dense(spectrum.vectors.to(like), factor.to(like), rest)
    count = rank(spectrum.values, strength.energy)
    if count > stored and not spectrum.whole:
        count = stored  # all that could be resolved
    if count > stored:
        share = strength.energy
        raise AegisError(
            f"{stored} eigenvectors of a map's inputs where a share of {share:g} of "
            f"their energy needs {count}",
            "an anchor measured up to that share",
            f"--set anchor.energy={strength.energy:g} and measure the anchor again",
        )
    leading = spectrum.vectors[:, :count].to(like)
    return Dense(leading, leading.new_ones(count))


def _channels(read: Spectrum, strength: Strength) -> Tensor:
    """U f U^T of each channel [D, m, m]; energy fractions are taken over all channels."""
    assert read.vectors is not None
    if strength.soft > 0:
        factor = _soft(read.values, read.values.sum(), strength.soft)
    else:
        factor = _leading(read.values, strength.energy)
    vectors = read.vectors.double()  # [D, m, m]
    scaled = vectors * factor[:, None, :]  # column j of each channel by f_j
    return scaled @ vectors.mT


def _soft(values: Tensor, energy: Tensor, soft: float) -> Tensor:
    """c / (c + soft) along each direction, where c is its fraction of the energy."""
    shares = ratio(values, energy)
    return shares / (shares + soft)


def _leading(values: Tensor, energy: float) -> Tensor:
    """1 at the leading directions that hold `energy`, 0 elsewhere; ties are treated alike."""
    count = rank(values, energy)
    if count == 0:
        return torch.zeros_like(values)
    # By value, not by index, which would separate equal values.
    last = values.flatten().sort(descending=True).values[count - 1]
    return (values >= last).to(values.dtype)


def stacked(found: Sequence[Protection]) -> Protection:
    """The protection of several maps, or normalisations, of one shape; a single one is unchanged.

    Raises:
        TypeError: tables, because each has a different set of rows that are read.
    """
    if len(found) == 1:
        return found[0]
    dense = [one for one in found if isinstance(one, Dense)]
    channels = [one for one in found if isinstance(one, Elementwise)]
    if len(dense) == len(found):
        factor = stacking.padded([one.factor for one in dense])
        rest = stacking.rests([float(one.rest) for one in dense], factor)
        return Dense(stacking.padded([one.basis for one in dense]), factor, rest)
    if len(channels) == len(found):
        return Elementwise(torch.stack([one.inside for one in channels]))
    raise TypeError("only maps or normalisations are stacked, not tables")


def allowed(protection: Protection, update: Pair) -> Pair:
    """The update without its protected part."""
    return minus(update, protection.removed(*update))


def protections(
    anchor: Anchor, weights: Mapping[str, Tensor], strength: Strength
) -> dict[str, Protection]:
    """The protection of each site in `weights` (its values give dtype and device).

    Raises:
        AegisError: a site that the anchor did not measure, or too few eigenvectors.
    """
    missing = sorted(weights.keys() - anchor.inputs.keys())
    if missing:
        raise AegisError(
            f"an anchor without the inputs of {', '.join(missing)}",
            "the inputs of every protected map",
            "measure it again with aegis anchor --parts moments,inputs",
        )
    found = {}
    for site, like in weights.items():
        scores = anchor.inputs.get(f"{site}.scores")
        found[site] = protect(anchor.inputs[site], strength, like, scores)
    return found
