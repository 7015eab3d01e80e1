"""How much VQA's answers mind a map's displacement, and the map drawn back along it.

The Fisher information of a linear map's weights is close to a Kronecker product (K-FAC, Martens &
Grosse 2015, arXiv 1503.05671): G (x) C, of the map's inputs x and of the gradients g of log
p(answer) at its outputs. K-FAC takes the means of x x^T and g g^T apart. Most tokens are of an
image, and most of those no answer asks about; so here each token counts as much as answers mind it.
The factors that fit E[(g g^T) (x) (x x^T)], x and g being one output token's, by its partial traces
are

    C = E[|g|^2 x x^T],    G = E[|x|^2 g g^T]

In the eigenbases of both the product is diagonal, h_ij = g_i c_j, and the penalty
(w / 2) sum_ij h_ij D_ij^2 on the displacement D = W - W0 has the proximal step

    D_ij <- D_ij / (1 + w h_ij)

in closed form: stable for any w, and taken after the optimizer's step, so that no Adam rescales it.
Ours: g and c have mean 1, so that w depends neither on the loss's scale nor on the map's size, and
the outputs are damped,

    h_ij = (g_i + damping) c_j

The Fisher information is that of small steps. A unit that is off has no gradient, and a large step
turns it on: outputs that answers do not mind now are where an undamped penalty lets the weights
run, and where the harm is then done (recipes/results/LOG.md). Inputs are not damped: what VQA does
not read is free. K-FAC damps both factors, to invert them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from aegis_cli.common.errors import AegisError
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.nullspace import Pair
from aegis_cli.core.projection import ratio
from aegis_cli.core.spectrum import Spectrum


@dataclass(frozen=True)
class Curvature:
    """Of a linear map or convolution.

    Attributes:
        inputs: eigenvectors [d, k] of C, d counting the bias's 1 if there is one.
        outputs: eigenvectors [o, m] of G.
        c: relative eigenvalues of C [k]; of all of them, those left out included, the mean is 1.
        g: those of G [m]. h is made anew when it is used: it is as large as the map.
        damping: what is added to each eigenvalue of G, those left out included.
    """

    inputs: Tensor
    outputs: Tensor
    c: Tensor
    g: Tensor
    damping: float

    def excess(self, weight: Tensor, bias: Tensor | None, strength: float) -> Pair:
        """The part of a displacement of its weight and bias that a proximal step of this strength
        takes away.
        """
        flat = (
            weight.flatten(1) if bias is None else torch.cat([weight.flatten(1), bias[:, None]], 1)
        )
        read = flat @ self.inputs
        of_all = _taken(
            strength * self.damping * self.c
        )  # of each output, as if answers minded none
        minded = _taken(strength * torch.outer(self.g + self.damping, self.c))
        lost = read * of_all + self.outputs @ ((self.outputs.T @ read) * (minded - of_all))
        lost = lost @ self.inputs.T
        width = weight[0].numel()
        return lost[:, :width].reshape(weight.shape), None if bias is None else lost[:, width]


def curvatures(
    anchor: Anchor, weights: Mapping[str, Tensor], damping: float
) -> dict[str, Curvature]:
    """The curvature of each map in `weights` (its values give dtype and device).

    Raises:
        AegisError: a map that the anchor did not measure.
    """
    factors = {site: (f"{site}.inputs", f"{site}.outputs") for site in weights}
    if missing := sorted(
        site for site, pair in factors.items() if not anchor.curvature.keys() >= set(pair)
    ):
        raise AegisError(
            f"an anchor without the curvature of {', '.join(missing)}",
            "that of every map that learns",
            "measure it again with aegis anchor --parts moments,inputs,curvature",
        )
    read = {site: [anchor.curvature[name] for name in pair] for site, pair in factors.items()}
    return {site: _of(*read[site], like, damping) for site, like in weights.items()}


def _of(inputs: Spectrum, outputs: Spectrum, like: Tensor, damping: float) -> Curvature:
    assert inputs.vectors is not None and outputs.vectors is not None
    like = like.new_empty(0, dtype=torch.promote_types(like.dtype, torch.float32))
    c = _relative(inputs)[: inputs.vectors.shape[1]]
    g = _relative(outputs)[: outputs.vectors.shape[1]]
    return Curvature(*(t.to(like) for t in (inputs.vectors, outputs.vectors, c, g)), damping)


def _relative(spectrum: Spectrum) -> Tensor:
    """Its values divided by their mean; zeros stay zeros."""
    return ratio(spectrum.values, spectrum.values.mean())


def _taken(strength: Tensor) -> Tensor:
    """The share of a direction that a proximal step takes away."""
    return strength / (1 + strength)
