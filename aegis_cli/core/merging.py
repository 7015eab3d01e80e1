"""Moving a fine-tuned map back towards its pre-trained weights where the new task allows it.

D [o, d] is how far a map's weights have moved, W_tuned - W_pretrained, with the bias as its last
column. C_r [d, d] and G_r [o, o] are the second moments of the map's inputs and of the gradients at
its outputs on the task (robot frames), C_v and G_v those on questions. The gradients on questions
are those of answers sampled from the model itself, so G_v is a factor of the Fisher information.
The gradients on the task are those of its loss, so G_r is a factor of the empirical Fisher
information. Under the Kronecker-factored curvature (K-FAC, arXiv 1503.05671) of both losses, the
part of D that is kept is the X that minimises

    tr(G_r (X - D) C_r (X - D)^T) + s tr(G_v X C_v X^T)

The first term is what the task loses if X replaces D, the second what the questions lose if X
replaces 0, and s weighs the second. At the minimum the gradient vanishes:

    G_r (X - D) C_r + s G_v X C_v = 0

That is a generalised Sylvester equation. It becomes diagonal in the generalised eigenbases P of
(C_r, C_v) and Q of (G_r, G_v), which are scaled here so that

    P^T C_r P = diag(a),  P^T C_v P = diag(1 - a),  Q^T G_r Q = diag(b),  Q^T G_v Q = diag(1 - b)

With X = Q Z P^T and D = Q E P^T, multiplying by Q^T from the left and by P from the right gives

    Z_ij = E_ij b_i a_j / (b_i a_j + s (1 - b_i) (1 - a_j))

So a and b, between 0 and 1, say how much a direction belongs to the task. Limits: s = 0 keeps D,
s -> infinity keeps nothing that questions read, and C_r = C_v with G_r = G_v gives D / (1 + s), the
straight line between both models (WiSE-FT, arXiv 2109.01903). With identities as G_r and G_v, b is
1/2 and X = D C_r (C_r + s C_v)^-1, which needs no gradients.

Two choices are ours, as in core/curvature.py. Every moment is divided by its mean eigenvalue, so
that s depends neither on the scale of a loss nor on the size of the map. It is then damped:
`damping` is added to every eigenvalue, because both curvatures describe small steps only.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from aegis_cli.common.errors import AegisError
from aegis_cli.core.numerics import ratio
from aegis_cli.core.pairs import Pair, from_matrix, matrix
from aegis_cli.core.spectrum import Spectrum


@dataclass(frozen=True)
class Basis:
    """A basis in which two positive definite matrices A and B [n, n] are both diagonal.

    Attributes:
        vectors: T [n, n] with T^T A T = diag(share) and T^T B T = diag(1 - share).
        inverse: T^-1.
        share: [n], between 0 and 1.
    """

    vectors: Tensor
    inverse: Tensor
    share: Tensor


@dataclass(frozen=True)
class TwoSided:
    """How much of its displacement one map keeps, in the two bases of the module's docstring.

    Attributes:
        inputs: basis of (C_r, C_v).
        outputs: basis of (G_r, G_v); None if both are the identity.
    """

    inputs: Basis
    outputs: Basis | None = None

    def kept(self, moved: Pair, strength: float) -> Pair:
        """The X of the module's docstring, in the shapes of the displaced weight and bias."""
        return from_matrix(self.kept_matrix(matrix(moved), strength), moved)

    def kept_matrix(self, moved: Tensor, strength: float) -> Tensor:
        """X [o, d] for the displacement D [o, d], float64."""
        a, p = self.inputs.share, self.inputs
        in_bases = moved.double() @ p.inverse.T  # D P^-T
        if self.outputs is None:
            # With b = 1/2 everywhere, b cancels: the share is a / (a + s (1 - a)).
            return (in_bases * _share(a, 1 - a, strength)) @ p.vectors.T
        b, q = self.outputs.share, self.outputs
        share = _share(torch.outer(b, a), torch.outer(1 - b, 1 - a), strength)  # [o, d]
        kept = q.inverse @ in_bases * share  # Z, of E = Q^-1 D P^-T
        return q.vectors @ kept @ p.vectors.T


def basis(task: Tensor, questions: Tensor) -> Basis:
    """The generalised eigenbasis of two positive definite matrices [n, n], in float64.

    Raises:
        AegisError: the damping is below rounding, so they are not positive definite.
    """
    task, questions = task.double(), questions.double()
    # With A + B = L L^T, the eigenvalues of L^-1 A L^-T are the shares of A, from 0 to 1. Those of
    # B^-1 A are unbounded and lose digits if B is nearly singular.
    root, failed = torch.linalg.cholesky_ex(task + questions)
    if failed:
        raise AegisError(
            f"too little damping (less than rounding) for second moments of {len(task)} directions",
            "enough for a Cholesky factor of both together",
            "use a damping of 1e-6 or more: --damping, or merge.damping in a recipe",
        )
    half = torch.linalg.solve_triangular(root, task, upper=False)  # L^-1 A
    whitened = torch.linalg.solve_triangular(root, half.T, upper=False)  # L^-1 A L^-T
    # eigh reads one triangle only; the mean of both has less rounding from the solver.
    share, turn = torch.linalg.eigh((whitened + whitened.T) / 2)
    # T = L^-T V with eigenvectors V: T^T (A + B) T is V^T V = 1, so T^T B T is 1 - share.
    vectors = torch.linalg.solve_triangular(root.T, turn, upper=True)
    inverse = turn.T @ root.T
    return Basis(vectors, inverse, share.clamp(0, 1))  # rounding may exceed either bound


def damped(spectrum: Spectrum, damping: float) -> Tensor:
    """The second moment [n, n] of a dense map, divided by its mean eigenvalue and damped.

    Directions whose eigenvectors were not stored share the remaining energy evenly.
    """
    assert spectrum.vectors is not None
    values, vectors = spectrum.values.double(), spectrum.vectors.double()
    values = ratio(values, values.mean())
    stored, left_out = values[: vectors.shape[1]], values[vectors.shape[1] :]
    rest = left_out.mean() if len(left_out) else values.new_zeros(())
    # V diag(stored) V^T + rest (1 - V V^T), computed without the unstored directions.
    whole = (vectors * (stored - rest)) @ vectors.T
    whole.diagonal().add_(rest + damping)
    return (whole + whole.T) / 2


def _share(task: Tensor, questions: Tensor, strength: float) -> Tensor:
    """task / (task + strength * questions); 1 where neither depends on the direction."""
    against = strength * questions
    return torch.where(against > 0, ratio(task, task + against), 1.0)
