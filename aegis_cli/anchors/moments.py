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

if TYPE_CHECKING:  # the guard imports this module and needs no scene renderer
    import numpy as np

    from aegis_cli.data.vqa.questions import Question

Item = TypeVar("Item")
Read = tuple[Images, Sequence[str]]  # images, and the text of each


class MomentRecorder:
    """Adds up the moments of hidden states, separately for image tokens and text tokens.

    Attributes:
        image, text: each layer's moments so far; empty before the first pass.
    """

    def __init__(self) -> None:
        self.image: list[Moments] = []
        self.text: list[Moments] = []

    def add(self, hidden: Sequence[Tensor], mask: Tensor, image: Tensor) -> None:
        """Count one pass.

        Args:
            hidden: each layer's output, L tensors [B, T, D].
            mask: [B, T] bool, true at tokens that count.
            image: [T] or [B, T] bool, true at image tokens.
        """
        nothing = [empty(h.shape[-1]) for h in hidden]
        # Separately, because a method's option (`scope`) says which of the two is compared.
        self.image = add_moments(self.image or nothing, hidden, mask & image)
        self.text = add_moments(self.text or nothing, hidden, mask & ~image)

    def kept(self) -> Kept:
        """The moments so far, for saving."""
        return _to_keep(self.image, self.text)

    def restore(self, kept: Kept, device: torch.device) -> None:
        """Continue from saved moments."""
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
        batches: images, with one question about each.
        total: the number of questions, for progress events.
        ranks: the processes, which take batches in turn.
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
    """The moments of each layer over image and text tokens, for images that are read with texts.

    Args:
        batches: the batches to pass; `read` returns the images and texts of one, in several threads
            if the model is on a GPU.
        total: the number of questions or frames, for progress events.
        ranks: the processes, which take batches in turn.
        work: the saved state of an interrupted measurement, and of this one.
    """
    piece = work.piece("anchor")
    if (known := piece.finished()) is not None:
        on_event(Progress("anchor", total, total, "samples"))
        return _from_kept(known)
    recorder, done, before = MomentRecorder(), 0, 0
    if (begun := piece.begun()) is not None:
        recorder.restore(begun, model.device)
        done, before = begun.figures["samples"], begun.figures["done"]
        del begun

    def sums() -> Kept:
        found = recorder.kept()
        return Kept({**found.figures, "samples": done}, found.tensors)

    # The processes take whole batches in turn; merging is associative, so the split has no effect.
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
    # Each process may have its own GPU, so their moments are merged on the CPU.
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
    """The moments over image and text tokens; none for a process that has only figures."""

    def layers(name: str) -> list[Moments]:
        return [
            Moments(count, *(kept.tensors[f"{name}.{place}.{kind}"] for kind in ("mean", "var")))
            for place, count in enumerate(kept.figures["counts"][name] if kept.tensors else ())
        ]

    return layers("image"), layers("text")


def _merged(found: list[Moments], more: list[Moments]) -> list[Moments]:
    """The moments of both, layer by layer; a process without a batch has no layers."""
    if not found or not more:
        return found or more
    return [merge(a, b) for a, b in zip(found, more, strict=True)]
