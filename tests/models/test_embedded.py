"""The properties of the embedded VLM beyond the contract of every backbone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from samples.backbones import LONGEST, TEXTS, close, encode, images, outspoken_tiny
from samples.training import policy_over, robot_batch
from torch import Tensor

from aegis_cli.data.vqa.packing import pack
from aegis_cli.data.vqa.questions import Question
from aegis_cli.models.backbones import embedded_file
from aegis_cli.models.backbones.embedded import MAX_ANSWER, MAX_TEXT, EmbeddedVLM, load_file


@pytest.fixture
def embedded() -> EmbeddedVLM:
    return outspoken_tiny()


def test_text_never_reaches_the_image_tokens(embedded: EmbeddedVLM) -> None:
    first, second = (encode(embedded, images(4), texts) for texts in (TEXTS, TEXTS[::-1]))
    tokens = embedded.shape.image_tokens
    assert first.mask[:, :tokens].all()
    for x, y in zip(first.hidden, second.hidden, strict=True):
        assert torch.equal(x[:, :tokens], y[:, :tokens]) and not torch.equal(x, y)


@torch.no_grad()
def next_word(model: EmbeddedVLM, frame: Tensor, question: str, said: list[int]) -> Tensor:
    """Scores [V] of the word after `said`: one row, one block, no padding, nothing shared."""
    prompt = model.tokenizer.prompt(question)
    ids = torch.tensor([[[*prompt, *said]]])
    return model(model.pixels(frame[None]), ids, torch.tensor([[len(prompt)]]))[0, 0, -1]


def test_a_question_is_read_both_ways(embedded: EmbeddedVLM) -> None:
    """An instruction's first word depends on its last, and the expert reads every token's keys."""
    first, second = (
        encode(embedded, images(1), [f"is there a red {shape}"]) for shape in ("ball", "cube")
    )
    start = embedded.shape.image_tokens
    assert torch.equal(
        first.keys_values[0].key[:, :, start], second.keys_values[0].key[:, :, start]
    )  # the same word
    assert (first.hidden[0][:, start] - second.hidden[0][:, start]).abs().max() > 1e-3


def test_answers_are_greedy(embedded: EmbeddedVLM) -> None:
    frames, texts = images(8), [*TEXTS, *TEXTS]
    answers = embedded.answer(frames, texts)
    for frame, text, answer in zip(frames, texts, answers, strict=True):
        said: list[int] = []
        while len(said) < MAX_ANSWER:
            said.append(int(next_word(embedded, frame, text, said).argmax()))
        assert answer == embedded.tokenizer.decode(said)
    assert len(set(answers)) > 2


def test_the_likelihood_is_the_sum_over_the_words_and_the_end(embedded: EmbeddedVLM) -> None:
    answers = ["red", "x3 y5", "", "two"]
    got = embedded.answer_log_likelihood(images(4), TEXTS, answers)
    for i, answer in enumerate(answers):
        ids = [*embedded.tokenizer.encode(answer), embedded.tokenizer.end]
        scores = [
            next_word(embedded, images(4)[i], TEXTS[i], ids[:n]).log_softmax(-1)[word]
            for n, word in enumerate(ids)
        ]
        close(got[i], torch.stack(scores).sum())


def test_packed_questions_score_as_each_alone(embedded: EmbeddedVLM) -> None:
    said = ["two", "no", "red", "x3 y5", "blue"]
    asked = [
        Question("", text, answer) for text, answer in zip([*TEXTS, LONGEST], said, strict=True)
    ]
    packed = pack([asked], embedded.tokenizer.encode, blocks=len(asked) + 1, length=MAX_TEXT)
    ids, lengths = (
        torch.from_numpy(packed.ids).long(),
        torch.from_numpy(packed.prompt_length).long(),
    )
    pixels = embedded.pixels(images(1))
    with torch.no_grad():
        together = embedded(pixels, ids, lengths)
        for block in range(1, len(asked) + 1):  # block 0 is empty: fewer questions than blocks
            used = int((ids[0, block] != embedded.tokenizer.pad).sum())
            alone = embedded(
                pixels, ids[:, block : block + 1, :used], lengths[:, block : block + 1]
            )
            close(together[0, block, :used], alone[0, 0])
    assert lengths[0, 0] == 0 and together.isfinite().all()


def test_an_answer_never_sees_its_own_future(embedded: EmbeddedVLM) -> None:
    """With teacher forcing, a word is scored from those before it, with all words in the block."""
    prompt = embedded.tokenizer.prompt(TEXTS[0])
    red, blue = (
        torch.tensor([[[*prompt, *embedded.tokenizer.encode(f"two {color}")]]])
        for color in ("red", "blue")
    )
    with torch.no_grad():
        x, y = (
            embedded(embedded.pixels(images(1)), ids, torch.tensor([[len(prompt)]]))
            for ids in (red, blue)
        )
    assert torch.equal(x[:, :, :-1], y[:, :, :-1]) and not torch.equal(x, y)


def test_an_answer_ends_at_its_end(embedded: EmbeddedVLM) -> None:
    red, blue = embedded.tokenizer.encode("red blue")
    assert embedded.tokenizer.decode([red, embedded.tokenizer.end, blue]) == "red"
    assert embedded.tokenizer.decode([embedded.tokenizer.end, blue]) == ""
    with torch.no_grad():  # a model that answers nothing
        embedded.final_norm.bias.copy_(100 * embedded.words.weight[embedded.tokenizer.end])
    assert embedded.answer(images(4), TEXTS) == [""] * 4


def test_the_longest_text_fits(embedded: EmbeddedVLM) -> None:
    question = " ".join(
        ["ball"] * (MAX_TEXT - MAX_ANSWER)
    )  # with the answer marker and all but the last word said
    assert len(embedded.answer(images(1), [question])) == 1
    assert embedded.answer_log_likelihood(images(1), [question], ["red cube"]).isfinite().all()


# While tracing a graph, torch.compile accesses a field for which PyTorch warns.
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
def test_texts_of_every_length_share_what_is_compiled(embedded: EmbeddedVLM) -> None:
    made = {"backbone": 0, "expert": 0}

    def counting(part: str) -> Callable[..., Any]:
        def count(graph: torch.fx.GraphModule, _: object) -> Any:
            made[part] += 1
            return graph.forward

        return count

    torch.compiler.reset()
    plain, compiled = policy_over(outspoken_tiny()), policy_over(embedded)
    compiled.backbone.compile_passes(counting("backbone"))  # type: ignore[arg-type]
    compiled.expert.compile_layers(counting("expert"))  # type: ignore[arg-type]
    for words in range(1, MAX_TEXT):  # a marker follows them
        batch = replace(robot_batch(2), instructions=["ball", " ".join(["ball"] * words)])
        losses, gradients = [], []
        for policy in (plain, compiled):
            encoding = policy.encode(batch.images, batch.instructions)
            loss = policy.flow_loss(batch, encoding, 2, torch.Generator().manual_seed(0))
            losses.append(loss)
            gradients.append(torch.autograd.grad(loss, policy.backbone.words.weight))
        close(*losses)
        close(*(gradient for (gradient,) in gradients))
    assert made["backbone"] <= 2
    assert made["expert"] <= 5


def test_a_half_precision_file_loads_in_float32(embedded: EmbeddedVLM, tmp_path: Path) -> None:
    embedded.load_state_dict(
        {name: t.bfloat16().float() for name, t in embedded.state_dict().items()}
    )
    file = tmp_path / "half.safetensors"
    embedded_file.save(embedded, file, torch.bfloat16, {"seed": 3})
    loaded, provenance = load_file(file)
    assert provenance == {"seed": 3}
    assert loaded.fingerprint() == embedded.fingerprint()
    assert {p.dtype for p in loaded.parameters()} == {torch.float32}
