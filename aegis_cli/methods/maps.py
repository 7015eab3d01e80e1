"""MAPS (arXiv 2511.19878): hold modules to their pre-trained weights, most firmly near the pixels.

It applies Selective Projection Decay (SPD, arXiv 2411.01713) after the optimizer's step. If
c = -<g, theta_before - theta0> < 0, that is, if a step along -g leads back towards theta0 although
momentum may have carried the weights further away,

    theta <- theta - lambda_k r (theta - theta0),
    r = max(0, |theta - theta0| - |theta_before - theta0|) / |theta - theta0|.

Condition and ratio are those of SPD; each tensor has its own, as in its authors' code. lambda = 1
keeps the distance from before the step. From MAPS comes lambda_k = weight (1 - k / (K - 1)), linear
from the first of K modules to 0 at the last, with weights of 0.5 to 3.2. Our choices are the order
of the modules, which are this backbone's parameter groups (any vision first, then embeddings, the
layers, the final norm and a head), and a cap of 1 on lambda_k r, so that theta0 is never overshot.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor, nn

from aegis_cli.common.ranks import rows_here
from aegis_cli.core import projection
from aegis_cli.core.numerics import ratio
from aegis_cli.methods.base import Method, MethodContext, Parts, Update, train_all
from aegis_cli.models.backbones.base import Backbone


def start(context: MethodContext[Backbone]) -> Parts:
    """Hold every parameter to its current value, with the strength of its group."""
    weight = context.options["weight"]
    if weight == 0:
        return Parts()
    learning, reference = context.learning(), context.reference()
    owners = context.owners  # not the context, which would keep the whole anchor in memory
    # All groups count, so that freezing one does not change how the others are held.
    groups = context.backbone.parameter_groups()
    of_group = schedule(groups, weight)
    strengths: dict[int, float] = {}
    for group, parameters in groups.items():
        strengths |= {id(p): of_group[group] for p in parameters}

    @torch.no_grad()
    def constrain(update: Update) -> None:
        chosen = []
        for name, parameter in learning.items():
            gradient = parameter.grad
            if gradient is not None and strengths[id(parameter)] > 0:
                chosen.append((parameter, gradient, update.before[name], reference[name]))
        if not chosen:
            return
        products = torch.stack([_products(*four) for four in chosen])  # [chosen, 3]
        products = owners.total(products)  # one message for all parameters
        for (parameter, _, _, origin), found in zip(chosen, products, strict=True):
            _project(parameter, origin, found, strengths[id(parameter)])

    return Parts(constrain=constrain)


def schedule(groups: Iterable[str], weight: float) -> dict[str, float]:
    """lambda_k of each group: `weight` at the first, decreasing linearly to 0 at the last.

    A single group has `weight`.
    """
    ordered = sorted(groups, key=_depth)
    last = max(1, len(ordered) - 1)  # K - 1; a single group would divide by 0
    strengths = {}
    for k, group in enumerate(ordered):
        strengths[group] = weight * (1 - k / last)
    return strengths


def _depth(group: str) -> tuple[int, int]:
    """Sort key of a group, from the pixels to the answer; an unknown name counts as vision."""
    if group.startswith("layers."):
        return 2, int(group.removeprefix("layers."))
    return {"embeddings": 1, "final_norm": 3, "head": 4}.get(group, 0), 0


def _products(parameter: nn.Parameter, gradient: Tensor, before: Tensor, origin: Tensor) -> Tensor:
    """<now, now>, <was, was> and <gradient, was> [3] of the displacements now and before."""
    here, start = rows_here(parameter), rows_here(origin)
    now, was = here - start, rows_here(before) - start
    # In float64, because the two distances differ by only one step in thousands.
    pairs = ((now, now), (was, was), (rows_here(gradient), was))
    return torch.stack([projection.dot(x, y) for x, y in pairs])


def _project(parameter: nn.Parameter, origin: Tensor, products: Tensor, strength: float) -> None:
    """Undo SPD's share of a parameter's displacement, given its `_products`."""
    now = rows_here(parameter) - rows_here(origin)
    far, near = products[:2].sqrt()  # |theta - theta0|, |theta_before - theta0|
    uphill = products[2]  # -c
    # r; 0 for a parameter that has not left theta0.
    grown = ratio(torch.relu(far - near), far)
    # A share above 1 would overshoot the pre-trained value.
    share = torch.where(uphill > 0, (strength * grown).clamp(max=1), 0.0)
    rows_here(parameter).sub_(share * now)


METHOD = Method("maps", "held to the pre-trained weights, vision most", train_all, start=start)
