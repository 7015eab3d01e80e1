"""Hugging Face VLMs as backbones.

Nothing here reimplements a model: its own forward pass and `generate` run on the output of its own
processor, and what passes through the layers is recorded (recording.py). Besides this file, only
clip.py and from_hub.py import transformers.
"""

from __future__ import annotations

import functools
import hashlib
import inspect
import shutil
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import torch
import transformers
from jinja2 import TemplateError
from torch import Tensor, nn
from transformers.utils import is_torchvision_available

from aegis_cli.common import prefetch
from aegis_cli.common.devices import send
from aegis_cli.common.errors import AegisError, in_short
from aegis_cli.core.attention import Rotation, rotate
from aegis_cli.data.batch import Asked, Images
from aegis_cli.models.backbones import model_folder
from aegis_cli.models.backbones.base import AnswerScores, Backbone, Batch, Encoding, Suffix
from aegis_cli.models.backbones.caches import CACHE, EARLIER, takes_cache
from aegis_cli.models.backbones.compiling import MULTIPLE, compile_layers
from aegis_cli.models.backbones.families import FAMILIES, Family
from aegis_cli.models.backbones.from_hub import SAFE, complete, loading, quiet, without_dropout
from aegis_cli.models.backbones.prompting import Prompter
from aegis_cli.models.backbones.recording import Seen, recording, sliding_window, unrotated
from aegis_cli.models.structure import of_type, outermost_lists, widest

MAX_ANSWER = 32  # tokens of an answer at most, unless its reference is longer


class _Answered(NamedTuple):
    """Prompts [B] followed by their answers.

    Attributes:
        lengths: number of tokens of each prompt, without its answer.
        said: tokens of each answer, without the end token.
    """

    batch: Batch
    lengths: list[int]
    said: list[list[int]]


class HFBackbone(Backbone):
    """A model of `AutoModelForImageTextToText` with its processor."""

    reads_several = True
    rounds = True
    inside = "vlm."
    _multiple = 1  # tokens; prompt lengths are multiples of it

    def __init__(
        self,
        model: transformers.PreTrainedModel,
        processor: transformers.ProcessorMixin,
        family: Family,
        files: Mapping[str, bytes],
    ) -> None:
        """Take a model and its processor, and check that the two fit together.

        Args:
            family: where the language layers are, and how the model is asked.
            files: the contents of the processor's files, which `save` writes beside the weights.

        Raises:
            AegisError: processor and model do not fit together, the layers are not where the
                family says, or the model does not answer with words.
        """
        super().__init__()
        text = model.config.get_text_config()
        self.vlm, self._family, self._files = without_dropout(model.eval()), family, dict(files)
        table, head = model.get_input_embeddings(), model.get_output_embeddings()
        if head is None:
            raise model_folder.headless(model)
        # The table's own length, because a processor may know more tokens than the model.
        limits = (text.max_position_embeddings, len(table.get_parameter("weight")))
        self._prompter = Prompter(processor, family, *limits, model.config.image_token_id)
        self.held = tuple(f"vlm.{name}" for name in family.held)
        self.idle = tuple(f"vlm.{part}" for part in family.idle(model))
        if family.connector is not None:
            model.get_submodule(family.connector).register_forward_hook(_in_own_type)
        self.width, self.heads = text.hidden_size, text.num_attention_heads
        self._layers_path = f"vlm.{family.layers}"
        self._language = self._layers_path.rpartition(".")[0]
        self._layer_types = _layer_types(text, self._rotary)
        names = {id(module): name for name, module in self.named_modules()}
        self._table, self._head = names[id(table)], names[id(head)]
        self.tied_heads = {self._table: self._head} if head.weight is table.weight else {}
        if model.generation_config.eos_token_id is None:
            raise AegisError(
                f"a {type(model).__name__} without eos_token_id in its generation_config.json",
                "the token, or tokens, that end an answer",
                "add it, as the model's own repository has it",
            )
        self.depth = len(self._layers)
        self.kv_heads, self.head_dim = self._measure_keys()

    # Both are looked up when needed: a module kept as an attribute would be registered a second
    # time, with further names for its weights.

    @property
    def _layers(self) -> nn.ModuleList:
        return self.get_submodule(self._layers_path)  # type: ignore[return-value]

    @property
    def _rotary(self) -> nn.Module:
        return self.get_submodule(f"{self._language}.rotary_emb")

    def settings(self) -> dict[str, str]:
        """Digests of the model's configuration and processor, and the tokens that end answers."""
        contents = {"config.json": self.vlm.config.to_json_string().encode(), **self._files}
        digests = {name: hashlib.sha256(own).hexdigest() for name, own in contents.items()}
        return {"ends": str(self.vlm.generation_config.eos_token_id), **digests}

    def preparation(self) -> Mapping[str, str]:
        return self._prompter.preparation

    def _measure_keys(self) -> tuple[int, int]:
        """The number and size of the key heads, from a pass over one black image.

        The pass shows what the model does, whatever its configuration says.
        """
        black = torch.zeros(1, 64, 64, 3, dtype=torch.uint8)
        try:
            batch = self.prepare(black, ["a"])
            with torch.no_grad(), unrotated(self._layers) as plain:
                seen = self._passed(batch)
            encoding = self._encoding(seen, batch)
        except AegisError as error:
            # A text of one letter can only be refused because of how the processor expands it.
            found = error.found
            if not self._prompter.places_image():
                found = "the chat template places no image in what the model is asked"
            raise model_folder.misfit(found) from error
        except (
            ValueError,
            LookupError,
            RuntimeError,
            TypeError,
            AttributeError,
            TemplateError,
        ) as error:
            raise model_folder.misfit(in_short(error)) from error
        if len(encoding.keys_values) != self.depth or not encoding.image.any():
            found = "no image token among the processor's, or a layer that keeps no keys"
            raise model_folder.misfit(found)
        self._axes = seen.axes()
        self._check_rotation(encoding, plain)
        _, heads, _, head_dim = encoding.keys_values[0].key.shape
        return heads, head_dim

    @torch.no_grad()
    def _check_rotation(self, encoding: Encoding, plain: Mapping[int, Tensor]) -> None:
        """Raise AegisError unless each layer rotates keys as the expert rotates its own.

        The last token's key is compared; `plain` has the keys before the rotation.
        """
        last = encoding.mask.shape[1] - 1
        wanted = {}
        try:
            before = torch.tensor([-1], device=encoding.mask.device)
            rotations = self._rotations(encoding, before)
            for i, key in plain.items():
                as_block = key[:, :, None, last:]  # [B, h, 1, 1, d], as `rotate` takes it
                wanted[i] = rotate(as_block, rotations[i])[:, :, 0]
        except (TypeError, ValueError, RuntimeError, LookupError, AttributeError) as error:
            # For instance, its rotary embedding has another signature.
            raise model_folder.foreign_rotation(0) from error
        for i, key in wanted.items():
            own = encoding.keys_values[i].key[:, :, last:]
            if not torch.allclose(own, key, rtol=1e-3, atol=1e-4):
                raise model_folder.foreign_rotation(i)

    # --- forward -------------------------------------------------------------------------------

    def encode(self, batch: Batch) -> Encoding:
        return self._encoding(self._passed(batch), batch)

    def _passed(self, batch: Batch) -> Seen:
        """The record of a pass without the head: an action expert does not read scores of words."""
        with recording(self._layers, self._rotary) as seen:
            self.vlm.base_model(**_arguments(batch), use_cache=False)
        return seen

    def _encoding(self, seen: Seen, batch: Batch) -> Encoding:
        layers = range(self.depth)
        return Encoding(
            tuple(seen.hidden[i] for i in layers),
            tuple(seen.keys_values[i] for i in layers),
            batch.mask,
            batch.ids == self.vlm.config.image_token_id,
            seen.next_position(batch.mask),
        )

    def suffix(self, encoding: Encoding, count: int) -> Suffix:
        """How `count` tokens that follow the encoding see it.

        They take the positions that a generated answer would take, and in layers with a sliding
        window see as far back as the answer would.
        """
        ahead = torch.arange(count, device=encoding.mask.device)
        rotations = self._rotations(encoding, ahead)
        rotation = rotations if self._layer_types is not None else rotations[0]
        windows = [sliding_window(layer) for layer in self._layers]
        if not any(windows):
            return Suffix(encoding.mask, rotation)
        visible = encoding.mask[:, None].expand(-1, count, -1)  # [B, S, T]
        place = encoding.mask.sum(1)[:, None] + ahead  # [B, S], indices of the tokens that follow
        # The distance of each of them from each token of the encoding, [B, S, T].
        back = place[:, :, None] - torch.arange(encoding.mask.shape[1], device=place.device)
        per_layer = []
        for window in windows:
            per_layer.append(visible if window is None else visible & (back < window))
        return Suffix(tuple(per_layer), rotation)

    def _rotations(self, encoding: Encoding, ahead: Tensor) -> list[Rotation]:
        """Each layer's rotary embedding for tokens at offsets [S] from the first that follows."""
        assert encoding.next_position is not None
        like = encoding.hidden[0].new_empty(0, dtype=torch.float32)
        places = encoding.next_position[:, None] + ahead  # [B, S]
        if self._axes is not None:  # text has the same position on each axis
            places = places.expand(self._axes, *places.shape)
        if self._layer_types is None:
            return [self._rotation(like, places)] * self.depth
        of_type = {}
        for kind in dict.fromkeys(self._layer_types):
            of_type[kind] = self._rotation(like, places, kind)
        return [of_type[kind] for kind in self._layer_types]

    def _rotation(self, *asked: Any) -> Rotation:
        """The output of the rotary embedding, as cosines and sines [B, S, head_dim]."""
        cosines, sines = self._rotary(*asked)
        if cosines.ndim == 4:
            # In transformers 5.5, Qwen2-VL's returns those of each axis, [3, B, S, head_dim], and
            # attention chooses among them. For text all axes are the same.
            return Rotation(cosines[0], sines[0])
        return Rotation(cosines, sines)

    def checkpoint_gradients(self) -> None:
        # Reentrant checkpointing would lose what the hooks record. The non-reentrant kind also
        # works without inputs that require a gradient.
        how = {"use_reentrant": False}
        if hasattr(self.vlm, "activation_checkpointing_enable"):
            self.vlm.activation_checkpointing_enable(how)
        else:  # its name in earlier releases, such as transformers 5.5
            self.vlm.gradient_checkpointing_enable(how)
        self.vlm.disable_input_require_grads()

    def compile_passes(self, backend: str = "inductor") -> None:
        """Compile the transformer layers, and pad prompts to multiples of `MULTIPLE` tokens.

        The whole pass is full of Python that depends on the data: compiling two steps of a tiny
        model took over five minutes. The last language layer is not compiled, since its output may
        be unused: compiled, it would give zero gradients to parameters that have none, and an
        optimizer updates whatever has a gradient.

        Raises:
            AegisError: the language layers take no cache under a known name.
        """
        for layer in self._layers:
            if not takes_cache(layer):
                raise AegisError(
                    f"train.compile with layers of {type(layer).__name__}, which are given no "
                    f"'{CACHE}' or '{EARLIER}'",
                    "a backbone of a known family, or no compilation",
                    "--set train.compile=false",
                )
        for layers in outermost_lists(self.vlm):
            if layers is self._layers:
                compile_layers(layers[:-1], backend, keeps_keys=True)
            else:
                compile_layers(layers, backend, keeps_keys=False)
        self._multiple = MULTIPLE

    # --- questions -----------------------------------------------------------------------------

    def process(self, images: Images, prompts: Sequence[str]) -> Batch:
        batch = self._prompter.process(images, prompts, "right")
        return self._prompter.padded(batch, self._multiple)

    def answer(
        self, images: Images, questions: Sequence[str], most: int | None = None
    ) -> list[str]:
        tokens = MAX_ANSWER if most is None else most
        # Padding on the left, so that generated tokens directly follow each prompt.
        prompts = self._prompter.process(images, questions, "left")
        return self._generated(prompts, [tokens] * len(questions))

    @torch.no_grad()
    def _generated(self, prompts: Batch, most: Sequence[int]) -> list[str]:
        """Generate the model's answers, each up to its own number of tokens."""
        batch = prompts.to(self.device)
        assert isinstance(self.vlm, transformers.GenerationMixin)
        with _greedy(self.vlm, self._prompter.filler):
            said = self.vlm.generate(**_arguments(batch), max_new_tokens=max(most))
        rows = said[:, batch.ids.shape[1] :].tolist()  # without the prompts
        return self._prompter.decode([row[:own] for row, own in zip(rows, most, strict=True)])

    def answers(self, batches: Iterable[Asked]) -> Iterator[tuple[list[str], Tensor]]:
        """See `Backbone.answers`; on a GPU, the next batches are prepared at the same time.

        Each image is processed once, and without gradients the vision tower reads it once.
        """

        def prepare(asked: Asked) -> tuple[Batch, _Answered]:
            images, questions, answers = asked
            prompts = self._prompter.process(images, questions, "right")
            return self._prompter.padded_left(prompts), self._answered(prompts, answers)

        with prefetch.for_device(prepare, batches, self.device) as prepared:
            for prompts, answered in prepared:
                # One more than the reference, so that a longer answer does not match it.
                most = [max(MAX_ANSWER, len(said) + 1) for said in answered.said]
                with _features_once(self.vlm.base_model):
                    found = self._generated(prompts, most), self._log_likelihood(answered)
                yield found

    def check_prompt(self, text: str) -> None:
        self._prompter.check_text(text)

    def check_text(self, question: str, answer: str, image: Tensor | None = None) -> None:
        for text in (question, answer):
            self._prompter.check_text(text)
        if image is not None:
            self.prepare_answers([image], [question], [answer])

    def _ends(self) -> list[int]:
        """The tokens that each end an answer."""
        ends = self.vlm.generation_config.eos_token_id
        return list(ends) if isinstance(ends, list | tuple) else [ends]

    def answer_log_likelihood(
        self,
        images: Images,
        questions: Sequence[str],
        answers: Sequence[str],
        prepared: _Answered | None = None,
    ) -> Tensor:
        return self._log_likelihood(prepared or self.prepare_answers(images, questions, answers))

    def prepare_answers(
        self, images: Images, questions: Sequence[str], answers: Sequence[str]
    ) -> _Answered:
        return self._answered(self._prompter.process(images, questions, "right"), answers)

    def _answered(self, prompts: Batch, answers: Sequence[str]) -> _Answered:
        """Prompts followed by their answers, on the CPU: reading lengths from a GPU would wait."""
        said = self._prompter.answer_ids(answers)
        lengths = prompts.mask.sum(1).tolist()
        asked = self._prompter.padded(self._prompter.extend(prompts, said), self._multiple)
        return _Answered(asked, lengths, said)

    def _log_likelihood(self, answered: _Answered) -> Tensor:
        """See `answer_log_likelihood`."""
        batch, lengths, said = answered.batch.to(self.device), answered.lengths, answered.said
        # Each position has a score for every word of the vocabulary, and a batch of images of
        # several sizes has a thousand positions. So only those that predict an answer are scored.
        first = min(lengths) - 1  # the earliest of them, from which on scores are taken
        rows: list[int] = []
        columns: list[int] = []
        for row, (length, words) in enumerate(zip(lengths, said, strict=True)):
            start = length - 1 - first  # the prompt's last token predicts the first word
            rows += [row] * (len(words) + 1)
            columns += range(start, start + len(words) + 1)
        places = send(torch.tensor([rows, columns]), self.device)
        with _head_at(self.get_submodule(self._head), *places):
            (scores,) = self._scores(batch, batch.ids.shape[1] - first)  # [sum of words + 1, V]
        log_shares = scores.log_softmax(-1)
        # The position that predicts the end has no word; index 0 is a placeholder there.
        words = send(torch.tensor([word for own in said for word in (*own, 0)]), self.device)
        of_words = log_shares.gather(1, words[:, None]).squeeze(1)  # [sum of words + 1]
        # Any of the end tokens ends the answer, so their probabilities add up.
        ends = send(torch.tensor(self._ends()), self.device)
        of_ends = log_shares.index_select(1, ends).logsumexp(1)
        counts = [len(own) + 1 for own in said]
        total = []
        for own_words, own_ends in zip(of_words.split(counts), of_ends.split(counts), strict=True):
            total.append(own_words[:-1].sum() + own_ends[-1])
        return torch.stack(total)

    def _scores(self, batch: Batch, last: int) -> Tensor:
        """Scores of the next token at the last positions, [B, last, V] float32."""
        return self.vlm(**_arguments(batch), use_cache=False, logits_to_keep=last).logits.float()

    def read_vqa(
        self,
        images: Tensor | Sequence[Tensor],
        image_of: Tensor,
        questions: Sequence[str],
        answers: Sequence[str],
        together: int = 8,
    ) -> Iterator[AnswerScores]:
        """See `Backbone.read_vqa`; an image is passed per question, which may affect its states."""
        said = self._prompter.answer_ids(answers)
        shown = [images[i] for i in image_of.tolist()]
        shapes = self._prompter.shapes(shown, questions)
        sizes = list(zip(self._prompter.lengths(questions), map(len, said), shapes, strict=True))
        # Equal sizes need no padding, so hooks see only real tokens.
        parts: list[list[int]] = []
        for size in sorted(set(sizes)):
            rows = [i for i, own in enumerate(sizes) if own == size]
            parts += [rows[start : start + together] for start in range(0, len(rows), together)]

        def prepare(part: list[int]) -> Batch:
            own, asked = [shown[i] for i in part], [questions[i] for i in part]
            prompts = self._prompter.process(own, asked, "right")
            return self._prompter.extend(prompts, [said[i] for i in part])

        with prefetch.for_device(prepare, parts, self.device) as prepared:
            for part, batch in zip(parts, prepared, strict=True):
                # One more than the answer's words: the last position predicts its end.
                words = len(said[part[0]]) + 1
                scores = self._scores(batch.to(self.device), words).flatten(0, 1)
                yield AnswerScores(scores, torch.tensor(part).repeat_interleave(words))

    # --- weights -------------------------------------------------------------------------------

    def in_vision(self, name: str) -> bool:
        return not name.startswith(f"{self._language}.") and name != self._head

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        groups: dict[str, list[nn.Parameter]] = {f"layers.{i}": [] for i in range(self.depth)}
        # `named_parameters` yields a tied weight once, under its first name.
        for name, parameter in self.named_parameters():
            groups.setdefault(self._group(name), []).append(parameter)
        return groups

    def _group(self, name: str) -> str:
        if name.startswith(f"{self._layers_path}."):
            return f"layers.{name[len(self._layers_path) + 1 :].partition('.')[0]}"
        owner = name.rpartition(".")[0]
        known = {self._table: "embeddings", self._head: "head"}
        return known.get(owner, "vision" if self.in_vision(owner) else "final_norm")

    def language_maps(self) -> dict[str, nn.Linear]:
        below = f"{self._layers_path}."
        return {
            name: m
            for name, m in self.named_modules()
            if isinstance(m, nn.Linear) and name.startswith(below)
        }

    def save(self, folder: Path) -> None:
        """Write a folder that `from_pretrained` loads.

        It has one file of weights, the configuration and the processor's files. All weights are
        written in one dtype: frozen ones may be narrower here than trainable ones.
        """
        folder.mkdir(parents=True, exist_ok=True)
        weights = list(self.parameters())
        with quiet(), of_type(weights, widest(weights)):
            self.vlm.save_pretrained(folder, max_shard_size="1000TB")
        # safetensors makes the file readable by its owner only.
        shutil.copymode(folder / "config.json", folder / "model.safetensors")
        self._save_processor(folder)

    def save_description(self, folder: Path) -> None:
        """Write everything that `save` writes except the weights; `described` reads it."""
        folder.mkdir(parents=True, exist_ok=True)
        self.vlm.config.save_pretrained(folder)
        self.vlm.generation_config.save_pretrained(folder)
        self._save_processor(folder)

    def _save_processor(self, folder: Path) -> None:
        for name, content in self._files.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_bytes(content)
        if FAMILIES.get(self.vlm.config.model_type) != self._family:
            model_folder.remember_layers(folder, self._family.layers)


def _layer_types(text: Any, rotary: nn.Module) -> Sequence[str] | None:
    """The type of each layer, if the rotary embedding depends on it; None: one for all layers.

    Gemma 3's layers with a sliding window have their own rotary embedding.
    """
    by_kind = "layer_type" in inspect.signature(rotary.forward).parameters
    return text.layer_types if by_kind else None


def _in_own_type(module: nn.Module, _: tuple[Any, ...], output: Tensor) -> Tensor:
    """Cast a module's output to the dtype of its weights, whatever autocast has made of it."""
    return output.to(next(module.parameters()).dtype)


@contextmanager
def _head_at(head: nn.Module, rows: Tensor, columns: Tensor) -> Generator[None]:
    """Inside the block, reduce the head's input [B, T, D] to n chosen positions, [1, n, D]."""

    def chosen(_: nn.Module, given: tuple[Any, ...]) -> tuple[Any, ...]:
        return given[0][rows, columns][None], *given[1:]

    handle = head.register_forward_pre_hook(chosen)
    try:
        yield
    finally:
        handle.remove()


@contextmanager
def _features_once(model: nn.Module) -> Generator[None]:
    """Inside the block, whose passes are all about the same images, their features are made once.

    With gradients they are made in every pass, since each backward pass needs a graph of its own.
    """
    make: Any = getattr(model, "get_image_features", None)
    if make is None or torch.is_grad_enabled():
        yield
        return
    made: list[Any] = []

    @functools.wraps(make)  # `generate` reads from its signature what to give it
    def once(*given: Any, **named: Any) -> Any:
        if not made:
            made.append(make(*given, **named))
        return made[0]

    model.get_image_features = once  # type: ignore[assignment]
    try:
        yield
    finally:
        del model.get_image_features  # the class's own is behind it


@contextmanager
def _greedy(model: transformers.PreTrainedModel, filler: int) -> Generator[None]:
    """Inside the block, the model decodes greedily until an end token.

    Its own settings may sample, or penalise words of the question, as `repetition_penalty` does.
    Only its begin and end tokens are kept. The padding token is the tokenizer's, since the model's
    own may not be in its vocabulary.
    """
    own = model.generation_config
    tokens = {"bos_token_id": own.bos_token_id, "eos_token_id": own.eos_token_id}
    tokens["pad_token_id"] = filler
    model.generation_config = transformers.GenerationConfig(**tokens, do_sample=False, num_beams=1)
    try:
        yield
    finally:
        model.generation_config = own


def _arguments(batch: Batch) -> dict[str, Tensor]:
    """A batch as the model's arguments, by their names."""
    return {
        "pixel_values": batch.pixels,
        "input_ids": batch.ids,
        "attention_mask": batch.mask.long(),
        **batch.extra,
    }


# --- loading --------------------------------------------------------------------------------------


def load(folder: Path, layers: str | None) -> HFBackbone:
    """The model in a folder, in float32 whatever dtype it is stored in.

    Args:
        folder: with config.json, *.safetensors and the processor's files.
        layers: dotted path of the language layers, for a family that is not known.

    Raises:
        AegisError: a model without images, of an unknown family, with missing or unexpected
            weights, or whose processor is missing or belongs to another model.
    """
    model_folder.check_files(folder, transformers.CONFIG_MAPPING)
    kind = transformers.AutoModelForImageTextToText
    backbone = _assembled(folder, layers, lambda config: complete(kind, folder, config))
    backbone.stored = model_folder.stored_type(folder)
    return backbone


def check(folder: Path) -> None:
    """Raise AegisError unless a folder holds a model that takes images with text."""
    model_folder.check_files(folder, transformers.CONFIG_MAPPING)
    with quiet(), loading(folder, "model"):
        config = transformers.AutoConfig.from_pretrained(folder, **SAFE)
        _check_kind(folder, config)


def described(folder: Path) -> HFBackbone:
    """The model that a folder of `save_description` describes; its weights are still to come.

    Raises:
        AegisError: a description from which no model can be built, or another model's processor.
    """
    return _assembled(folder, None, lambda config: _without_weights(folder, config))


def _without_weights(folder: Path, config: Any) -> transformers.PreTrainedModel:
    kind = transformers.AutoModelForImageTextToText
    model = kind.from_config(config, dtype=torch.float32)
    if (folder / "generation_config.json").is_file():
        # It lists the tokens that end an answer.
        model.generation_config = transformers.GenerationConfig.from_pretrained(folder)
    return model


def _assembled(
    folder: Path, layers: str | None, make: Callable[[Any], transformers.PreTrainedModel]
) -> HFBackbone:
    """The backbone around the model that `make` builds from the folder's configuration."""
    with quiet(), loading(folder, "model"):
        config = transformers.AutoConfig.from_pretrained(folder, **SAFE)
        _check_kind(folder, config)
        family = model_folder.family(folder, config.model_type, layers)
        model = make(config)
    model_folder.check_attention(model_folder.check_path(model, family.layers))
    model_folder.check_processor(folder)
    with quiet(), loading(folder, "processor"):
        processor = _processor(folder)
    tokenizer = processor.tokenizer
    if not processor.chat_template:  # a separately saved tokenizer holds it
        processor.chat_template = tokenizer.chat_template
    if tokenizer.pad_token is None:  # as in LLaMA's; padding is masked anyway
        tokenizer.pad_token = tokenizer.eos_token
    if family.prompt is None and not processor.chat_template:
        raise model_folder.misfit(f"no chat template in '{folder}', by which the model is asked")
    return HFBackbone(model, processor, family, model_folder.processor_files(folder)).eval()


def _check_kind(folder: Path, config: Any) -> None:
    # transformers' own error would be a list of all its classes.
    if type(config) not in transformers.AutoModelForImageTextToText._model_mapping:
        raise AegisError(
            f"'{folder}' is a '{config.model_type}' model, which takes no images with its text",
            "a vision-language model: " + ", ".join(FAMILIES),
            "give the folder of such a model",
        )


def _processor(folder: Path) -> transformers.ProcessorMixin:
    """The processor that `AutoProcessor` makes.

    Without torchvision, the processor of a family that also takes videos is put together without
    its part for them.
    """
    kind = getattr(transformers, model_folder.processor_class(folder) or "", None)
    if is_torchvision_available() or kind is None or "video_processor" not in kind.get_attributes():
        return transformers.AutoProcessor.from_pretrained(folder, **SAFE)

    class WithoutVideos(kind):  # type: ignore[misc, valid-type]
        def check_argument_for_proper_class(self, name: str, argument: Any) -> Any:
            if argument is None:
                return None
            return super().check_argument_for_proper_class(name, argument)

    settings, _ = kind.get_processor_dict(folder)
    parts = {
        "image_processor": transformers.AutoImageProcessor.from_pretrained(folder, **SAFE),
        "tokenizer": transformers.AutoTokenizer.from_pretrained(folder, **SAFE),
        "video_processor": None,
    }
    in_order = [parts[name] for name in kind.get_attributes()]
    return WithoutVideos.from_args_and_dict(in_order, settings)
