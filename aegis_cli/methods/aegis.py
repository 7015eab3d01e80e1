"""AEGIS (arXiv 2604.16067): project each layer's task gradient off its anchor gradient.

For each parameter group, let g be the task gradient, a the gradient of the transport penalty and
d = <g, a>. If d < 0 (the paper's eq. 12-14, but without the epsilon in the denominator, with which
the result would not be orthogonal):

    g <- g - (d / <a, a>) a

The options are ours, not the paper's:

    scope, weighting  which tokens are compared, and how layers are weighted
    groups            which parameter groups are projected
    restoration       lambda of an added restoring term, g + lambda a
    projects          what is projected: the gradient, the *applied* update D (a conflict is
                      <D, a> > 0), or both. Adam scales elementwise, so an orthogonal gradient does
                      not give an orthogonal update.
    idle: kept        a is 0 wherever g is 0, so that the projection moves nothing that the task
                      does not: most of the last layer, since the expert reads only its keys and
                      values
    refresh           steps that share one a, computed at the first of them
    fraction          fraction of the batch that a is computed on
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from aegis_cli.common import devices
from aegis_cli.common.errors import AegisError
from aegis_cli.common.ranks import ALONE, Ranks, rows_here
from aegis_cli.core import projection
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.moments import (
    Moments,
    batch_moments,
    joint_moments,
    merge,
    shared_moments,
)
from aegis_cli.core.numerics import ratio, wide_type
from aegis_cli.core.transport import layer_weights, transport_penalty
from aegis_cli.methods.base import Method, MethodContext, Parts, Pass, Update, train_all

LANGUAGE = "layers."


def start(context: MethodContext) -> Parts:
    """Start the method of the paper, or a variant of it.

    Raises:
        AegisError: the options leave no group to project.
    """
    options = context.options
    assert context.anchor is not None
    chosen = {}
    for name in context.groups:
        chosen[name] = options["groups"] == "all" or name.startswith(LANGUAGE)
    if not any(chosen.values()):
        raise AegisError(
            f"aegis.groups: {options['groups']} with no language layer that learns",
            "a group to project",
            "--set aegis.groups=all, or freeze less",
        )
    like = next(p for group in context.groups.values() for p in group)
    # The anchor is compared in float32, even if the weights are bfloat16.
    like = like.new_empty(0, dtype=wide_type(like.dtype))
    projects = options["projects"]
    # In the order of the groups, like the inner products [G].
    combine = _combine(list(chosen.values()), projects != "update", options["restoration"])
    return Parts(
        penalty=_penalty(context.anchor, options["scope"], options["weighting"], like),
        combine=combine,
        refresh=options["refresh"],
        fraction=options["fraction"],
        keeps_idle=options["idle"] == "kept",
        constrain=None if projects == "gradient" else _constrain(context, chosen),
    )


# --- the anchor gradient --------------------------------------------------------------------------


@dataclass
class _Target:
    """The reference for the tokens of one type.

    Attributes:
        scope: which tokens: `all`, `image` or `text`.
        anchor: their Gaussian in the pre-trained backbone, one per layer.
        weights: weight of each layer's distance [L].
    """

    scope: str
    anchor: Sequence[Moments]
    weights: Tensor

    def cost(self, seen: Pass) -> tuple[Tensor, Tensor]:
        """The transport cost of a pass, with its graph, and W2^2 of each layer [L]."""
        self._follow(seen.hidden[0].device)
        everything = torch.ones_like(seen.image)  # [T] or [B, T], as `image` is
        inside = {"all": everything, "image": seen.image, "text": ~seen.image}
        # In a user's own model the layers may span several GPUs; the Gaussians are on one.
        at = self.anchor[0].mean.device
        found = []
        for mean, variance in _moments(seen, seen.mask & inside[self.scope]):
            found.append((mean.to(at), variance.to(at)))
        return transport_penalty(found, self.anchor, self.weights)

    def _follow(self, device: torch.device) -> None:
        """Move the anchor to the hidden states' device, in case the model has been moved."""
        if self.anchor[0].mean.device != device:
            self.anchor = [layer.to(device) for layer in self.anchor]
            self.weights = self.weights.to(device)


def _penalty(
    anchor: Anchor, scope: str, weighting: str, like: Tensor
) -> Callable[[Pass], tuple[Tensor, Tensor]]:
    """The transport cost over the tokens in scope, as a function of a pass.

    The scope `each` averages the costs of image and of text tokens.

    Raises:
        AegisError: the anchor saw no tokens in scope.
    """
    measured: dict[str, Sequence[Moments]] = {"image": anchor.image, "text": anchor.text}
    # Merged, so that every token counts the same; `each` gives both types equal weight instead.
    merged = []
    for of_image, of_text in zip(anchor.image, anchor.text, strict=True):
        merged.append(merge(of_image, of_text))
    measured["all"] = merged
    scopes = ("image", "text") if scope == "each" else (scope,)
    for name in scopes:
        if not measured[name][0].count:
            raise AegisError(
                f"an anchor of prompts without {name} tokens, and the scope '{scope}'",
                f"{name} tokens to compare with",
                "choose the scope 'all', or measure the anchor on prompts that have them",
            )
    targets = []
    for name in scopes:
        layers = [layer.to(like) for layer in measured[name]]
        # Created once, because the checks force a GPU sync.
        targets.append(_Target(name, layers, layer_weights(layers, weighting)))

    def penalty(seen: Pass) -> tuple[Tensor, Tensor]:
        costs, distances = zip(*(target.cost(seen) for target in targets), strict=True)
        return torch.stack(costs).mean(), torch.stack(distances).mean(0)

    return penalty


def _moments(seen: Pass, mask: Tensor) -> Sequence[tuple[Tensor, Tensor]]:
    """Mean [D] and variance [D] of each layer over the tokens of a pass in the mask [B, T]."""
    # On a GPU, selecting rows would force a sync per layer.
    waits = devices.reading_stalls(mask.device)
    if seen.total is not None:
        return shared_moments(seen.hidden, mask, seen.total, reads=not waits)
    if waits:
        return joint_moments(seen.hidden, mask)
    return [batch_moments(hidden, mask) for hidden in seen.hidden]


# --- the projection -------------------------------------------------------------------------------


def _combine(chosen: Sequence[bool], project: bool, restoration: float) -> projection.Combine:
    rule = projection.aegis if project else projection.naive
    counts = torch.tensor(chosen, device="cpu")

    def combine(tt: Tensor, ta: Tensor, aa: Tensor) -> tuple[Tensor, Tensor]:
        nonlocal counts  # moved to the gradients' device once, at the first step
        task, anchor = rule(tt, ta, aa)
        counts = devices.send(counts, anchor.device)
        # lambda is added to the projection's own weight. A group that is not chosen keeps its task
        # gradient, bit for bit.
        return task, (anchor + restoration) * counts

    return combine


def _constrain(context: MethodContext, chosen: Mapping[str, bool]) -> Callable[[Update], None]:
    names = {id(p): name for name, p in context.learning().items()}
    owners = context.owners  # not the context, which would keep the whole anchor in memory
    groups = []
    for group_name, group in context.groups.items():
        if chosen[group_name]:
            groups.append([p for p in group if id(p) in names])

    @torch.no_grad()
    def constrain(update: Update) -> None:
        for group in groups:
            project_update(group, [names[id(p)] for p in group], update, owners)

    return constrain


@torch.no_grad()
def project_update(
    group: Sequence[nn.Parameter], names: Sequence[str], update: Update, owners: Ranks = ALONE
) -> None:
    """Remove from one group's applied update what would raise the transport cost to first order.

    Args:
        owners: the processes that each have some rows of every parameter.
    """
    here = [rows_here(p) for p in group]
    moved = []
    for parameter, name in zip(here, names, strict=True):
        moved.append(parameter - rows_here(update.before[name]))
    given = [update.anchor_gradient.get(name) for name in names]
    anchor = [None if a is None else rows_here(a) for a in given]
    # An update points downhill, a gradient uphill: the update raises the cost if <D, a> > 0.
    products = torch.stack(projection.inner(moved, anchor))
    _, along, aa = owners.total(products)  # inner products add up over rows
    # D <- D - relu(<D, a>) / <a, a> a, which leaves <D, a> = 0 in a conflict.
    excess: float | Tensor = ratio(torch.relu(along), aa)
    if not devices.reading_stalls(aa.device):
        excess = float(excess)
        if excess == 0:
            return
    pulled = [p for p, a in zip(here, anchor, strict=True) if a is not None]
    if pulled:
        projection.add_scaled(pulled, [a for a in anchor if a is not None], -excess)


METHOD = Method(
    "aegis",
    "per-layer projection against the anchor gradient",
    train_all,
    start=start,
    needs=frozenset({"moments"}),
)
