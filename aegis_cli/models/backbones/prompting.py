"""Prompts of images and texts by a model's own processor, and answers that continue them.

The processor is whatever a model's folder contains; only it and its tokenizer are called, and its
type is not assumed.
"""

from __future__ import annotations

import copy
import textwrap
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from functools import cached_property
from typing import Any, NamedTuple

import torch
from PIL import Image
from torch import Tensor

from aegis_cli.common.errors import AegisError, in_short
from aegis_cli.data.batch import Images
from aegis_cli.models.backbones import preparation
from aegis_cli.models.backbones.base import Batch
from aegis_cli.models.backbones.families import Family
from aegis_cli.models.backbones.model_folder import misfit

_PIXEL_MASK = "pixel_attention_mask"
_IMAGE = "<image>"  # stands for an image in a prompt without a chat template


class Processors:
    """A processor, with copies of it for concurrent calls.

    A call changes a tokenizer's settings, so no two threads may call the same one, and several
    threads prepare the batches of the next steps.

    Attributes:
        original: is never called; attributes that calls do not change may be read from it.
    """

    def __init__(self, original: Any) -> None:
        self.original = original
        self._idle: list[Any] = []

    def __deepcopy__(self, memo: dict[int, Any]) -> Processors:
        return self  # copies of a model may share it: no call depends on earlier ones

    @contextmanager
    def one(self) -> Generator[Any]:
        """A copy for exclusive use; as many are made as are in use at once."""
        try:
            processor = self._idle.pop()
        except IndexError:
            processor = copy.deepcopy(self.original)
        try:
            yield processor
        finally:
            self._idle.append(processor)


class Shape(NamedTuple):
    """What a processor makes of an image.

    Attributes:
        tokens: how many it adds to a prompt.
        tensors: the names and shapes of its tensors, except those with a number per token.
    """

    tokens: int
    tensors: tuple[tuple[str, tuple[int, ...]], ...]


_ANY = Shape(0, ())  # of images that all have one size


class Prompter:
    """A processor with the prompt format of its family."""

    def __init__(
        self, processor: Any, family: Family, longest: int, words: int, image_token: int
    ) -> None:
        """Take a processor and its limits.

        The model has positions for `longest` tokens, and embeddings for `words` tokens.
        """
        self._processors, self._family = Processors(processor), family
        self._longest, self._words = longest, words
        self._tokenizer = processor.tokenizer  # of the original
        self._markers = _markers(processor, image_token)
        self._shapes: dict[tuple[int, ...], Shape] = {}  # by the size of an image

    @cached_property
    def preparation(self) -> dict[str, str]:
        """The processor's settings; see preparation.py."""
        with self._processors.one() as processor:
            return preparation.of(processor)

    def process(self, images: Images, prompts: Sequence[str], side: str) -> Batch:
        """Prompts with one or several images [H, W, 3] uint8 of any size each, padded on `side`.

        Raises:
            AegisError: the processor refuses an image or a text, a text is too long, or the model
                lacks a token.
        """
        for text in prompts:
            self.check_text(text)
        pictures, texts = [], []
        for row, text in zip(images, prompts, strict=True):
            own = [Image.fromarray(image.cpu().numpy()) for image in _several(row)]
            pictures.append(own)
            texts.append(self._prompt(text, len(own)))
        try:
            with self._processors.one() as processor:
                made = processor(
                    images=pictures,
                    text=texts,
                    padding=True,
                    padding_side=side,
                    return_tensors="pt",
                    **self._special(texts[0]),
                )
        except ValueError as error:
            raise self._first_refused(pictures, prompts, texts) or _unfit(str(error)) from error
        tensors = {
            name: t for name, t in made.items() if isinstance(t, Tensor) and name != "labels"
        }
        ids, mask = tensors.pop("input_ids"), tensors.pop("attention_mask")
        pixels = tensors.pop("pixel_values")
        if _PIXEL_MASK in tensors:  # as large as a picture, with eight bytes per pixel
            tensors[_PIXEL_MASK] = tensors[_PIXEL_MASK].bool()
        self._check_length(ids.shape[1], prompts[int(mask.sum(1).argmax())])
        self._check_known(int(ids.max()))
        return Batch(pixels, ids, mask.bool(), tensors)

    def _first_refused(
        self, pictures: Sequence[list[Image.Image]], prompts: Sequence[str], texts: Sequence[str]
    ) -> AegisError | None:
        """The error for the first row that the processor refuses by itself."""
        for own, asked, text in zip(pictures, prompts, texts, strict=True):
            try:
                with self._processors.one() as processor:
                    processor(images=[own], text=[text], **self._special(text))
            except ValueError as error:
                sizes = " and ".join(f"{image.width} x {image.height}" for image in own)
                return _unfit(f"{_quoted(asked)} about {sizes} pixels: {in_short(error)}")
        return None

    def padded(self, batch: Batch, multiple: int) -> Batch:
        """The batch, padded on the right to a multiple of `multiple` tokens if the model can."""
        rows, length = batch.ids.shape
        rounded_up = -(-length // multiple) * multiple
        # The model has no positions beyond `_longest`.
        room = rows, min(rounded_up, max(self._longest, length))
        if room[1] == length:
            return batch
        ids = batch.ids.new_full(room, self._tokenizer.pad_token_id)
        mask = batch.mask.new_zeros(room)
        # Per-token tensors of the processor, such as token types.
        types = {
            name: t.new_zeros(room) for name, t in batch.extra.items() if t.shape == batch.ids.shape
        }
        ids[:, :length], mask[:, :length] = batch.ids, batch.mask
        for name, type_ids in types.items():
            type_ids[:, :length] = batch.extra[name]
        return Batch(batch.pixels, ids, mask, {**batch.extra, **types})

    @staticmethod
    def padded_left(batch: Batch) -> Batch:
        """The same batch, with the padding on the left, which was on the right."""
        length = batch.ids.shape[1]
        tokens = batch.mask.sum(1, keepdim=True)
        # The first number after a row's tokens, its first padding, comes to its beginning.
        places = (torch.arange(length, device=tokens.device) + tokens) % length
        extra = {
            name: t.gather(1, places) if t.shape == batch.ids.shape else t
            for name, t in batch.extra.items()
        }
        ids, mask = batch.ids.gather(1, places), batch.mask.gather(1, places)
        return Batch(batch.pixels, ids, mask, extra)

    def _prompt(self, text: str, images: int = 1) -> str:
        if self._family.prompt is not None:
            return _IMAGE * images + self._family.prompt.format(text)
        shown = [{"type": "image"} for _ in range(images)]
        said = [{"role": "user", "content": [*shown, {"type": "text", "text": text}]}]
        # Not the processor's own method: SmolVLM's reads settings of videos, which need
        # torchvision.
        return self._tokenizer.apply_chat_template(
            said,
            chat_template=self._processors.original.chat_template,
            add_generation_prompt=True,
            tokenize=False,
        )

    @property
    def filler(self) -> int:
        """The padding token."""
        return self._tokenizer.pad_token_id

    def places_image(self) -> bool:
        """Whether a prompt about an image contains its marker."""
        return any(marker in self._prompt("a") for marker in self._markers)

    def _special(self, text: str) -> dict[str, bool]:
        """Arguments that avoid a second begin token if the template already has one."""
        first = self._tokenizer.bos_token
        if self._family.prompt is None and first and text.startswith(first):
            return {"add_special_tokens": False}
        return {}

    def check_text(self, text: str) -> None:
        """Raise AegisError if a question, instruction or answer cannot be read with any image.

        It then contains the marker of an image or of another medium, or is too long by itself.
        """
        found = next((marker for marker in self._markers if marker in text), None)
        if found is not None:
            raise _refused(f"{_quoted(text)} holds {found}, which stands for an image")
        # A text of fewer bytes cannot have too many tokens.
        if len(text.encode("utf-8", "surrogatepass")) > self._longest:
            with self._processors.one() as processor:
                own = processor.tokenizer(text, add_special_tokens=False)["input_ids"]
            self._check_length(len(own), text)

    def _check_length(self, tokens: int, text: str) -> None:
        if tokens > self._longest:
            raise AegisError(
                f"{_quoted(text)}: {tokens} tokens (its image's among them)",
                f"at most {self._longest}, the model's positions",
                "ask with fewer words",
            )

    def _check_known(self, largest: int) -> None:
        """Raise AegisError for an id past the end of the embedding table.

        It would cause an index error later, on a GPU much later.
        """
        if largest >= self._words:
            raise misfit(f"a token of number {largest} where the model has {self._words} words")

    # --- answers -------------------------------------------------------------------------------

    def answer_ids(self, answers: Sequence[str]) -> list[list[int]]:
        """The tokens with which each answer continues its prompt, without the end token."""
        shape, said = self._family.answer, list[list[int]]()
        with self._processors.one() as processor:
            for text in answers:
                ids = processor.tokenizer(shape.format(text), add_special_tokens=False)["input_ids"]
                # The format may contain a space, which is a token: an empty answer has none.
                said.append(ids if text else [])
                self._check_known(max(said[-1], default=0))
        return said

    def decode(self, ids: Sequence[Sequence[int]]) -> list[str]:
        """Texts of generated tokens, without the model's markers."""
        texts = self._tokenizer.batch_decode(ids, skip_special_tokens=True)
        return [text.strip() for text in texts]

    def lengths(self, prompts: Sequence[str]) -> list[int]:
        """Token count of each prompt, with its image as one marker: equal ones need no padding."""
        asked = [self._prompt(text) for text in prompts]
        with self._processors.one() as processor:
            rows = processor.tokenizer(asked)["input_ids"]
        return [len(ids) for ids in rows]

    def shapes(self, images: Sequence[Tensor], prompts: Sequence[str]) -> list[Shape]:
        """What the processor makes of each image [H, W, 3], of which only the size matters.

        Images of equal shapes need no padding in one batch. Many sizes may have one shape: a
        processor usually scales images, and may cut them into tiles. An image of each size is
        processed once, unless all have one size.
        """
        sizes = [tuple(image.shape) for image in images]
        if len(set(sizes)) == 1:
            return [_ANY] * len(sizes)
        for size, image, text in zip(sizes, images, prompts, strict=True):
            if size not in self._shapes:
                made = self.process([image], [text], "right")
                tokens = made.ids.shape[1] - self.lengths([text])[0]
                tensors = {"pixels": made.pixels, **made.extra}
                of_image = [
                    (name, tuple(tensor.shape))
                    for name, tensor in sorted(tensors.items())
                    if tensor.shape != made.ids.shape  # those per token are as long as the text
                ]
                self._shapes[size] = Shape(tokens, tuple(of_image))
        return [self._shapes[size] for size in sizes]

    def extend(self, batch: Batch, said: Sequence[Sequence[int]]) -> Batch:
        """Each row followed by its answer's tokens, padded on the right again."""
        prompt_lengths = batch.mask.sum(1).tolist()
        lengths = [n + len(words) for n, words in zip(prompt_lengths, said, strict=True)]
        self._check_length(max(lengths), "a question with its answer")
        room = (len(said), max(lengths))
        ids = batch.ids.new_full(room, self._tokenizer.pad_token_id)
        # Per-token tensors, such as token types, have to be extended to the answer's tokens.
        types = {
            name: t.new_zeros(room) for name, t in batch.extra.items() if t.shape == batch.ids.shape
        }
        for i, (n, total) in enumerate(zip(prompt_lengths, lengths, strict=True)):
            ids[i, :n] = batch.ids[i, :n]
            ids[i, n:total] = ids.new_tensor(said[i])
            for name, type_ids in types.items():
                type_ids[i, :n] = batch.extra[name][i, :n]
                type_ids[i, n:total] = self._family.answer_types.get(name, 0)
        mask = torch.arange(room[1], device=ids.device) < ids.new_tensor(lengths)[:, None]
        return Batch(batch.pixels, ids, mask, {**batch.extra, **types})


def _markers(processor: Any, image_token: int) -> tuple[str, ...]:
    """The words that a processor replaces by an image, a video or audio."""
    kinds = ("image", "video", "audio", "boi")  # the last is the begin-of-image token
    named = [
        getattr(owner, f"{kind}_token", None)
        for owner in (processor, processor.tokenizer)
        for kind in kinds
    ]
    known = [processor.tokenizer.convert_ids_to_tokens(image_token), *named]
    return tuple(dict.fromkeys(word for word in known if isinstance(word, str) and word))


def _quoted(text: str) -> str:
    """The beginning of a text, in quotes."""
    return f"'{textwrap.shorten(text, 80, placeholder=' ...')}'"


def _unfit(why: str) -> AegisError:
    return AegisError(
        f"an image or a text that the processor refuses: {why}",
        "images and texts that this model takes",
        "leave out that question, e.g. by --skip-bad, or the model's own markers in its text",
    )


def _refused(why: str) -> AegisError:
    return AegisError(
        f"a text that the processor refuses: {why}",
        "a question or an instruction without the model's own markers",
        "leave out words such as <image>",
    )


def _several(row: Tensor | Sequence[Tensor]) -> Sequence[Tensor]:
    """The images of a row, one or several."""
    return (row,) if isinstance(row, Tensor) else row
