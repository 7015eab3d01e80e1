"""VQA passes for whoever watches a VLM's modules: each image once, each question once."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Iterator
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn
from torch.utils.hooks import RemovableHandle

from aegis_cli.backbones.base import Backbone
from aegis_cli.errors import AegisError
from aegis_cli.events import OnEvent, Progress
from aegis_cli.vqa.images import tensors

if TYPE_CHECKING:  # the guard comes here, and has no use for a renderer of scenes
    from aegis_cli.vqa.dataset import VQASet

IMAGES = 32  # a pass; the unfolded patches of a convolution take a few MB an image


class Sums:
    """Second moments by site, summed in float64, so that neither batch size nor order shows in the result."""

    def __init__(self) -> None:
        self._totals: dict[str, Tensor] = {}
        self._counts: dict[str, int] = {}

    def add(self, site: str, moment: Tensor, count: int) -> None:
        """Add `count` rows' summed moment."""
        self._totals[site] = self._totals[site] + moment if site in self._totals else moment
        self._counts[site] = self._counts.get(site, 0) + count

    def means(self, sites: list[str]) -> dict[str, Tensor]:
        """The mean of each site.

        Raises:
            AegisError: one of them saw nothing.
        """
        if missing := [site for site in sites if site not in self._totals]:
            raise AegisError(f"{', '.join(missing)} took no part in these questions", "every map's share", "use more samples")
        return {site: total / self._counts[site] for site, total in self._totals.items()}


def run(model: Backbone, asked: VQASet, stage: str, on_event: OnEvent) -> Iterator[Tensor]:
    """Pass the whole set, `IMAGES` images at a time with all their questions; yields the answers' scores part by part."""
    image_of = torch.from_numpy(asked.image_of)
    for first in range(0, len(asked.images), IMAGES):
        rows = ((image_of >= first) & (image_of < first + IMAGES)).nonzero().squeeze(1)
        images = tensors(asked.images[first : first + IMAGES])
        questions = [asked.questions[i] for i in rows.tolist()]
        texts, answers = [q.text for q in questions], [q.answer for q in questions]
        yield from model.read_vqa(images, image_of[rows] - first, texts, answers)
        on_event(Progress(stage, min(first + IMAGES, len(asked.images)), len(asked.images), "images"))


@contextlib.contextmanager
def watching(
    model: Backbone, watch: Callable[[str, nn.Module], RemovableHandle], sites: Collection[str] | None = None
) -> Iterator[None]:
    """A hook on the module of each of `sites` (of every site without) for as long as the block runs."""
    handles = [watch(site, module) for site, module in model.site_modules().items() if sites is None or site in sites]
    try:
        yield
    finally:
        for handle in handles:
            handle.remove()
