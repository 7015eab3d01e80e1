"""Kronecker-factored curvature of the answers to VQA, and the proximal step that follows from it.

The Fisher information of a linear map's weights is close to a Kronecker product G (x) C (K-FAC,
Martens & Grosse 2015, arXiv 1503.05671). C belongs to the map's inputs x, and G to the gradients g
of log p(answer) at its outputs. K-FAC averages x x^T and g g^T separately. But most tokens belong
to an image, and no answer depends on most of those. So each token is weighted here by how strongly
the answers depend on it. With x and g of one output token, the partial traces of
E[(g g^T) (x) (x x^T)] give the factors

    C = E[|g|^2 x x^T],    G = E[|x|^2 g g^T]

In the eigenbases of both factors the product is diagonal, h_ij = g_i c_j. The penalty
(w / 2) sum_ij h_ij D_ij^2 on the displacement D = W - W0 then has the proximal step

    D_ij <- D_ij / (1 + w h_ij)

in closed form. It is stable for any w, and Adam does not rescale it, because it follows the
optimizer's step. Two choices are ours: g and c have mean 1, so that w depends neither on the scale
of the loss nor on the size of the map, and the outputs are damped,

    h_ij = (g_i + damping) c_j

Damping is needed because the Fisher information describes small steps only. An inactive unit has no
gradient, but a large step can activate it. Without damping, the weights may move freely along
outputs that no answer depends on yet, and that is where VQA ability was lost
(recipes/results/LOG.md). Inputs are not damped: weights may change along directions that VQA does
not read. K-FAC damps both factors, because it inverts them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from aegis_cli.common.errors import AegisError
from aegis_cli.core import stacking
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.numerics import ratio, wide_type
from aegis_cli.core.pairs import Pair
from aegis_cli.core.spectrum import Spectrum

# The largest weight of a proximal step; it removes everything that has curvature. A larger one may
# overflow float32, and infinity times a curvature of 0 is NaN.
_HEAVIEST = 1e30


@dataclass(frozen=True)
class Curvature:
    """The curvature at one linear map or convolution, or at several that are stacked.

    The matrix h is recomputed at each use, because it is as large as the weight. For n stacked maps
    (core/stacking.py) every tensor, displacements included, has a leading dimension n.

    Attributes:
        inputs: eigenvectors [d, k] of C; d includes the constant input of a bias, if there is one.
            They may be in half precision, and are upcast when they are used.
        outputs: eigenvectors [o, m] of G; likewise.
        c: relative eigenvalues of C [k]; the mean over all of them, stored or not, is 1.
        g: relative eigenvalues of G [m]; likewise.
        damping: added to each eigenvalue of G, including those that are not stored.
        c_rest, g_rest: relative eigenvalue along the directions that were never resolved; 0 if all
            were resolved, or if those left out hold next to nothing. For stacked maps [n, 1], or 0
            for all.
        total: sums a tensor over the processes, if each has some of the map's outputs; None if each
            has all.
    """

    inputs: Tensor
    outputs: Tensor
    c: Tensor
    g: Tensor
    damping: float
    c_rest: float | Tensor = 0.0
    g_rest: float | Tensor = 0.0
    total: Callable[[Tensor], Tensor] | None = None

    def of_rows(self, rows: slice, total: Callable[[Tensor], Tensor]) -> Curvature:
        """The curvature for a process that has only these outputs of the map.

        The rows are copied, so that those of the other processes need not stay in memory.
        """
        return replace(self, outputs=self.outputs[rows].clone(), total=total)

    def excess(self, weight: Tensor, bias: Tensor | None, strength: float | Tensor) -> Pair:
        """The part of a displacement that a proximal step removes.

        Args:
            weight: displacement of the map's weight, [o, ...].
            bias: displacement of its bias, [o].
            strength: the penalty's weight w; a tensor [] is never read on the host, which would
                force a GPU sync.
        """
        return self._weighed(weight, bias, bounded(strength), taken)

    def gradient(self, weight: Tensor, bias: Tensor | None, strength: float | Tensor) -> Pair:
        """The penalty's gradient at a displacement, w h_ij D_ij; arguments as in `excess`."""
        return self._weighed(weight, bias, strength, lambda wh: wh)

    def _weighed(
        self,
        weight: Tensor,
        bias: Tensor | None,
        strength: float | Tensor,
        factor: Callable[[Tensor], Tensor],
    ) -> Pair:
        """A displacement with its entries in the eigenbases multiplied by `factor(w h_ij)`."""
        # [o, d], or [n, o, d] for stacked maps, whose c is [n, k].
        flat = weight.flatten(self.c.ndim)
        width = flat.shape[-1]
        if bias is not None:
            # The bias is the weight of an input that is always 1.
            flat = torch.cat([flat, bias[..., None]], -1)
        flat = flat.to(self.c.dtype)
        inputs, outputs = self.inputs.to(flat.dtype), self.outputs.to(flat.dtype)
        floor, above = self._shares(strength, self.c, factor)
        rest, of_rest = self.c_rest, None
        if isinstance(rest, Tensor) or rest != 0:
            # Every input direction gets the share of the unresolved ones. Along the stored ones,
            # the difference from their own share is added below.
            if not isinstance(rest, Tensor):
                rest = self.c.new_full((1,), rest)
            of_rest = floor_rest, above_rest = self._shares(strength, rest, factor)
            floor, above = floor - floor_rest, above - above_rest
        # Along input direction j, every output loses the share floor_j, and stored output i loses
        # above_ij more.
        read = flat @ inputs  # [o, k]
        more = outputs @ (self._stored(outputs, read) * above)  # [o, k]
        found = (read * floor + more) @ inputs.mT  # [o, d]
        if of_rest is not None:
            floor_rest, above_rest = of_rest
            found += flat * floor_rest
            found += outputs @ (self._stored(outputs, flat) * above_rest)
        found_weight = found[..., :width].reshape(weight.shape)
        found_bias = None if bias is None else found[..., width]
        return found_weight, found_bias

    def _shares(
        self, strength: float | Tensor, c: Tensor, factor: Callable[[Tensor], Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Shares of a displacement along inputs of curvature c [k] or [1].

        Outputs outside the stored eigenvectors are damped too, so there is a share that all outputs
        have at least; the stored ones have more.

        Returns:
            The share of all outputs [1, k], and what each stored one has in addition [m, k].
        """
        least = strength * (self.g_rest + self.damping) * c  # w h_j of an output that is not stored
        floor = factor(least)[..., None, :]
        damped = self.g + self.damping
        h = damped[..., :, None] * c[..., None, :]  # (g_i + damping) c_j, [m, k]
        return floor, factor(strength * h) - floor

    def _stored(self, outputs: Tensor, read: Tensor) -> Tensor:
        """A displacement [o, k] along the stored outputs [m, k], summed over all processes."""
        stored = outputs.mT @ read
        # Each process has only some of the rows that this product sums over.
        return stored if self.total is None else self.total(stored)


def stacked(found: Sequence[Curvature]) -> Curvature:
    """The curvatures of several maps of one shape as one; a single one is returned as it is."""
    first = found[0]
    if len(found) == 1:
        return first
    # Padded directions are columns of zeros, so the share they get has no effect.
    return Curvature(
        inputs=stacking.padded([one.inputs for one in found]),
        outputs=stacking.padded([one.outputs for one in found]),
        c=stacking.padded([one.c for one in found]),
        g=stacking.padded([one.g for one in found]),
        damping=first.damping,
        c_rest=stacking.rests([float(one.c_rest) for one in found], first.c),
        g_rest=stacking.rests([float(one.g_rest) for one in found], first.g),
    )


def curvatures(
    anchor: Anchor, weights: Mapping[str, Tensor], damping: float
) -> dict[str, Curvature]:
    """The curvature of each map in `weights` (its values give dtype and device).

    Raises:
        AegisError: a map that the anchor did not measure.
    """
    factors = {site: (f"{site}.inputs", f"{site}.outputs") for site in weights}
    measured = anchor.curvature.keys()
    missing = sorted(site for site, pair in factors.items() if not measured >= set(pair))
    if missing:
        raise AegisError(
            f"an anchor without the curvature of {', '.join(missing)}",
            "the curvature of every map that learns",
            "measure it again with aegis anchor --parts moments,inputs,curvature",
        )
    # If some factors are sketched, the anchor file stores all of them in half precision. Keeping
    # them so halves their memory and changes a proximal step by a thousandth of what it removes.
    sketched = not all(spectrum.whole for spectrum in anchor.curvature.values())
    found = {}
    held: dict[tuple[int, torch.device], Tensor] = {}  # by the spectrum's id; the anchor keeps all
    for site, weight in weights.items():
        like = weight.new_empty(0, dtype=wide_type(weight.dtype))
        kept_in = like.half() if sketched else like
        inputs, outputs = (anchor.curvature[name] for name in factors[site])
        for spectrum in (inputs, outputs):
            # Queries, keys and values read the same input and share one tensor.
            if (id(spectrum), like.device) not in held:
                assert spectrum.vectors is not None
                held[id(spectrum), like.device] = spectrum.vectors.to(kept_in)
        found[site] = Curvature(
            inputs=held[id(inputs), like.device],
            outputs=held[id(outputs), like.device],
            c=_relative(inputs).to(like),
            g=_relative(outputs).to(like),
            damping=damping,
            c_rest=float(ratio(inputs.rest, inputs.values.mean())),
            g_rest=float(ratio(outputs.rest, outputs.values.mean())),
        )
    return found


def _relative(spectrum: Spectrum) -> Tensor:
    """The eigenvalues that have an eigenvector, over the mean of all; zeros stay zeros."""
    assert spectrum.vectors is not None
    stored = spectrum.vectors.shape[1]
    # The mean is over all directions, including those without an eigenvector.
    return ratio(spectrum.values, spectrum.values.mean())[:stored]


def bounded(strength: float | Tensor) -> float | Tensor:
    """A penalty's weight w, capped where a proximal step already removes all but rounding."""
    if isinstance(strength, Tensor):
        return strength.clamp(max=_HEAVIEST)
    return min(strength, _HEAVIEST)


def taken(wh: Tensor) -> Tensor:
    """The share of a displacement that a proximal step removes: 1 - 1 / (1 + w h), from w h."""
    wh = wh.clamp(max=_HEAVIEST)  # infinity / infinity is NaN
    # Computed as 1 - 1 / (1 + w h), a small share would be 0: 1 + 1e-8 is 1 in float32.
    return wh / (1 + wh)
