"""An anchor's statistics of a VLM's inputs and parameters, against hand-written computations."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from samples.tiny import make_tiny
from samples.training import double_policy, images, make_questions
from torch import Tensor, nn
from torch.nn import functional as F

from aegis_cli.anchors import curvature, fisher, inputs, passes
from aegis_cli.common.errors import AegisError
from aegis_cli.core.spectrum import Spectrum
from aegis_cli.data.vqa.dataset import VQASet
from aegis_cli.data.vqa.questions import Question
from aegis_cli.models.backbones.embedded import EmbeddedVLM

ASKED = (
    ("what color is the cube", "red"),
    ("count the objects", "two"),
    ("where is the red ball", "x3 y5"),
    ("which color does the blue ball have", "blue"),
    ("is there a ball", "yes"),
)
IMAGE_OF = (0, 0, 1, 2, 2)
SCORES = "words.scores"
Rows = dict[str, Tensor]


def make_set(image_of: tuple[int, ...] = IMAGE_OF) -> VQASet:
    """Questions of several lengths about noise."""
    asked = tuple(Question("color", *pair) for pair in ASKED)
    return VQASet(images(max(image_of) + 1, seed=5).numpy(), np.array(image_of), asked)


def double_tiny() -> EmbeddedVLM:
    """In float64, with scales and shifts of normalisations unlike an untrained model's."""
    model = double_policy().backbone
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if "norm" in name:
                parameter += 0.3 * torch.randn(parameter.shape, generator=generator)
    return model


def tokens(model: EmbeddedVLM, question: Question) -> tuple[list[int], int]:
    """Ids of the question with its answer and end token, and the length of the prompt."""
    prompt = model.tokenizer.prompt(question.text)
    return [*prompt, *model.tokenizer.encode(question.answer), model.tokenizer.end], len(prompt)


# --- a VLM written out ----------------------------------------------------------------------------


def convolve(conv: nn.Conv2d, x: Tensor) -> tuple[Tensor, Tensor]:
    """Output and patches [n, C k k] of one image [C, H, W], patch by patch."""
    k, s, p = conv.kernel_size[0], conv.stride[0], conv.padding[0]
    padded = F.pad(x, (p, p, p, p))
    corners = range(0, padded.shape[-1] - k + 1, s)
    patches = torch.stack(
        [padded[:, i : i + k, j : j + k].flatten() for i in corners for j in corners]
    )
    return apply(conv, patches).T.unflatten(1, (len(corners), -1)), patches


def apply(module: nn.Linear | nn.Conv2d, rows: Tensor) -> Tensor:
    return rows @ module.weight.flatten(1).T + module.bias


def normalize(x: Tensor, eps: float = 1e-5) -> Tensor:
    centred = x - x.mean(-1, keepdim=True)
    return centred / (centred.square().mean(-1, keepdim=True) + eps).sqrt()


@torch.no_grad()
def read(model: EmbeddedVLM, image: np.ndarray, ids: list[int], prompt: int) -> tuple[Rows, Rows]:
    """The inputs of each dense or elementwise site for one image and one text about it.

    They are rows [n, d] by site.
    """
    x, of_image, of_text = model.pixels(torch.from_numpy(image)[None])[0], {}, {}
    for i in range(len(model.stem.halve)):
        x, of_image[f"stem.halve.{i}"] = convolve(model.stem.halve[i], x)
        mixed, of_image[f"stem.mix.{i}"] = convolve(model.stem.mix[i], x.clamp(min=0))
        x = x + mixed
    x = torch.cat(
        [
            x.flatten(1).T + model.stem.position.weight,
            model.words.weight[ids] + model.text_position.weight[: len(ids)],
        ]
    )
    count, at = len(x) - len(ids), torch.arange(len(x))
    is_image, asks = at < count, at < count + prompt
    sees = is_image | (~is_image[:, None] & (asks | (at <= at[:, None])))

    def note(site: str, rows: Tensor) -> Tensor:
        of_image[site], of_text[site] = rows[:count], rows[count:]
        return rows

    for i, layer in enumerate(model.layers):
        h = note(f"layers.{i}.norm1", normalize(x)) * layer.norm1.weight + layer.norm1.bias
        qkv = apply(layer.qkv, note(f"layers.{i}.qkv", h))
        q, k, v = (
            part.unflatten(1, (model.heads, -1)).transpose(0, 1) for part in qkv.chunk(3, -1)
        )
        scores = (q @ k.mT / model.head_dim**0.5).masked_fill(~sees, -torch.inf)
        mixed = (scores.softmax(-1) @ v).transpose(0, 1).flatten(1)
        x = x + apply(layer.out, note(f"layers.{i}.out", mixed))
        h = note(f"layers.{i}.norm2", normalize(x)) * layer.norm2.weight + layer.norm2.bias
        h = apply(layer.up, note(f"layers.{i}.up", h)).clamp(min=0).square()
        x = x + apply(layer.down, note(f"layers.{i}.down", h))
    of_text["final_norm"] = normalize(x[count:])
    of_text[SCORES] = of_text["final_norm"] * model.final_norm.weight + model.final_norm.bias
    return of_image, of_text


def expected(model: EmbeddedVLM, asked: VQASet) -> Rows:
    """Mean second moment of each site's rows: each image counts once, each question once."""
    rows: dict[str, list[Tensor]] = {}
    seen: set[int] = set()
    for question, image in zip(asked.questions, asked.image_of.tolist(), strict=True):
        of_image, of_text = read(model, asked.images[image], *tokens(model, question))
        for part in (of_text,) if image in seen else (of_text, of_image):
            for site, found in part.items():
                rows.setdefault(site, []).append(found)
        seen.add(image)
    return {
        site: mean_moment(torch.cat(found), "norm" in site, site != SCORES)
        for site, found in rows.items()
    }


def mean_moment(rows: Tensor, elementwise: bool, bias: bool) -> Tensor:
    x = torch.stack([rows, torch.ones_like(rows)], -1) if elementwise else rows
    if elementwise:
        return torch.einsum("ncp,ncq->cpq", x, x) / len(x)
    x = torch.cat([x, torch.ones(len(x), 1, dtype=x.dtype)], 1) if bias else x
    return x.T @ x / len(x)


# --- the measurement ------------------------------------------------------------------------------


def moments(measured: dict[str, Spectrum]) -> Rows:
    """Second moments rebuilt from all eigenvectors; for a table, which rows are read."""
    return {
        site: s.values
        if s.vectors is None
        else s.vectors * s.values[..., None, : s.vectors.shape[-1]] @ s.vectors.mT
        for site, s in measured.items()
    }


def assert_same(got: Rows, wanted: Rows, tolerance: float = 1e-6) -> None:
    assert got.keys() == wanted.keys()
    for site, moment in wanted.items():
        largest = moment.abs().max().item()
        torch.testing.assert_close(
            got[site], moment, rtol=0, atol=tolerance * largest, msg=lambda m: f"{site}: {m}"
        )


@pytest.mark.parametrize("image_of", [IMAGE_OF, (2, 0, 1, 0, 2)], ids=["in order", "mixed"])
def test_inputs_equal_those_of_every_question_alone(image_of: tuple[int, ...]) -> None:
    model, asked = double_tiny(), make_set(image_of)
    got, wanted = moments(inputs.measure(model, asked, 1.0)), expected(model, asked)
    tables = {site: got.pop(site) for site in ("words", "text_position", "stem.position")}
    assert_same(got, wanted)
    read_ids = [tokens(model, question)[0] for question in asked.questions]
    assert tables["words"].nonzero().flatten().tolist() == sorted(
        {i for ids in read_ids for i in ids}
    )
    longest = max(map(len, read_ids))
    assert tables["text_position"].tolist() == [1.0] * longest + [0.0] * (20 - longest)
    assert tables["stem.position"].tolist() == [1.0] * 64


def test_every_parameter_belongs_to_a_site_and_every_site_is_measured() -> None:
    model = make_tiny()
    measured = inputs.measure(model, make_set(), 1.0)
    assert measured.keys() == model.sites().keys() | {SCORES}
    assert {name.rpartition(".")[0] for name, _ in model.named_parameters()} == model.sites().keys()
    kinds = {name: s.kind for name, s in measured.items()}
    assert {kinds["layers.0.up"], kinds["stem.mix.1"], kinds[SCORES]} == {"dense"}
    assert {kinds["layers.1.norm2"], kinds["final_norm"]} == {"elementwise"}
    assert {kinds["words"], kinds["text_position"], kinds["stem.position"]} == {"rows"}


@pytest.mark.parametrize("size", [1, 2])
def test_the_batch_size_does_not_show(monkeypatch: pytest.MonkeyPatch, size: int) -> None:
    whole = moments(inputs.measure(make_tiny(), make_set(), 1.0))
    monkeypatch.setattr(passes, "IMAGES", size)
    assert_same(moments(inputs.measure(make_tiny(), make_set(), 1.0)), whole)


def test_the_order_does_not_show() -> None:
    asked = make_set()
    order = [3, 0, 4, 2, 1]
    turned = VQASet(
        asked.images[::-1].copy(),
        2 - asked.image_of[order],
        tuple(asked.questions[i] for i in order),
    )
    assert_same(
        moments(inputs.measure(make_tiny(), turned, 1.0)),
        moments(inputs.measure(make_tiny(), asked, 1.0)),
    )


def test_padding_never_counts() -> None:
    """Questions of different lengths together equal the sum of each alone, weighted by tokens."""
    model, asked = make_tiny(), make_set((0, 1, 2, 3, 4))
    lengths = torch.tensor([float(len(tokens(model, q)[0])) for q in asked.questions])
    assert len(lengths.unique()) > 3
    alone = [
        moments(
            inputs.measure(model, VQASet(asked.images[[i]], np.zeros(1, int), (question,)), 1.0)
        )
        for i, question in enumerate(asked.questions)
    ]
    wanted = {}
    for site, whole in moments(inputs.measure(model, asked, 1.0)).items():
        counts = 64 * (not site.startswith((SCORES, "final"))) + lengths * (
            not site.startswith("stem")
        )
        each = torch.stack([found[site] for found in alone])
        wanted[site] = (
            each.amax(0)
            if whole.ndim == 1
            else torch.einsum("n,n...->...", (counts / counts.sum()).double(), each)
        )
    assert_same(moments(inputs.measure(model, asked, 1.0)), wanted)


def hooks(model: nn.Module) -> int:
    return sum(len(m._forward_hooks) + len(m._forward_pre_hooks) for m in model.modules())


def held(whole: Spectrum, part: Spectrum) -> float:
    """Share of the energy of a whole second moment that a part's stored directions hold."""
    vectors = whole.vectors
    moment = vectors * whole.values[: vectors.shape[1]] @ vectors.T
    along = part.vectors.T @ moment @ part.vectors
    return float(along.trace() / moment.trace())


def test_a_share_of_the_tokens_finds_the_directions_of_all() -> None:
    model, asked = double_tiny(), make_set(tuple(range(5)))
    whole = inputs.measure(model, asked, 1.0)
    drawn = inputs.measure(model, asked, 0.99, drawn=inputs.Drawn(0.5))
    dense = [site for site, spectrum in whole.items() if spectrum.kind == "dense"]
    assert dense and all(drawn[site].whole == whole[site].whole for site in dense)
    for site in dense:
        # The stem reads noise, which has no leading directions.
        assert site.startswith("stem") or held(whole[site], drawn[site]) > 0.95, site
        trace = whole[site].values.sum()
        assert abs(drawn[site].values.sum() - trace) < 0.1 * trace, site
    others = whole.keys() - dense
    assert others and all(torch.equal(whole[s].values, drawn[s].values) for s in others)


def test_which_tokens_are_drawn_follows_the_seed_alone() -> None:
    model, asked = double_tiny(), make_set()

    def values(seed: int) -> Tensor:
        found = inputs.measure(model, asked, 1.0, drawn=inputs.Drawn(0.5, seed))
        return found["layers.0.up"].values

    assert torch.equal(values(1), values(1)) and not torch.equal(values(1), values(2))


def test_every_process_draws_tokens_of_its_own() -> None:
    rows, drawn = torch.arange(100)[:, None], inputs.Drawn(0.5, 3)
    chosen = [d.of(rows, d.generator()) for d in map(drawn.of_process, range(3))]
    assert drawn.of_process(0) == drawn  # a single process draws as before
    assert len({tuple(each.flatten().tolist()) for each in chosen}) == 3


@given(count=st.integers(1, 50), share=st.floats(0.01, 1.0))
def test_of_any_number_of_rows_a_share_is_drawn_once_each(count: int, share: float) -> None:
    rows = torch.arange(count)[:, None]
    drawn = inputs.Drawn(share)
    found = drawn.of(rows, drawn.generator()).flatten().tolist()
    assert len(found) == len(set(found)) == (max(1, round(share * count)) if share < 1 else count)


def test_no_hook_stays() -> None:
    model = make_tiny()
    inputs.measure(model, make_set(), 1.0)
    assert hooks(model) == 0


def test_no_hook_stays_after_an_exception(monkeypatch: pytest.MonkeyPatch) -> None:
    model, seen = make_tiny(), []

    def fail(hidden: Tensor) -> Tensor:
        seen.append(hooks(model))
        raise RuntimeError("no scores")

    monkeypatch.setattr(model, "logits", fail)
    with pytest.raises(RuntimeError, match="no scores"):
        inputs.measure(model, make_set(), 1.0)
    assert seen[0] == len(model.sites()) + len(model.tied_heads) and hooks(model) == 0


def test_a_site_that_reads_nothing_is_named() -> None:
    model = make_tiny()
    model.spare = nn.Linear(3, 3)
    with pytest.raises(AegisError) as caught:
        inputs.measure(model, make_set(), 1.0)
    assert "spare" in caught.value.found


def test_the_kept_share_counts_directions() -> None:
    model, asked = make_tiny(), make_set()
    shares = [
        inputs.kept_share(inputs.measure(model, asked, energy)) for energy in (0.5, 0.9, 0.999, 1.0)
    ]
    assert shares == sorted(shares) and 0 < shares[0] < shares[-1] <= 1
    assert inputs.kept_share({"table": Spectrum(torch.ones(3), None)}) is None
    one_of_four = Spectrum(torch.ones(4), torch.eye(4)[:, :1])
    assert inputs.kept_share({"map": one_of_four, "table": Spectrum(torch.ones(3), None)}) == 0.25


@pytest.mark.parametrize("size", [1, 2])
def test_a_pass_takes_no_more_images_than_asked_for(
    size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And that changes nothing but rounding."""
    model, asked, seen = make_tiny(), make_set(), []
    wanted = inputs.measure(model, asked, 1.0)
    inner = model.image_pass
    monkeypatch.setattr(
        model, "image_pass", lambda pixels: seen.append(len(pixels)) or inner(pixels)
    )
    found = inputs.measure(model, asked, 1.0, size)
    assert seen == ([1, 1, 1] if size == 1 else [2, 1])
    curvature.measure(model, asked, 1.0, 0, size)
    assert seen[len(seen) // 2 :] == seen[: len(seen) // 2]
    for site, spectrum in wanted.items():
        torch.testing.assert_close(
            found[site].values, spectrum.values, rtol=1e-4, atol=1e-6 * spectrum.values.max().item()
        )


def test_measuring_changes_nothing_in_the_model() -> None:
    model = make_tiny()
    inputs.measure(model, make_set(), 0.9)
    curvature.measure(model, make_set(), 0.9, seed=0)
    fisher.measure(model, make_set(), 2)
    assert model.fingerprint() == make_tiny().fingerprint()
    assert all(p.grad is None and p.requires_grad for p in model.parameters())


# --- reading and answering ------------------------------------------------------------------------


@torch.no_grad()
def test_reading_scores_answers_as_forward_does() -> None:
    model, asked = double_tiny(), make_set((2, 0, 1, 0, 2))
    texts, answers = [q.text for q in asked.questions], [q.answer for q in asked.questions]
    parts = list(
        model.read_vqa(
            torch.from_numpy(asked.images), torch.from_numpy(asked.image_of), texts, answers
        )
    )
    alone: dict[int, list[Tensor]] = {}
    for question, image in zip(asked.questions, asked.image_of, strict=True):
        ids, prompt = tokens(model, question)
        pixels = model.pixels(torch.from_numpy(asked.images[image])[None])
        scores = model(pixels, torch.tensor([[ids]]), torch.tensor([[prompt]]))[
            0, 0, prompt - 1 : -1
        ]
        alone.setdefault(len(ids), []).append(scores)
    wanted = [
        torch.cat(alone[length]) for length in sorted(alone)
    ]  # texts of one length are read together
    assert len(parts) == 1 and len(wanted) > 2  # one part, since all read the same images
    # scores are float32
    torch.testing.assert_close(parts[0].scores, torch.cat(wanted), rtol=1e-5, atol=1e-6)
    lengths = [len(tokens(model, question)[0]) for question in asked.questions]
    words = [len(model.tokenizer.encode(answer)) + 1 for answer in answers]
    in_order = sorted(range(len(words)), key=lambda i: lengths[i])
    assert parts[0].question.tolist() == [i for i in in_order for _ in range(words[i])]


# --- Fisher information ---------------------------------------------------------------------------


def squares(model: EmbeddedVLM, asked: VQASet, row: int) -> Rows:
    """Squared gradients of one answer's log likelihood, by way of `forward`."""
    (ids, prompt), image = tokens(model, asked.questions[row]), asked.images[asked.image_of[row]]
    scores = model(
        model.pixels(torch.from_numpy(image)[None]), torch.tensor([[ids]]), torch.tensor([[prompt]])
    )[0, 0]
    likelihood = -F.cross_entropy(
        scores[prompt - 1 : -1], torch.tensor(ids[prompt:]), reduction="sum"
    )
    named = dict(model.named_parameters())
    return {
        n: g.square()
        for n, g in zip(named, torch.autograd.grad(likelihood, list(named.values())), strict=True)
    }


@pytest.mark.parametrize(("samples", "rows"), [(5, range(5)), (2, (0, 4)), (1, (0,))])
def test_fisher_is_the_mean_of_each_questions_squared_gradient(
    samples: int, rows: tuple[int, ...]
) -> None:
    model, asked = make_tiny(), make_set()
    got, each = fisher.measure(model, asked, samples), [squares(model, asked, row) for row in rows]
    for name, information in got.items():
        wanted = torch.stack([found[name] for found in each]).mean(0)
        torch.testing.assert_close(information, wanted, rtol=1e-3, atol=1e-5 * wanted.max().item())
        assert wanted.any()


def test_fisher_is_positive_where_something_is_read_and_zero_elsewhere() -> None:
    model = make_tiny()
    asked = make_questions()
    information = fisher.measure(model, asked, len(asked.questions))
    assert information.keys() == dict(model.named_parameters()).keys()
    assert all(
        f.dtype == torch.float32 and f.isfinite().all() and (f >= 0).all()
        for f in information.values()
    )
    longest = max(len(tokens(model, question)[0]) for question in asked.questions)
    used = information["text_position.weight"].sum(1) > 0
    assert (
        used[: longest - 1].all() and not used[longest - 1 :].any()
    )  # nothing follows the end token
    assert (information["words.weight"].sum(1) > 0).all()  # the tied head scores every word


# --- rows -----------------------------------------------------------------------------------------


@given(
    kernel=st.tuples(st.integers(1, 3), st.integers(1, 3)),
    stride=st.tuples(st.integers(1, 3), st.integers(1, 3)),
    padding=st.one_of(st.just("valid"), st.tuples(st.integers(0, 2), st.integers(0, 2))),
    dilation=st.integers(1, 2),
    biased=st.booleans(),
)
def test_the_rows_of_a_convolution_times_its_weights_are_its_outputs(
    kernel: tuple[int, int],
    stride: tuple[int, int],
    padding: str | tuple[int, int],
    dilation: int,
    biased: bool,
) -> None:
    """They are in the same order as the curvature's gradients of these outputs."""
    module = nn.Conv2d(3, 4, kernel, stride, padding, dilation, bias=biased).double()
    x = torch.randn(2, 3, 8, 7, dtype=torch.float64)
    weights = module.weight.flatten(1)
    if biased:
        weights = torch.cat([weights, module.bias[:, None]], 1)
    found = inputs.dense_rows(module, x) @ weights.T
    torch.testing.assert_close(found, curvature._output_rows(module, module(x)))


# --- curvature ------------------------------------------------------------------------------------


def matrix(spectrum: Spectrum) -> Tensor:
    """The matrix that a spectrum represents, in float64."""
    assert spectrum.vectors is not None
    vectors = spectrum.vectors.double()
    return (vectors * spectrum.values[: vectors.shape[1]]) @ vectors.T


def of_likeliest(scores: Tensor, uniform: Tensor) -> Tensor:
    """Replaces a random draw: always the same words."""
    return scores.log_softmax(-1).amax(-1).sum()


def inputs_and_gradients(
    model: EmbeddedVLM, asked: VQASet, row: int, site: str, temperature: float
) -> tuple[Tensor, Tensor]:
    """A site's inputs [n, d] and the gradients of its outputs [n, o].

    They are of the log likelihood of one answer's likeliest words, by scores over the temperature.
    """
    (ids, prompt), image = tokens(model, asked.questions[row]), asked.images[asked.image_of[row]]
    module, calls = model.get_submodule(site), []
    handle = module.register_forward_hook(
        lambda _, arguments, output: calls.append((arguments[0], output))
    )
    scores = model(
        model.pixels(torch.from_numpy(image)[None]), torch.tensor([[ids]]), torch.tensor([[prompt]])
    )[0, 0]
    handle.remove()
    likelihood = (scores[prompt - 1 : -1] / temperature).log_softmax(-1).amax(-1).sum()
    found = torch.autograd.grad(likelihood, [output for _, output in calls], allow_unused=True)
    used = [
        (x, g) for (x, _), g in zip(calls, found, strict=True) if g is not None
    ]  # image tokens end before the last layer
    rows = torch.cat([inputs.rows_of(module, x.detach()) for x, _ in used])
    if module.bias is not None:
        rows = torch.cat([rows, torch.ones(len(rows), 1)], 1)
    return rows, torch.cat(
        [g[0].flatten(1).T if site.startswith("stem") else g.flatten(0, -2) for _, g in used]
    )


@pytest.mark.parametrize("temperature", [1.0, 4.0])
def test_curvature_holds_the_partial_traces_of_each_tokens_products(
    monkeypatch: pytest.MonkeyPatch, temperature: float
) -> None:
    """The factors are partial traces of sum (g g^T) (x) (x x^T), up to a scale.

    Over the outputs that is sum |g|^2 x x^T, over the inputs sum |x|^2 g g^T.
    """
    monkeypatch.setattr(curvature, "_log_likelihood", of_likeliest)
    model, asked = make_tiny(), make_set((0, 1, 2, 3, 4))
    found = curvature.measure(model, asked, 1.0, seed=0, temperature=temperature)
    dense = [
        s for s, module in model.site_modules().items() if isinstance(module, nn.Linear | nn.Conv2d)
    ]
    assert (
        list(found) == [f"{site}.{side}" for site in dense for side in ("inputs", "outputs")]
        and len(dense) > 10
    )
    for site in dense:
        each = [
            [t.double() for t in inputs_and_gradients(model, asked, row, site, temperature)]
            for row in range(5)
        ]
        x, g = torch.cat([x for x, _ in each]), torch.cat([g for _, g in each])
        wanted = {
            "inputs": torch.einsum("no,no,ni,nj->ij", g, g, x, x),
            "outputs": torch.einsum("ni,ni,no,np->op", x, x, g, g),
        }
        for side, moment in wanted.items():
            got = matrix(found[f"{site}.{side}"])
            torch.testing.assert_close(
                got / got.trace(), moment / moment.trace(), rtol=1e-3, atol=1e-5
            )


def test_entropy_is_the_mean_entropy_of_the_answers_words() -> None:
    model, asked = make_tiny(), make_set()
    counted = curvature.AnswerEntropy()
    curvature.measure(model, asked, 1.0, seed=0, temperature=4.0, entropy=counted)
    found = []
    for row in range(len(asked.questions)):
        (ids, prompt), image = (
            tokens(model, asked.questions[row]),
            asked.images[asked.image_of[row]],
        )
        pixels = model.pixels(torch.from_numpy(image)[None])
        scores = model(pixels, torch.tensor([[ids]]), torch.tensor([[prompt]]))[0, 0]
        found.append(torch.distributions.Categorical(logits=scores[prompt - 1 : -1]).entropy())
    wanted = torch.cat(found)
    assert counted.words == len(wanted) > len(found)  # an answer's end token counts as a word
    assert counted.mean() == pytest.approx(wanted.mean().item(), rel=1e-4)


def test_curvature_follows_the_seed_alone() -> None:
    model, asked = make_tiny(), make_set()
    first, again, other = (curvature.measure(model, asked, 0.99, seed) for seed in (3, 3, 4))
    assert all(
        torch.equal(first[s].values, again[s].values)
        and torch.equal(first[s].vectors, again[s].vectors)
        for s in first
    )
    assert any(not torch.equal(first[s].values, other[s].values) for s in first)


@pytest.mark.parametrize("size", [1, 2])
def test_curvature_does_not_depend_on_the_batch_size(size: int) -> None:
    model, asked = make_tiny(), make_set((2, 0, 1, 0, 2))
    wanted, found = (curvature.measure(model, asked, 1.0, 3, one) for one in (32, size))
    assert list(found) == list(wanted)
    for name, spectrum in wanted.items():
        whole = matrix(spectrum)
        assert (matrix(found[name]) - whole).abs().max() <= 1e-4 * whole.abs().max()


@pytest.mark.parametrize("words", [2, 7, 300])
def test_words_are_drawn_as_often_as_their_scores_say(words: int) -> None:
    scores = torch.randn(words, generator=torch.Generator().manual_seed(words)).double()
    scores[words // 2] = -math.inf  # never drawn
    uniform = torch.linspace(0, 1, 10_001, dtype=torch.float64)[:-1]
    rows = scores.repeat(10_000, 1).requires_grad_()
    curvature._log_likelihood(rows, uniform).backward()
    # d log p(word) / d scores is 1 at the drawn word, minus the probabilities.
    chances = scores.softmax(-1)
    drawn = (rows.grad + chances).mean(0)
    torch.testing.assert_close(drawn, chances, rtol=0, atol=2e-4)
    assert drawn[words // 2] == 0


def test_each_questions_words_are_drawn_by_its_number_alone() -> None:
    alone = [curvature._uniform(5, torch.full((3,), i)) for i in (7, 2)]
    torch.testing.assert_close(
        curvature._uniform(5, torch.tensor([7, 7, 7, 2, 2, 2])), torch.cat(alone)
    )
    assert not torch.equal(*alone)
    assert not torch.equal(alone[0], curvature._uniform(6, torch.full((3,), 7)))


def test_no_hook_stays_after_curvature() -> None:
    model = make_tiny()
    curvature.measure(model, make_set(), 1.0, seed=0)
    assert hooks(model) == 0
