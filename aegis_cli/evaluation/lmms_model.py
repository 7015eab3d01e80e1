"""The benchmarks of lmms-eval, such as MMMU and TextVQA, asked of a run's or a backbone's VLM.

lmms-eval finds the model `aegis` by an entry point in pyproject.toml if both are installed:
`lmms-eval --model aegis --model_args pretrained=runs/x --tasks textvqa_val`. Questions take the
same path as those of `aegis probe`: the model's own processor, chat template and `generate`, in
float32 unless another dtype is requested.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from lmms_eval.api.instance import Instance
from lmms_eval.api.model import lmms
from lmms_eval.models.registry_v2 import ModelManifest
from PIL.Image import Image
from torch import Tensor
from tqdm import tqdm

from aegis_cli.common import devices, launch, pictures
from aegis_cli.common.errors import AegisError
from aegis_cli.models import backbones
from aegis_cli.models.backbones.base import FLOAT32, STORED_TYPES, Backbone

NAME = "aegis"
_MARK = "<image>"  # marks the place of an image in a task's text
_MOST = 1024  # tokens of an answer at most, unless a task says otherwise
_BETWEEN_SHOTS = "\n\n"  # lmms-eval's default end of an answer, which its own models ignore


def manifest() -> ModelManifest:
    """What lmms-eval registers."""
    return ModelManifest(NAME, simple_class_path=f"{__name__}.{AegisModel.__name__}")


class _Asked(NamedTuple):
    """One question: its index among the requests, its text, and settings for its answer."""

    place: int
    text: str
    images: list[Tensor]
    most: int
    until: tuple[str, ...]


class AegisModel(lmms):
    """A VLM that answers lmms-eval's questions about one or several images, greedily."""

    is_simple = True

    def __init__(
        self,
        pretrained: str,
        dtype: str = FLOAT32,
        batch_size: int | str = 1,
        device: str | None = None,
        **unknown: Any,
    ) -> None:
        """Load the VLM.

        Args:
            pretrained: a run, checkpoint, exported folder or backbone, as `aegis probe` takes it.
            dtype: dtype of the weights during generation.
            batch_size: questions that are answered together.
            device: as `--device` of Aegis; None: a GPU if there is one. If accelerate or torchrun
                has started several processes, each has its own GPU.

        Raises:
            AegisError: nothing to load, or an unknown argument.
        """
        super().__init__()
        if unknown:
            known = "pretrained, dtype, batch_size and device"
            raise AegisError(f"--model_args {', '.join(unknown)}", known, "leave it out")
        self._rank, self._world_size = launch.rank(), launch.world_size()
        self._batch_size = _whole(batch_size)
        self._backbone = backbones.load(pretrained)
        _round(self._backbone, dtype)
        with devices.chosen(device if self._world_size == 1 else None):
            self.device = devices.pick()
        self._backbone.to(self.device).eval()

    def generate_until(self, requests: list[Instance]) -> list[str]:
        """What the model answers to each request.

        Raises:
            AegisError: a request that asks for sampling, has no image, or is not about images.
        """
        asked = [self._asked(place, request) for place, request in enumerate(requests)]
        answers = [""] * len(asked)
        batches = list(self._batches(asked))
        for batch in tqdm(batches, desc="Aegis answers", disable=self.rank != 0):
            said = self._answer(batch)
            for one, text in zip(batch, said, strict=True):
                answers[one.place] = _until(text, one.until)
        return answers

    def _asked(self, place: int, request: Instance) -> _Asked:
        text, settings, to_images, number, task, split = request.args
        shown = to_images(self.task_dict[task][split][number]) or []
        _check_greedy(settings, task)
        _check_images(shown, task, self._backbone)
        until = settings.get("until") or ()  # one text, or several
        return _Asked(
            place,
            text=text.replace(_MARK, "").strip(),
            images=[torch.from_numpy(pictures.rgb(image)) for image in shown],
            most=int(settings.get("max_new_tokens", _MOST)),
            until=(until,) if isinstance(until, str) else tuple(until),
        )

    def _batches(self, asked: Sequence[_Asked]) -> Iterator[list[_Asked]]:
        """Questions that may be answered together, the longest first.

        A batch is as long as its longest question, and generates as many tokens as its longest
        answer may have.
        """
        # Sorted by length, so that questions of a batch need little padding.
        alike: dict[tuple[int, int], list[_Asked]] = {}
        for one in asked:
            alike.setdefault((one.most, len(one.images)), []).append(one)
        for own in alike.values():
            own.sort(key=lambda one: len(one.text), reverse=True)
            for start in range(0, len(own), self._batch_size):
                yield own[start : start + self._batch_size]

    def _answer(self, batch: Sequence[_Asked]) -> list[str]:
        size = self._backbone.image_size
        if size is None:
            images: Any = [one.images for one in batch]
        else:
            fitted = [pictures.fit(one.images[0].numpy(), size, size) for one in batch]
            images = torch.stack([torch.from_numpy(image) for image in fitted])
        with torch.no_grad():
            return self._backbone.answer(images, [one.text for one in batch], batch[0].most)

    def loglikelihood(self, requests: list[Instance]) -> list[tuple[float, bool]]:
        """Refuse: this model only generates answers."""
        raise _not_of_this_kind(requests, "scores given answers")

    def generate_until_multi_round(self, requests: list[Instance]) -> list[str]:
        """Refuse: this model answers each question once."""
        raise _not_of_this_kind(requests, "asks in several rounds")


def _whole(batch_size: int | str) -> int:
    try:
        found = int(batch_size)
    except ValueError:
        found = 0
    if found < 1:
        raise AegisError(
            f"--batch_size {batch_size}", "a whole number, 1 or more", "e.g. --batch_size 16"
        )
    return found


def _round(backbone: Backbone, dtype: str) -> None:
    """Round a backbone's weights to this dtype."""
    if dtype not in STORED_TYPES:
        fix = f"--model_args pretrained=...,dtype={FLOAT32}"
        raise AegisError(f"dtype={dtype}", f"one of {', '.join(STORED_TYPES)}", fix)
    if dtype == FLOAT32:
        return
    if not backbone.rounds:
        raise AegisError(f"dtype={dtype} with this backbone", FLOAT32, "leave dtype out")
    backbone.round_weights(STORED_TYPES[dtype])


def _check_greedy(settings: Mapping[str, Any], task: str) -> None:
    """Raise AegisError if a task asks for sampling or beam search."""
    warm = bool(settings.get("temperature", 1))
    samples = settings.get("do_sample")
    if samples is None:  # then lmms-eval's own models decide by the temperature
        samples = bool(settings.get("temperature"))
    if (samples and warm) or settings.get("num_beams") not in (1, None):
        wanted = {name: settings.get(name) for name in ("do_sample", "temperature", "num_beams")}
        raise AegisError(
            f"the task '{task}' with {wanted}",
            "greedy decoding, which gives the same answer every time",
            "--gen_kwargs do_sample=False,temperature=0,num_beams=1",
        )


def _check_images(shown: Sequence[Any], task: str, backbone: Backbone) -> None:
    """Raise AegisError unless the backbone can read the images of a question."""
    kinds = {type(one).__name__ for one in shown if not isinstance(one, Image)}
    if kinds:
        found = f"the task '{task}' asks about {', '.join(sorted(kinds))}"
        raise AegisError(found, "images", "choose tasks about images")
    if not shown:
        found = f"the task '{task}' asks about no image"
        raise AegisError(found, "at least one image per question", "choose tasks about images")
    if len(shown) > 1 and not backbone.reads_several:
        found = f"the task '{task}' asks about {len(shown)} images at once"
        raise AegisError(found, "one, which is all that this model reads", "choose another task")


def _until(text: str, ends: Sequence[str]) -> str:
    """An answer up to the first stop text."""
    for end in ends:
        if end and end != _BETWEEN_SHOTS:
            text = text.split(end)[0]
    return text


def _not_of_this_kind(requests: Sequence[Instance], does: str) -> AegisError:
    task = requests[0].args[-2] if requests else "?"
    found = f"the task '{task}' {does}"
    return AegisError(found, "tasks of the type generate_until", "leave it out of --tasks")
