"""Draw what has moved back along the curvature of VQA's answers, map by map, after every few steps.

The proximal step of (w / 2) sum h_ij (W - W0)_ij^2 in the eigenbases of K-FAC's two factors (see core/curvature.py): elastic
weight consolidation with a Kronecker-factored Fisher information in place of a diagonal one (structured Laplace,
Ritter et al. 2018, arXiv 1805.07810), applied to the weights as AdamW applies its decay, not to a gradient that Adam
would rescale. It differs from `nullspace` in two ways: directions that VQA reads but whose outcome its answers do not mind are
free, and it acts on all that has moved since the start, so that what the loss does not keep asking for returns.

`balance` undoes one thing that Adam does. Each of its updates has the same size in every tensor, however small the tensor's
gradient; a map with little to learn moves as far as the others, by noise, and VQA pays for it. So the update of
a map is scaled by r / (r + balance R), r being the root mean square of its gradient and R that of all maps' together.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from aegis_cli.core import curvature
from aegis_cli.core.nullspace import Pair, copied, minus
from aegis_cli.core.projection import ratio
from aegis_cli.methods.base import Method, Parts, Setting, Update, before, train_all, weights


def start(setting: Setting) -> Parts:
    """Draw every site back towards the weights that it has now; weight 0 is naive."""
    weight, balance = setting.options["weight"], setting.options["balance"]
    if weight == 0:
        return Parts()
    assert setting.anchor is not None
    likes = {site: weights(setting.backbone, site)[0] for site in setting.sites}
    curvatures = curvature.curvatures(setting.anchor, likes)
    origin = {site: copied(weights(setting.backbone, site)) for site in curvatures}

    @torch.no_grad()
    def constrain(update: Update) -> None:
        now = {site: weights(setting.backbone, site) for site in curvatures}
        for site, share in shares(now, balance).items():
            then = before(site, now[site], update)
            moved = _sum(minus(then, origin[site]), minus(now[site], then), share)
            _place(now[site], origin[site], curvature.drawn_back(curvatures[site], moved, weight * update.steps))

    return Parts(constrain=constrain, every=setting.options["every"])


def shares(maps: Mapping[str, Pair], balance: float) -> dict[str, Tensor]:
    """r / (r + balance R) of each map, from the gradients that are there; 0 where there is none, 1 where no map has one."""
    squares = {site: _squares(pair) for site, pair in maps.items()}
    entries = {site: sum(t.numel() for t in pair if t is not None) for site, pair in maps.items()}
    whole = (torch.stack(list(squares.values())).sum() / sum(entries.values())).sqrt()
    rms = {site: (squares[site] / entries[site]).sqrt() for site in maps}
    return {site: torch.where(whole > 0, ratio(r, r + balance * whole), 1.0) for site, r in rms.items()}


def _squares(pair: Pair) -> Tensor:
    """Sum of the squared gradient of weight and bias, float64."""
    total = torch.zeros((), dtype=torch.float64, device=pair[0].device)
    for tensor in pair:
        if tensor is not None and tensor.grad is not None:
            total += tensor.grad.double().square().sum()
    return total


def _sum(a: Pair, b: Pair, factor: Tensor) -> Pair:
    """a + factor b."""
    factor = factor.to(a[0])
    return a[0] + factor * b[0], None if a[1] is None or b[1] is None else a[1] + factor * b[1]


def _place(now: Pair, origin: Pair, moved: Pair) -> None:
    for tensor, from_, by in zip(now, origin, moved, strict=True):
        if tensor is not None and from_ is not None and by is not None:
            torch.add(from_, by, out=tensor.data)


METHOD = Method(
    "kfac",
    "what has moved is drawn back along the curvature of VQA's answers",
    train_all,
    start=start,
    needs=frozenset({"inputs", "outputs"}),
)
