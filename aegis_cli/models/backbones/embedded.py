"""The embedded VLM: a convolutional stem and a prefix language model.

It has about three million parameters. Image tokens attend among themselves. Each block of text
attends to the image and to itself, bidirectionally within a question and causally within its
answer. So the image's part of a pass never depends on the text: it is computed once for all
questions about an image, and for all steps of decoding an answer.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from aegis_cli.common.devices import send
from aegis_cli.common.errors import AegisError
from aegis_cli.core.activation import squared_relu
from aegis_cli.core.attention import KeyValue, additive, block_attention
from aegis_cli.data.batch import Images
from aegis_cli.models.backbones import embedded_file
from aegis_cli.models.backbones.base import AnswerScores, Backbone, Batch, Encoding
from aegis_cli.models.backbones.tokenizer import Tokenizer

MAX_TEXT = 20  # the most tokens of a question with its answer
MAX_ANSWER = 4  # the most tokens of an answer with its end
# Tokens; a compiled model's prompts are padded to multiples of this. MAX_TEXT is one.
MULTIPLE = 4
# The location words of data/vqa/questions.py, which would itself load MuJoCo.
X_WORDS, Y_WORDS = (tuple(f"{axis}{i}" for i in range(8)) for axis in "xy")


@dataclass(frozen=True)
class Shape:
    """Sizes of the model; `image_size` must be eight times the side of the token grid."""

    width: int = 192
    depth: int = 6
    heads: int = 6
    mlp_ratio: int = 4
    stem_width: int = 48
    image_size: int = 64

    @property
    def image_tokens(self) -> int:
        """Number of tokens of one image: the stem halves each side three times."""
        return (self.image_size // 8) ** 2


class Stem(nn.Module):
    """Strided convolutions, each followed by a residual one.

    Pixels [B, 3, H, W] become tokens [B, (H/8)(W/8), D].
    """

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        c = shape.stem_width
        widths = (3, c, 2 * c, shape.width)
        self.halve = nn.ModuleList(
            nn.Conv2d(a, b, 4, stride=2, padding=1) for a, b in pairwise(widths)
        )
        self.mix = nn.ModuleList(nn.Conv2d(b, b, 3, padding=1) for b in widths[1:])
        self.position = nn.Embedding(shape.image_tokens, shape.width)
        nn.init.normal_(self.position.weight, std=0.02)

    def forward(self, pixels: Tensor) -> Tensor:
        x = pixels
        for halve, mix in zip(self.halve, self.mix, strict=True):
            x = halve(x)
            x = x + mix(F.relu(x))
        x = x.flatten(2).transpose(1, 2)  # [B, D, H/8, W/8] -> [B, (H/8)(W/8), D]
        return x + self.position(torch.arange(x.shape[1], device=x.device))


class Layer(nn.Module):
    """A pre-norm transformer layer over N blocks of S tokens that may attend to a shared prefix."""

    def __init__(self, width: int, heads: int, mlp_ratio: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm1 = nn.LayerNorm(width)
        self.qkv = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)
        self.norm2 = nn.LayerNorm(width)
        self.up = nn.Linear(width, mlp_ratio * width)
        self.down = nn.Linear(mlp_ratio * width, width)

    def forward(
        self, x: Tensor, own_mask: Tensor | None, prefix: KeyValue | None
    ) -> tuple[Tensor, KeyValue]:
        """One pass of x [B, N, S, D] through the layer.

        Args:
            own_mask: additive, broadcastable to [B, 1, N, S, S].
            prefix: keys and values of the shared prefix, [B, h, P, d] each.

        Returns:
            The output, in the shape of x, and its keys and values [B, h, N*S, d] each.
        """
        qkv = self.qkv(self.norm1(x)).unflatten(-1, (3, self.heads, -1))  # [B, N, S, 3, h, d]
        query, key, value = qkv.permute(3, 0, 4, 1, 2, 5).unbind(0)  # [B, h, N, S, d] each
        mixed = block_attention(query, KeyValue(key, value), own_mask, prefix)
        x = x + self.out(mixed.permute(0, 2, 3, 1, 4).flatten(3))  # of [B, N, S, h * d]
        x = x + self.down(squared_relu(self.up(self.norm2(x))))
        return x, KeyValue(key.flatten(2, 3), value.flatten(2, 3))


class EmbeddedVLM(Backbone):
    """A small VLM that ships with the package."""

    kind: ClassVar[str] = "backbone"
    tied_heads: Mapping[str, str] = {"words": "final_norm"}
    numbers: int = len(X_WORDS) * len(Y_WORDS)
    _multiple = 1  # tokens; prompt lengths are multiples of it

    def __init__(self, shape: Shape, vocabulary: Sequence[str]) -> None:
        """Initialize the weights in float32, whatever the default dtype is."""
        super().__init__()
        self.shape, self.tokenizer = shape, Tokenizer(vocabulary)
        self.depth, self.width = shape.depth, shape.width
        self.heads = self.kv_heads = shape.heads
        self.head_dim, self.image_size = shape.width // shape.heads, shape.image_size
        self.stem = Stem(shape)
        self.words = nn.Embedding(len(vocabulary), shape.width)
        self.text_position = nn.Embedding(MAX_TEXT, shape.width)
        layers = [Layer(shape.width, shape.heads, shape.mlp_ratio) for _ in range(shape.depth)]
        self.layers = nn.ModuleList(layers)
        self.final_norm = nn.LayerNorm(shape.width)
        for table in (self.words, self.text_position):
            nn.init.normal_(table.weight, std=0.02)
        # Residual branches start small, so that depth does not inflate the stream.
        for layer in layers:
            for branch in (layer.out, layer.down):
                nn.init.normal_(branch.weight, std=0.02 / (2 * shape.depth) ** 0.5)
        self.float()

    # --- forward -------------------------------------------------------------------------------

    def image_pass(self, pixels: Tensor) -> tuple[list[Tensor], list[KeyValue]]:
        """Each layer's hidden states [B, T, D], keys and values, for pixels [B, 3, H, W]."""
        x = self.stem(pixels).unsqueeze(1)  # [B, 1, T, D]: an image is one block
        hidden, keys_values = [], []
        for layer in self.layers:
            x, kv = layer(x, None, None)
            hidden.append(x.squeeze(1))
            keys_values.append(kv)
        return hidden, keys_values

    def text_pass(
        self, ids: Tensor, prompt_length: Tensor, image: Sequence[KeyValue]
    ) -> tuple[list[Tensor], list[KeyValue]]:
        """Hidden states [B, N, S, D] of blocks of text ids [B, N, S].

        The first `prompt_length` [B, N] tokens of each block are a prompt.
        """
        x = self.words(ids) + self.text_position(torch.arange(ids.shape[-1], device=ids.device))
        mask = additive(_prefix_causal(ids, prompt_length, self.tokenizer.pad)).unsqueeze(1)
        # [B, 1, N, S, S], the same for all heads. Layer i reads the image's keys of layer i.
        hidden, keys_values = [], []
        for layer, prefix in zip(self.layers, image, strict=True):
            x, kv = layer(x, mask, prefix)
            hidden.append(x)
            keys_values.append(kv)
        return hidden, keys_values

    def logits(self, hidden: Tensor) -> Tensor:
        """Scores [..., V] float32 of the next word, from the last layer's hidden states [..., D].

        The embedding table is tied: it serves as the output head.
        """
        return F.linear(self.final_norm(hidden), self.words.weight).float()

    def forward(self, pixels: Tensor, ids: Tensor, prompt_length: Tensor) -> Tensor:
        """Scores of the next word at every text position, [B, N, S, V]."""
        _, image = self.image_pass(pixels)
        hidden, _ = self.text_pass(ids, prompt_length, image)
        return self.logits(hidden[-1])

    def encode(self, batch: Batch) -> Encoding:
        image_hidden, image = self.image_pass(batch.pixels)
        length = batch.mask.sum(-1, keepdim=True)  # [B, 1]: the whole text is prompt
        text_hidden, text = self.text_pass(batch.ids.unsqueeze(1), length, image)
        hidden = []
        for of_image, of_text in zip(image_hidden, text_hidden, strict=True):
            hidden.append(torch.cat([of_image, of_text.squeeze(1)], dim=1))
        joined = []
        for of_image, of_text in zip(image, text, strict=True):
            key = torch.cat([of_image.key, of_text.key], dim=2)  # [B, h, image + text tokens, d]
            value = torch.cat([of_image.value, of_text.value], dim=2)
            joined.append(KeyValue(key, value))
        count, device = image_hidden[0].shape[1], batch.mask.device
        image_mask = torch.ones(len(batch.ids), count, dtype=torch.bool, device=device)
        mask = torch.cat([image_mask, batch.mask], dim=1)
        is_image = torch.arange(hidden[0].shape[1], device=device) < count
        return Encoding(tuple(hidden), tuple(joined), mask, is_image)

    def compile_passes(self, backend: str = "inductor") -> None:
        """Compile the whole pass, and pad prompts to multiples of `MULTIPLE` tokens.

        The expert's layers, which read this pass, are compiled again for each length; padding
        leaves five.
        """
        super().compile_passes(backend)
        self._multiple = MULTIPLE

    # --- questions -----------------------------------------------------------------------------

    def pixels(self, images: Images) -> Tensor:
        """Images [B, H, W, 3] uint8 as [B, 3, H, W] float32 in [-1, 1]."""
        assert isinstance(images, Tensor)  # all of the `image_size`
        return send(images, self.device).permute(0, 3, 1, 2).float() / 127.5 - 1

    def process(self, images: Images, prompts: Sequence[str]) -> Batch:
        ids, mask = self._pad([self.tokenizer.prompt(text) for text in prompts], self._multiple)
        return Batch(self.pixels(images), ids, mask)

    @torch.no_grad()
    def answer(
        self, images: Images, questions: Sequence[str], most: int | None = None
    ) -> list[str]:
        image = self._shared_image_pass(images)
        rows = [self.tokenizer.prompt(text) for text in questions]
        prompt_length = torch.tensor([[len(row)] for row in rows], device=self.device)
        answers: list[list[int]] = [[] for _ in rows]
        # Each round passes the whole text again, at most 20 tokens; the image is passed once. All
        # rows continue to the last round, and `decode` cuts each at its first end token.
        for _ in range(MAX_ANSWER if most is None else min(most, MAX_ANSWER)):
            ids, mask = self._pad([row + said for row, said in zip(rows, answers, strict=True)])
            hidden, _ = self.text_pass(ids.unsqueeze(1), prompt_length, image)
            last = hidden[-1].squeeze(1)[torch.arange(len(rows)), mask.sum(-1) - 1]  # [B, D]
            following = self.logits(last).argmax(-1).tolist()
            for said, word in zip(answers, following, strict=True):
                said.append(word)
        return [self.tokenizer.decode(said) for said in answers]

    def answer_log_likelihood(
        self,
        images: Images,
        questions: Sequence[str],
        answers: Sequence[str],
        prepared: None = None,
    ) -> Tensor:
        prompts = [self.tokenizer.prompt(text) for text in questions]
        said = [[*self.tokenizer.encode(text), self.tokenizer.end] for text in answers]
        ids, mask = self._pad([p + a for p, a in zip(prompts, said, strict=True)])
        prompt_length = send(torch.tensor([[len(p)] for p in prompts]), self.device)
        hidden, _ = self.text_pass(ids.unsqueeze(1), prompt_length, self._shared_image_pass(images))
        scores = self.logits(hidden[-1]).squeeze(1).log_softmax(-1)
        # The scores at a position predict the next token.
        chosen = scores[:, :-1].gather(-1, ids[:, 1:, None]).squeeze(-1)  # [B, S - 1]
        position = torch.arange(ids.shape[1] - 1, device=self.device)
        # The prompt's last token predicts the answer's first.
        in_answer = (position >= prompt_length - 1) & mask[:, 1:]
        return (chosen * in_answer).sum(-1)

    def read_vqa(
        self,
        images: Tensor | Sequence[Tensor],
        image_of: Tensor,
        questions: Sequence[str],
        answers: Sequence[str],
        together: int = 8,
    ) -> Iterator[AnswerScores]:
        _, image = self.image_pass(self.pixels(images))
        prompts = [self.tokenizer.prompt(text) for text in questions]
        said = [[*self.tokenizer.encode(text), self.tokenizer.end] for text in answers]
        rows = [prompt + answer for prompt, answer in zip(prompts, said, strict=True)]
        found, question = [], []
        # Texts of equal length make a batch without padding.
        for length in sorted({len(row) for row in rows}):
            chosen = [i for i, row in enumerate(rows) if len(row) == length]
            ids, _ = self._pad([rows[i] for i in chosen])
            prompt_length = torch.tensor([[len(prompts[i])] for i in chosen], device=self.device)
            own = image_of[chosen].to(self.device)
            # The backward pass of index_select is several times faster than k[own]'s on a CPU.
            shared = [KeyValue(k.index_select(0, own), v.index_select(0, own)) for k, v in image]
            hidden, _ = self.text_pass(ids.unsqueeze(1), prompt_length, shared)
            scores = self.logits(hidden[-1]).squeeze(1)  # [rows, length, V]
            position = torch.arange(length, device=self.device)
            # From the prompt's last token, which predicts the first word, to the last word, which
            # predicts the end. Entries are selected row by row, in the order of `question` below.
            found.append(scores[(position >= prompt_length - 1) & (position < length - 1)])
            for i in chosen:
                question += [i] * len(said[i])
        # In one part, since all gradients go back through the same images.
        yield AnswerScores(torch.cat(found), torch.tensor(question))

    def _shared_image_pass(self, images: Images) -> list[KeyValue]:
        """Each row's image keys and values.

        A run of equal images, such as for the questions about one image, is passed once.
        """
        assert isinstance(images, Tensor)
        begins = torch.ones(len(images), dtype=torch.bool)
        begins[1:] = (images[1:] != images[:-1]).flatten(1).any(1)
        # The sum counts the runs up to each row; minus 1, it is the index of the row's own run.
        row = send(begins.cumsum(0) - 1, self.device)
        _, image = self.image_pass(self.pixels(images[begins]))
        found = []
        for key, value in image:
            found.append(KeyValue(key.index_select(0, row), value.index_select(0, row)))
        return found

    def number_texts(self, count: int) -> list[str]:
        """Location words: the closed vocabulary has no other words for quantities above four.

        Numbers below 8 are one word, `x0` to `x7`, and more are two digits, `x0 y0` to `x7 y7`.
        """
        if count <= len(X_WORDS):
            return list(X_WORDS[:count])
        return [f"{x} {y}" for x in X_WORDS for y in Y_WORDS][:count]

    def check_prompt(self, text: str) -> None:
        _check_length(len(self.tokenizer.prompt(text)))

    def check_text(self, question: str, answer: str, image: Tensor | None = None) -> None:
        prompt, reference = self.tokenizer.prompt(question), self.tokenizer.encode(answer)
        # The model's own answer has to fit too.
        _check_length(len(prompt) + max(len(reference) + 1, MAX_ANSWER - 1))

    def _pad(self, rows: Sequence[Sequence[int]], multiple: int = 1) -> tuple[Tensor, Tensor]:
        """Pad rows of ids on the right: ids [B, S] and their mask [B, S].

        Args:
            multiple: the number that S is a multiple of.
        """
        longest = max(len(row) for row in rows)
        _check_length(longest)
        length = -(-longest // multiple) * multiple
        padded = [[*row, *[self.tokenizer.pad] * (length - len(row))] for row in rows]
        ids = send(torch.tensor(padded), self.device)
        return ids, ids != self.tokenizer.pad

    # --- weights -------------------------------------------------------------------------------

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        groups = {f"layers.{i}": list(layer.parameters()) for i, layer in enumerate(self.layers)}
        groups["stem"] = list(self.stem.parameters())
        tables = (self.words, self.text_position)
        groups["embeddings"] = [p for table in tables for p in table.parameters()]
        groups["final_norm"] = list(self.final_norm.parameters())
        return groups

    def language_maps(self) -> dict[str, nn.Linear]:
        return {
            name: module for name, module in self.named_modules() if isinstance(module, nn.Linear)
        }

    def in_vision(self, name: str) -> bool:
        return name.startswith("stem.")

    def save(self, folder: Path, provenance: Mapping[str, object] | None = None) -> None:
        path = Path(folder) / "model.safetensors"
        embedded_file.save(self, path, torch.float32, provenance)


def load_file(path: Path) -> tuple[EmbeddedVLM, dict[str, object]]:
    """Load the model in an artifact, in float32, and its provenance.

    Raises:
        AegisError: the file is damaged, or its tensors are not those of the model it describes.
    """
    return embedded_file.load(path, EmbeddedVLM, Shape)


def _check_length(tokens: int) -> None:
    if tokens > MAX_TEXT:
        raise AegisError(
            f"a text of {tokens} tokens (words, the answer's among them, and markers)",
            f"at most {MAX_TEXT}, the embedded VLM's positions",
            "ask with fewer words",
        )


def _prefix_causal(ids: Tensor, prompt_length: Tensor, pad: int) -> Tensor:
    """The attention mask, [B, N, S, S] bool.

    Prompt tokens attend to each other in both directions, later ones causally, and none to padding.
    """
    position = torch.arange(ids.shape[-1], device=ids.device)
    in_prompt = position < prompt_length.unsqueeze(-1)  # [B, N, S]
    # The last dimension is that of the keys: prompt tokens are visible to all, others to later
    # tokens.
    causal = position[:, None] >= position[None, :]  # [S, S]
    allowed = causal | in_prompt.unsqueeze(-2)
    is_token = (ids != pad).unsqueeze(-2)  # [B, N, 1, S]
    # The diagonal gives padded rows something to attend to.
    itself = torch.eye(len(position), dtype=torch.bool, device=ids.device)
    return (allowed & is_token) | itself
