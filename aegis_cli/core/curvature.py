"""How much VQA's answers mind a map's displacement, and the map drawn back along it.

The Fisher information of a linear map's weights is close to a Kronecker product (K-FAC, Martens & Grosse 2015, arXiv
1503.05671): G (x) C, of the map's inputs x and of the gradients g of log p(answer) at its outputs. K-FAC takes the means of
x x^T and g g^T apart. Most tokens are of an image, and most of those no answer asks about; so here each token counts as much as
answers mind it. The factors that fit E[(g g^T) (x) (x x^T)], x and g being one output token's, by its partial traces are

    C = E[|g|^2 x x^T],    G = E[|x|^2 g g^T]

In the eigenbases of both the product is diagonal, h_ij = g_i c_j, and the penalty
(w / 2) sum_ij h_ij D_ij^2 on the displacement D = W - W0 has the proximal step

    D_ij <- D_ij / (1 + w h_ij)

in closed form: stable for any w, and taken after the optimizer's step, so that no Adam rescales it. Ours: h has mean 1 over
a map's entries, so that w depends neither on the loss's scale nor on the map's size.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from aegis_cli.core.anchor import Anchor
from aegis_cli.core.nullspace import Pair
from aegis_cli.core.projection import ratio
from aegis_cli.core.spectrum import Spectrum
from aegis_cli.errors import AegisError


@dataclass(frozen=True)
class Curvature:
    """Of a linear map or convolution.

    Attributes:
        inputs: eigenvectors [d, k] of C, d counting the bias's 1 if there is one.
        outputs: eigenvectors [o, m] of G.
        c: relative eigenvalues of C [k]; of all of them, those left out included, the mean is 1.
        g: those of G [m]. h = g c^T is made anew when it is used: it is as large as the map.
    """

    inputs: Tensor
    outputs: Tensor
    c: Tensor
    g: Tensor

    def excess(self, weight: Tensor, bias: Tensor | None, strength: float) -> Pair:
        """The part of a displacement of its weight and bias that a proximal step of this strength takes away."""
        flat = weight.flatten(1) if bias is None else torch.cat([weight.flatten(1), bias[:, None]], 1)
        inside = torch.linalg.multi_dot((self.outputs.T, flat, self.inputs))  # in the order that costs least
        scaled = torch.outer(strength * self.g, self.c)
        lost = torch.linalg.multi_dot((self.outputs, inside * scaled / (1 + scaled), self.inputs.T))
        width = weight[0].numel()
        return lost[:, :width].reshape(weight.shape), None if bias is None else lost[:, width]


def curvatures(anchor: Anchor, weights: Mapping[str, Tensor]) -> dict[str, Curvature]:
    """The curvature of each map in `weights` (its values give dtype and device).

    Raises:
        AegisError: a map that the anchor did not measure.
    """
    factors = {site: (f"{site}.inputs", f"{site}.outputs") for site in weights}
    if missing := sorted(site for site, pair in factors.items() if not anchor.curvature.keys() >= set(pair)):
        raise AegisError(
            f"an anchor without the curvature of {', '.join(missing)}",
            "that of every map that learns",
            "measure it again with aegis anchor --parts moments,inputs,curvature",
        )
    read = {site: [anchor.curvature[name] for name in pair] for site, pair in factors.items()}
    return {site: _of(*read[site], like) for site, like in weights.items()}


def _of(inputs: Spectrum, outputs: Spectrum, like: Tensor) -> Curvature:
    assert inputs.vectors is not None and outputs.vectors is not None
    like = like.new_empty(0, dtype=torch.promote_types(like.dtype, torch.float32))
    c = _relative(inputs)[: inputs.vectors.shape[1]]
    g = _relative(outputs)[: outputs.vectors.shape[1]]
    return Curvature(*(t.to(like) for t in (inputs.vectors, outputs.vectors, c, g)))


def _relative(spectrum: Spectrum) -> Tensor:
    """Its values divided by their mean; zeros stay zeros."""
    return ratio(spectrum.values, spectrum.values.mean())
