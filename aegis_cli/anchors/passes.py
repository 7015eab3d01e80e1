"""VQA passes of our backbones for the recorders: each image once, each question once."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import torch
from torch import nn

from aegis_cli.common.events import OnEvent, Progress
from aegis_cli.common.ranks import ALONE, Ranks
from aegis_cli.data.batch import Share
from aegis_cli.data.vqa.images import tensors
from aegis_cli.models.backbones.base import AnswerScores, Backbone
from aegis_cli.models.structure import Maps

if TYPE_CHECKING:  # the guard imports this module and needs no scene renderer
    from aegis_cli.data.vqa.dataset import VQASet

IMAGES = 32  # per pass at most: the unfolded patches of a convolution take a few MB per image
QUESTIONS = 8  # per pass at most, if the image is passed again for each question


def maps_of(model: Backbone) -> Maps:
    """The maps of a backbone as its family names them, unlike `structure.find_maps`, which guesses.

    Raises:
        AegisError: modules whose parameters are used in a way that their inputs do not describe.
    """
    return Maps(kinds=model.sites(), twins={}, heads=dict(model.tied_heads), unknown={})


def groups(
    model: Backbone, stage: str, memory: int | None, size: Callable[[nn.Module], int]
) -> Iterator[tuple[Maps, str]]:
    """The maps of a backbone in groups whose sums take up to `memory` bytes, and a name for each.

    Maps of one parent module stay together, since they may share a sum, even if they exceed
    `memory` by themselves. What they share is not known beforehand, so the sums take at most that
    much.

    Args:
        stage: the name, to which the number of the group is added if there are several.
        memory: None: all maps are one group.
        size: returns the bytes of a module's sums.

    Raises:
        AegisError: see `maps_of`.
    """
    whole = maps_of(model)
    parents: dict[str, list[str]] = {}
    for site in whole.kinds:
        parents.setdefault(site.rpartition(".")[0], []).append(site)
    modules = model.site_modules()
    found: list[list[str]] = []
    left = 0
    for sites in parents.values():
        # A lone row is no module and has no sum.
        needed = sum(size(modules[site]) for site in sites if site in modules)
        if not found or (memory is not None and needed > left):
            found.append([])
            left = memory or 0
        found[-1] += sites
        left -= needed  # below 0 after a module that is too large by itself: a new group follows
    for number, sites in enumerate(found, start=1):
        kinds = {site: whole.kinds[site] for site in sites}
        heads = {table: head for table, head in whole.heads.items() if table in kinds}
        name = stage if len(found) == 1 else f"{stage} {number} of {len(found)}"
        yield Maps(kinds, {}, heads, {}), name


def tell_known(asked: VQASet, stage: str, on_event: OnEvent) -> None:
    """Report that an earlier process has passed this set, and that its result is used."""
    on_event(Progress(stage, len(asked.images), len(asked.images), "images"))


def run(
    model: Backbone,
    asked: VQASet,
    batch_size: int,
    stage: str,
    on_event: OnEvent,
    ranks: Ranks = ALONE,
    done: int = 0,
    passed: Callable[[int], object] | None = None,
) -> Iterator[AnswerScores]:
    """Pass the whole set, up to `batch_size` images at a time with all their questions.

    Args:
        ranks: the processes, each of which passes a share of the images.
        done: how many images of its share this process has passed before.
        passed: called with that number each time all scores of a batch were taken.

    Yields:
        The scores of the answers' words, part by part, with the number of each question in the set.
    """
    image_of, step = torch.from_numpy(asked.image_of), min(IMAGES, batch_size)
    own = Share(ranks.rank, ranks.count).rows(len(asked.images))
    on_event(Progress(stage, done, own.stop - own.start, "images"))
    for first in range(own.start + done, own.stop, step):
        last = min(first + step, own.stop)
        # Numbers of the questions about these images, wherever they stand in the set.
        rows = ((image_of >= first) & (image_of < last)).nonzero().squeeze(1)
        images = tensors(asked.images[first:last])
        questions = [asked.questions[i] for i in rows.tolist()]
        texts, answers = [q.text for q in questions], [q.answer for q in questions]
        together = min(QUESTIONS, batch_size)
        for part in model.read_vqa(images, image_of[rows] - first, texts, answers, together):
            yield AnswerScores(part.scores, rows[part.question])
        if passed is not None:
            passed(last - own.start)
        on_event(Progress(stage, last - own.start, own.stop - own.start, "images"))
