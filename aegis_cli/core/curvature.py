"""How much VQA's answers mind a map's displacement, and the map drawn back along it.

The Fisher information of a linear map's weights is close to a Kronecker product (K-FAC, Martens & Grosse 2015, arXiv
1503.05671): G (x) C, with C = E[x x^T] of the map's inputs and G = E[g g^T] of the gradients of log p(answer) at its
outputs, g being one output token's. In the eigenbases of both it is diagonal, h_ij = g_i c_j, and the penalty
(w / 2) sum_ij h_ij D_ij^2 on the displacement D = W - W0 has the proximal step

    D_ij <- D_ij / (1 + w h_ij)

in closed form: stable for any w, and taken after the optimizer's step, so that no Adam rescales it. Ours: h has mean 1 over
a map's entries, so that w depends neither on the loss's scale nor on the map's size.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from aegis_cli.core.anchor import Anchor
from aegis_cli.core.nullspace import Pair, Protection, Strength, minus, protect
from aegis_cli.core.projection import ratio
from aegis_cli.core.spectrum import Spectrum
from aegis_cli.errors import AegisError

_HELD = Strength(energy=1.0, soft=1e-6)  # every direction that VQA reads at all, of those that the anchor stores


class Curvature(Protocol):
    """What holds for one map."""

    def excess(self, weight: Tensor, bias: Tensor | None, strength: float) -> Pair:
        """The part of a displacement of its weight and bias that a proximal step of this strength takes away."""


@dataclass(frozen=True)
class Dense:
    """A linear map or convolution.

    Attributes:
        inputs: eigenvectors [d, k] of its inputs' second moment, d counting the bias's 1 if there is one.
        outputs: eigenvectors [o, m] of its output gradients' second moment.
        curvature: h [m, k].
    """

    inputs: Tensor
    outputs: Tensor
    curvature: Tensor

    def excess(self, weight: Tensor, bias: Tensor | None, strength: float) -> Pair:
        flat = weight.flatten(1) if bias is None else torch.cat([weight.flatten(1), bias[:, None]], 1)
        inside = self.outputs.T @ flat @ self.inputs
        scaled = strength * self.curvature
        lost = self.outputs @ (inside * scaled / (1 + scaled)) @ self.inputs.T
        width = weight[0].numel()
        return lost[:, :width].reshape(weight.shape), None if bias is None else lost[:, width]


@dataclass(frozen=True)
class Fixed:
    """A normalisation, a table or a lone row: along what VQA reads of it, it stays as it is."""

    protection: Protection

    def excess(self, weight: Tensor, bias: Tensor | None, strength: float) -> Pair:
        return self.protection.removed(weight, bias)


def curvatures(anchor: Anchor, weights: Mapping[str, Tensor]) -> dict[str, Curvature]:
    """The curvature at each site in `weights` (its values give dtype and device).

    Raises:
        AegisError: a site that the anchor did not measure.
    """
    if missing := sorted(weights.keys() - anchor.inputs.keys()):
        raise AegisError(
            f"an anchor without the inputs of {', '.join(missing)}",
            "the inputs of every map that learns",
            "measure it again with aegis anchor --parts moments,inputs,outputs",
        )
    return {site: _of(site, anchor, like) for site, like in weights.items()}


def _of(site: str, anchor: Anchor, like: Tensor) -> Curvature:
    read = anchor.inputs[site]
    if read.kind != "dense":
        return Fixed(protect(read, _HELD, like, anchor.inputs.get(f"{site}.scores")))
    if site not in anchor.outputs:
        raise AegisError(
            f"an anchor without the output gradients of {site}",
            "those of every map that learns",
            "measure it again with aegis anchor --parts moments,inputs,outputs",
        )
    return _dense(read, anchor.outputs[site], like.new_empty(0, dtype=torch.promote_types(like.dtype, torch.float32)))


def _dense(inputs: Spectrum, outputs: Spectrum, like: Tensor) -> Dense:
    assert inputs.vectors is not None and outputs.vectors is not None
    c = _relative(inputs.values)[: inputs.vectors.shape[1]]
    g = _relative(outputs.values)[: outputs.vectors.shape[1]]
    return Dense(inputs.vectors.to(like), outputs.vectors.to(like), torch.outer(g, c).to(like))


def _relative(values: Tensor) -> Tensor:
    """Divided by their mean; zeros stay zeros."""
    return ratio(values, values.mean())


@torch.no_grad()
def drawn_back(curvature: Curvature, displacement: Pair, strength: float) -> Pair:
    """The displacement after the proximal step."""
    return minus(displacement, curvature.excess(*displacement, strength))
