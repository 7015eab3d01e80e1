"""A backbone between its fine-tuned and its pre-trained weights."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Iterator

import torch

from aegis_cli.core.pairs import Pair, minus, present
from aegis_cli.core.projection import dot
from aegis_cli.merging.task_factors import dense_sites
from aegis_cli.methods.site_weights import weights
from aegis_cli.models.backbones.base import Backbone

# Site, displacement of its weight and bias, strength -> the part of the displacement to keep.
Keep = Callable[[str, Pair, float], Pair]


class Displacement:
    """How far a backbone has moved since its pre-training, of which any part can be kept.

    Linear maps and convolutions, with their biases, keep what the method decides. All other
    parameters (normalisations, tables, lone rows) have no two factors that show what the task needs
    of them. They keep the maps' mean share <X, D> / <D, D>, where X is what all maps together keep
    of their displacement D. So they move back as far as the maps do on average, and a linear merge
    treats all parameters alike. If no map has moved, the method decides for each of them as for a
    map; only the linear method can, and `rules.keep` refuses the others.
    """

    def __init__(self, backbone: Backbone, base: Backbone, keep: Keep) -> None:
        """Copy the fine-tuned weights.

        Args:
            backbone: fine-tuned; its weights are changed in place.
            base: the pre-trained one, of the same shape.
        """
        self._backbone, self._base, self._keep = backbone, base, keep
        self._tuned = copy.deepcopy(backbone)
        self._sites = dense_sites(backbone)

    @torch.no_grad()
    def keep(self, strength: float) -> float:
        """Give the backbone the weights of a merge of this strength; 0 gives the fine-tuned ones.

        Returns:
            The maps' mean kept share of the displacement, from 0 to 1; that of the other parameters
            if no map has moved.
        """
        if strength == 0:
            # Copied, since adding the whole displacement to the base would round.
            self._backbone.load_state_dict(self._tuned.state_dict())
            return 1.0
        share = self._move(self._maps(), strength)
        if share is None:
            share = self._move(self._others(), strength)
            assert share is not None, "nothing has moved"
            return share
        for _, (now, _), (origin, _), (tuned, _) in self._others():
            now.copy_(torch.lerp(origin.float(), tuned.float(), share))
        return share

    def _maps(self) -> Iterator[tuple[str, Pair, Pair, Pair]]:
        """Each map's site, and its weights now, before fine-tuning and after it."""
        for site in self._sites:
            now = weights(self._backbone, site)
            origin = weights(self._base, site)
            tuned = weights(self._tuned, site)
            yield site, now, origin, tuned

    def _others(self) -> Iterator[tuple[str, Pair, Pair, Pair]]:
        """The same for each parameter that belongs to no map, by its name."""
        in_maps = set[int]()
        for _, now, _, _ in self._maps():
            in_maps.update(id(tensor) for tensor in present(now))
        # The three models have the same parameters in the same order (`sources._check_alike`).
        named = zip(
            self._backbone.named_parameters(),
            self._base.parameters(),
            self._tuned.parameters(),
            strict=True,
        )
        for (name, now), origin, tuned in named:
            if id(now) not in in_maps:
                yield name, (now, None), (origin, None), (tuned, None)

    def _move(self, parts: Iterable[tuple[str, Pair, Pair, Pair]], strength: float) -> float | None:
        """Set the weights of each part in turn, as the method decides.

        Returns:
            The mean kept share of their displacement; None if none has moved.
        """
        along, squared = 0.0, 0.0
        for site, now, origin, tuned in parts:
            moved = minus(tuned, origin)  # D
            left = self._keep(site, moved, strength)  # X
            four = map(present, (now, origin, moved, left))
            for parameter, start, way, part in zip(*four, strict=True):
                parameter.copy_(start + part)  # in float32 or wider, rounded to its type once
                along += float(dot(part, way))  # <X, D>
                squared += float(dot(way, way))  # <D, D>
        # If the bases are not orthogonal, rounding can lead past either end.
        return min(max(along / squared, 0.0), 1.0) if squared else None
