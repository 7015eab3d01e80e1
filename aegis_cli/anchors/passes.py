"""VQA passes for whoever watches a VLM's modules: each image once, each question once."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Iterable, Iterator
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn
from torch.utils.hooks import RemovableHandle

from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Progress
from aegis_cli.data.vqa.images import tensors
from aegis_cli.models.backbones.base import Backbone

if TYPE_CHECKING:  # the guard comes here, and has no use for a renderer of scenes
    from aegis_cli.data.vqa.dataset import VQASet

IMAGES = 32  # in a pass at most: the unfolded patches of a convolution take a few MB an image
QUESTIONS = 8  # at most, where each takes a pass of its image of its own


class Sums:
    """Second moments by site, summed in float64, so that neither batch size nor order shows in the
    result.
    """

    def __init__(self) -> None:
        self._totals: dict[str, Tensor] = {}
        self._counts: dict[str, int] = {}

    def add(self, site: str, moment: Tensor, count: int) -> None:
        """Add `count` rows' summed moment."""
        self._totals[site] = self._totals[site] + moment if site in self._totals else moment
        self._counts[site] = self._counts.get(site, 0) + count

    def check(self, sites: Iterable[str]) -> None:
        """Raise AegisError unless each of them saw something."""
        if missing := [site for site in sites if site not in self._totals]:
            raise AegisError(
                f"{', '.join(missing)} took no part in these questions",
                "every map's share",
                "use more samples",
            )

    def means(self) -> Iterator[tuple[str, Tensor]]:
        """Each site with its mean, on the CPU, in the order of their first rows.

        One at a time: of a large model all of them together do not fit beside the sums, least of
        all on a GPU.
        """
        for site, total in self._totals.items():
            yield site, total.cpu() / self._counts[site]


def run(
    model: Backbone, asked: VQASet, batch_size: int, stage: str, on_event: OnEvent
) -> Iterator[Tensor]:
    """Pass the whole set, up to `batch_size` images at a time with all their questions; yields the
    answers' scores part by part.
    """
    image_of, step = torch.from_numpy(asked.image_of), min(IMAGES, batch_size)
    for first in range(0, len(asked.images), step):
        rows = ((image_of >= first) & (image_of < first + step)).nonzero().squeeze(1)
        images = tensors(asked.images[first : first + step])
        questions = [asked.questions[i] for i in rows.tolist()]
        texts, answers = [q.text for q in questions], [q.answer for q in questions]
        yield from model.read_vqa(
            images, image_of[rows] - first, texts, answers, min(QUESTIONS, batch_size)
        )
        on_event(Progress(stage, min(first + step, len(asked.images)), len(asked.images), "images"))


@contextlib.contextmanager
def watching(
    model: Backbone,
    watch: Callable[[str, nn.Module], RemovableHandle],
    sites: Collection[str] | None = None,
) -> Iterator[None]:
    """A hook on the module of each of `sites` (of every site without) for as long as the block
    runs.
    """
    handles = [
        watch(site, module)
        for site, module in model.site_modules().items()
        if sites is None or site in sites
    ]
    try:
        yield
    finally:
        for handle in handles:
            handle.remove()
