"""Means and variances of each layer's hidden states while a VLM reads images with texts."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, TypeVar

import torch
from torch import Tensor

from aegis_cli.anchors import kept_work
from aegis_cli.common import prefetch
from aegis_cli.common.events import OnEvent, Progress, ignore
from aegis_cli.common.kept_tensors import Kept
from aegis_cli.common.ranks import ALONE, Ranks
from aegis_cli.core.moments import Moments, add_moments, empty, merge
from aegis_cli.data.batch import Images
from aegis_cli.data.vqa.images import tensors
from aegis_cli.models.backbones.base import Backbone

if TYPE_CHECKING:  # the guard comes here, and has no use for a renderer of scenes
    import numpy as np

    from aegis_cli.data.vqa.questions import Question

Item = TypeVar("Item")
Read = tuple[Images, Sequence[str]]  # images, each with a text that it is read with


class MomentRecorder:
    """Adds up the moments of hidden states, of image tokens and of text tokens apart.

    Attributes:
        image, text: the moments so far of each layer; empty before the first pass.
    """

    def __init__(self) -> None:
        self.image: list[Moments] = []
        self.text: list[Moments] = []

    def add(self, hidden: Sequence[Tensor], mask: Tensor, image: Tensor) -> None:
        """Count one pass.

        Args:
            hidden: each layer's output, L tensors [B, T, D].
            mask: [B, T] bool; where it is false nothing counts.
            image: [T] or [B, T] bool, true at image tokens.
        """
        nothing = [empty(h.shape[-1]) for h in hidden]
        # Apart, because which of the two is compared is an option of a method (`scope`).
        self.image = add_moments(self.image or nothing, hidden, mask & image)
        self.text = add_moments(self.text or nothing, hidden, mask & ~image)

    def kept(self) -> Kept:
        """The moments so far, to be kept."""
        return _to_keep(self.image, self.text)

    def restore(self, kept: Kept, device: torch.device) -> None:
        """Go on from moments that were kept."""
        found = _from_kept(kept)
        self.image, self.text = ([layer.to(device) for layer in layers] for layers in found)


def measure(
    model: Backbone,
    batches: Iterable[tuple[np.ndarray | list[np.ndarray], Sequence[Question]]],
    total: int,
    on_event: OnEvent = ignore,
    ranks: Ranks = ALONE,
) -> tuple[list[Moments], list[Moments]]:
    """The moments of each layer of one of our backbones, over image tokens and over text tokens.

    Padding does not count.

    Args:
        batches: images and as many questions about them.
        total: how many questions there are, for the progress.
        ranks: the processes that take turns in passing a batch.
    """

    def read(batch: tuple[np.ndarray | list[np.ndarray], Sequence[Question]]) -> Read:
        images, questions = batch
        return tensors(images), [q.text for q in questions]

    return measure_passes(model, batches, read, total, on_event, ranks)


@torch.inference_mode()
def measure_passes(
    model: Backbone,
    batches: Iterable[Item],
    read: Callable[[Item], Read],
    total: int,
    on_event: OnEvent = ignore,
    ranks: Ranks = ALONE,
    work: kept_work.Work = kept_work.NOTHING,
) -> tuple[list[Moments], list[Moments]]:
    """The moments of each layer over image and text tokens, of images that are read with texts.

    Args:
        batches: in which they are passed; `read` finds one's images and texts, for a GPU in several
            threads.
        total: how many there are, for the progress.
        ranks: the processes that take turns in passing a batch.
        work: what is kept of an interrupted measurement, and of this one.
    """
    piece = work.piece("anchor")
    if (known := piece.finished()) is not None:
        on_event(Progress("anchor", total, total, "samples"))
        return _from_kept(known)
    recorder, done, before = MomentRecorder(), 0, 0
    if (begun := piece.begun()) is not None:
        recorder.restore(begun, model.device)
        done, before = begun.figures["samples"], begun.figures["done"]

    def sums() -> Kept:
        found = recorder.kept()
        return Kept({**found.figures, "samples": done}, found.tensors)

    # Whole batches in turns: merging is associative, so that who passed which does not matter.
    own = itertools.islice(batches, ranks.rank + before * ranks.count, None, ranks.count)
    on_event(Progress("anchor", done, total, "samples"))
    with (
        prefetch.for_device(lambda batch: model.process(*read(batch)), own, model.device) as ready,
        piece.going(sums) as passed,
    ):
        for number, inputs in enumerate(ready, start=before + 1):
            encoding = model.encode(inputs.to(model.device))
            recorder.add(encoding.hidden, encoding.mask, encoding.image)
            done += len(inputs.ids)
            passed(number)
            on_event(Progress("anchor", done, total, "samples"))
    image: list[Moments] = []
    text: list[Moments] = []
    # Those of several processes, each of which may have its own GPU, can be merged on the CPU.
    cpu = torch.device("cpu")
    measured = [[layer.to(cpu) for layer in found] for found in (recorder.image, recorder.text)]
    for of_image, of_text in ranks.gathered(measured):
        image, text = _merged(image, of_image), _merged(text, of_text)
    piece.finish(_to_keep(image, text))
    return image, text


def _to_keep(image: Sequence[Moments], text: Sequence[Moments]) -> Kept:
    counts: dict[str, list[int]] = {}
    tensors: dict[str, Tensor] = {}
    for name, layers in (("image", image), ("text", text)):
        counts[name] = [layer.count for layer in layers]
        for place, layer in enumerate(layers):
            tensors[f"{name}.{place}.mean"], tensors[f"{name}.{place}.var"] = layer.mean, layer.var
    return Kept({"counts": counts}, tensors)


def _from_kept(kept: Kept) -> tuple[list[Moments], list[Moments]]:
    """The moments over image and text tokens; none for a process that has figures alone."""

    def layers(name: str) -> list[Moments]:
        return [
            Moments(count, *(kept.tensors[f"{name}.{place}.{kind}"] for kind in ("mean", "var")))
            for place, count in enumerate(kept.figures["counts"][name] if kept.tensors else ())
        ]

    return layers("image"), layers("text")


def _merged(found: list[Moments], more: list[Moments]) -> list[Moments]:
    """The moments of both, layer by layer; a process that had no batch knows no layers."""
    if not found or not more:
        return found or more
    return [merge(a, b) for a, b in zip(found, more, strict=True)]
