"""Hugging Face backbones against transformers: the adapter computes nothing of its own."""

from __future__ import annotations

import copy
import json
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import transformers
from PIL import Image
from samples.backbones import TEXTS, close, encode, images
from samples.hf import FAMILIES as MADE
from samples.hf import load_processor, prompt_of, write
from torch import Tensor

from aegis_cli.common import devices, prefetch
from aegis_cli.core.attention import rotate
from aegis_cli.models import backbones
from aegis_cli.models.backbones import hf
from aegis_cli.models.backbones.families import FAMILIES
from aegis_cli.models.backbones.hf import HFBackbone
from aegis_cli.models.backbones.prompting import Processors

Loaded = Callable[[str], HFBackbone]  # by a family's name
SAID = ["red", "two", "x3 y5", ""]
TOWERS = ("visual", "vision_tower", "vision_model")  # by their names in the families
MAX_ANSWER = 10  # tokens that a model may generate here, fewer than usual


@pytest.fixture(autouse=True)
def short_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hf, "MAX_ANSWER", MAX_ANSWER)


@pytest.fixture(params=FAMILIES)
def family(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def backbone(family: str, hf_backbone: Loaded) -> HFBackbone:
    return hf_backbone(family)


class Native:
    """The same folder as transformers runs it for a user: one question at a time, no padding."""

    def __init__(self, family: str, folder: Path) -> None:
        self.family = family
        self.model = transformers.AutoModelForImageTextToText.from_pretrained(folder).eval()
        self.processor = load_processor(family, folder)

    def inputs(self, image: Tensor | tuple[Tensor, ...], text: str) -> dict[str, Tensor]:
        pictures = [
            Image.fromarray(x.numpy()) for x in (image if isinstance(image, tuple) else (image,))
        ]
        prompt = prompt_of(self.family, text, len(pictures))
        made = self.processor(images=[pictures], text=[prompt], return_tensors="pt")
        return {name: tensor for name, tensor in made.items() if name != "labels"}

    @torch.no_grad()
    def generate(self, image: Tensor, text: str, tokens: int = MAX_ANSWER) -> Any:
        return self.model.generate(
            **self.inputs(image, text),
            do_sample=False,
            max_new_tokens=tokens,
            return_dict_in_generate=True,
            output_logits=True,
        )


@pytest.fixture(scope="module")
def natives(hf_folder: Callable[[str], Path]) -> Callable[[str], Native]:
    return cache(lambda family: Native(family, hf_folder(family)))


@pytest.fixture
def native(family: str, natives: Callable[[str], Native]) -> Native:
    return natives(family)


def test_every_known_family_is_tested() -> None:
    assert MADE.keys() == FAMILIES.keys() and len(FAMILIES) >= 4


# --- answers --------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_answers_are_what_generate_says_token_for_token(
    native: Native, backbone: HFBackbone, monkeypatch: pytest.MonkeyPatch
) -> None:
    """This holds although the questions are padded to one batch here."""
    said: list[list[int]] = []
    decode = backbone._prompter.decode
    monkeypatch.setattr(
        backbone._prompter, "decode", lambda ids: (said.extend(ids), decode(ids))[1]
    )
    answers = backbone.answer(images(4), TEXTS)
    pad = native.processor.tokenizer.pad_token_id
    for image, text, tokens, answer in zip(images(4), TEXTS, said, answers, strict=True):
        out = native.generate(image, text)
        wanted = out.sequences[0, native.inputs(image, text)["input_ids"].shape[1] :].tolist()
        assert tokens[: len(wanted)] == wanted and set(tokens[len(wanted) :]) <= {pad}
        assert answer == native.processor.tokenizer.decode(wanted, skip_special_tokens=True).strip()
    assert len({tuple(tokens) for tokens in said}) > 1


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_an_answer_may_be_as_long_as_its_reference(
    native: Native, backbone: HFBackbone, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may be one token longer, since an answer that goes on does not equal the reference."""
    frame, text, tokenizer = images(1), TEXTS[0], native.processor.tokenizer
    out = native.generate(frame[0], text, 2 * MAX_ANSWER)
    said = out.sequences[0, native.inputs(frame[0], text)["input_ids"].shape[1] :].tolist()
    references = [said[: MAX_ANSWER + 8], said[:2]]
    monkeypatch.setattr(backbone._prompter, "answer_ids", lambda answers: references)
    ((answers, _),) = backbone.answers([([frame[0]] * 2, [text] * 2, ["long", "short"])])
    allowed = [said[: MAX_ANSWER + 9], said[:MAX_ANSWER]]
    assert answers == [tokenizer.decode(a, skip_special_tokens=True).strip() for a in allowed]


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("tokens", [0, 1, 7])
def test_likelihoods_are_those_of_generate(
    tokens: int, native: Native, backbone: HFBackbone, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The likelihood of an answer of `generate` and its end equals that of its own scores.

    So every mask and position is right.
    """
    frames, said, wanted = images(4), [], []
    ends = backbone._ends()
    for image, text in zip(frames, TEXTS, strict=True):
        out = native.generate(image, text, tokens + 1)
        scores = torch.stack(out.logits)[:, 0].log_softmax(-1)
        words = out.sequences[0, -len(scores) :][: min(tokens, len(scores) - 1)]
        said.append(words.tolist())
        wanted.append(
            scores[range(len(words)), words].sum() + scores[len(words), ends].logsumexp(0)
        )
    monkeypatch.setattr(backbone._prompter, "answer_ids", lambda answers: said)
    close(backbone.answer_log_likelihood(frames, TEXTS, SAID), torch.stack(wanted))


def test_any_of_several_ends_ends_an_answer(backbone: HFBackbone) -> None:
    alone = []
    for ends in (3, 7, [3, 7]):
        backbone.vlm.generation_config.eos_token_id = ends
        alone.append(backbone.answer_log_likelihood(images(4), TEXTS, SAID).detach())
    close(alone[2], torch.logaddexp(alone[0], alone[1]))


@pytest.mark.parametrize("family", ["paligemma", "smolvlm"])
def test_what_fills_a_row_that_has_ended_is_a_word_of_the_model(
    backbone: HFBackbone, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another row's answer continues meanwhile."""
    said: list[list[int]] = []
    decode = backbone._prompter.decode
    monkeypatch.setattr(backbone._prompter, "decode", lambda ids: said.extend(ids) or decode(ids))
    backbone.answer(images(4), TEXTS)
    ends = next(row[0] for row in said if any(row[0] not in other for other in said))
    going_on = [i for i, row in enumerate(said) if ends not in row]
    free = said[going_on[0]]
    said.clear()
    config = backbone.vlm.generation_config
    config.eos_token_id, config.pad_token_id = ends, 10**6
    backbone.answer(images(4), TEXTS)
    assert said[going_on[0]] == free
    assert any(row[0] == ends for row in said)


def test_every_mask_takes_a_byte_a_number(backbone: HFBackbone) -> None:
    """The mask of pixels is as large as the pictures themselves."""
    batch = backbone.process(images(2), TEXTS[:2])
    masks = [tensor for name, tensor in batch.extra.items() if name.endswith("attention_mask")]
    assert all(mask.dtype == torch.bool for mask in (batch.mask, *masks))
    assert backbone.vlm.config.model_type not in ("smolvlm", "idefics3") or masks


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize(
    ("family", "splits", "whole"),
    [
        ("internvl", {}, {"max_patches": 1}),
        (
            "smolvlm",
            {"do_image_splitting": True, "size": {"longest_edge": 64}},
            {"do_image_splitting": False},
        ),
    ],
)
def test_splitting_is_switched_off_where_the_docs_say(
    splits: dict[str, object],
    whole: dict[str, object],
    family: str,
    hf_folder: Callable[[str], Path],
    tmp_path: Path,
) -> None:
    """It is measured by how many images are made of one."""
    pictures, found = [torch.zeros(480, 640, 3, dtype=torch.uint8)], []
    for name, changes in (("splits", splits), ("whole", splits | whole)):
        folder = tmp_path / name
        shutil.copytree(hf_folder(family), folder)
        path = folder / "preprocessor_config.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | changes))
        batch = backbones.load(str(folder)).prepare(pictures, TEXTS[:1])
        found.append(batch.pixels.flatten(0, -4).shape[0])
    assert found[0] > 1 == found[1]


def test_no_more_scores_are_kept_than_answers_have_words(backbone: HFBackbone) -> None:
    """Each is as long as the vocabulary, and a batch with images of several sizes has many rows."""
    said = backbone._prompter.answer_ids(SAID)
    head, seen = backbone.get_submodule(backbone._head), list[torch.Size]()
    handle = head.register_forward_hook(lambda _, __, out: seen.append(out.shape[:-1]))
    backbone.answer_log_likelihood(images(4), TEXTS, SAID)
    handle.remove()
    assert seen == [(1, sum(len(words) + 1 for words in said))]


@pytest.fixture(scope="module")
def said_plainly(hf_backbone: Loaded) -> Callable[[str], list[str]]:
    """The answers of a family's unmodified model; computed once."""
    return cache(lambda family: hf_backbone(family).answer(images(4), TEXTS))


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize(
    "own",
    [
        {"repetition_penalty": 50.0},
        {"no_repeat_ngram_size": 1},
        {"do_sample": True, "temperature": 9.0, "top_k": 3},
        {"num_beams": 3},
        {"min_new_tokens": 9},
    ],
)
def test_a_models_own_ways_to_generate_change_no_answer(
    own: dict[str, float],
    family: str,
    backbone: HFBackbone,
    said_plainly: Callable[[str], list[str]],
) -> None:
    """An answer is the likeliest one; otherwise the scored and the generated one would differ."""
    plain = said_plainly(family)
    config = backbone.vlm.generation_config
    before = {name: getattr(config, name) for name in own}
    config.update(**own)
    try:
        assert backbone.answer(images(4), TEXTS) == plain
        assert backbone.vlm.generation_config is config
        assert {name: getattr(config, name) for name in own} == own
    finally:
        config.update(**before)


def test_what_is_read_on_vqa_scores_every_word_of_every_answer(backbone: HFBackbone) -> None:
    """They are the same scores as those of a padded batch, in any order."""
    frames, image_of = images(2), torch.tensor([0, 1, 1, 0])
    said = backbone._prompter.answer_ids(SAID)
    with torch.no_grad():
        parts = list(backbone.read_vqa(frames, image_of, TEXTS, SAID))
        found = torch.cat([part.scores for part in parts]).log_softmax(-1)
        wanted = backbone.answer_log_likelihood(frames[image_of], TEXTS, SAID)
    assert len(found) == sum(len(words) + 1 for words in said)
    order = sorted(range(4), key=lambda i: (backbone._prompter.lengths(TEXTS)[i], len(said[i])))
    targets = [[*said[i], backbone._ends()[0]] for i in order]
    answered = torch.cat([part.question for part in parts]).tolist()
    assert answered == [i for i in order for _ in (*said[i], "its end")]
    chosen = found[range(len(found)), sum(targets, [])]
    close(
        torch.stack([part.sum() for part in chosen.split([len(t) for t in targets])]), wanted[order]
    )


@pytest.mark.parametrize("name", [name for name in FAMILIES if name != "paligemma"])
def test_prompt_and_answer_are_what_the_template_makes_of_a_conversation(
    name: str, hf_backbone: Loaded
) -> None:
    """An answer is scored in the tokens with which training on conversations would have seen it."""
    prompter = hf_backbone(name)._prompter
    asked, answered = ({"type": "text", "text": text} for text in (TEXTS[0], "red cube"))
    said = [
        {"role": "user", "content": [{"type": "image"}, asked]},
        {"role": "assistant", "content": [answered]},
    ]
    tokenizer = prompter._processors.original.tokenizer
    whole = tokenizer.apply_chat_template(
        said, chat_template=prompter._processors.original.chat_template, tokenize=False
    )
    prompt = tokenizer(prompter._prompt(TEXTS[0]))["input_ids"]
    ids = [*prompt, *prompter.answer_ids(["red cube"])[0], hf_backbone(name)._ends()[0]]
    assert prompter._prompt(TEXTS[0]) == prompt_of(name, TEXTS[0])
    assert whole.rstrip("\n") == tokenizer.decode(ids)


def edited(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the settings of a folder's tokenizer."""
    path = folder / "tokenizer_config.json"
    settings = json.loads(path.read_text())
    change(settings)
    path.write_text(json.dumps(settings))


@pytest.mark.parametrize("change", ["the template beside the tokenizer", "no padding token"])
def test_processors_files_as_others_have_them_say_the_same(
    change: str, hf_folder: Callable[[str], Path], tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(hf_folder("idefics3"), tmp_path / "model"))
    if change == "no padding token":
        edited(folder, lambda settings: settings.pop("pad_token"))
    else:
        template = (folder / "chat_template.jinja").read_text()
        (folder / "chat_template.jinja").unlink()
        edited(folder, lambda settings: settings.update(chat_template=template))
    changed, whole = backbones.load(str(folder)), backbones.load(str(hf_folder("idefics3")))
    asked = (images(4), TEXTS, SAID)
    assert changed.answer(*asked[:2]) == whole.answer(*asked[:2])
    assert torch.equal(changed.answer_log_likelihood(*asked), whole.answer_log_likelihood(*asked))
    again = tmp_path / "saved"
    changed.save(again)
    assert backbones.load(str(again)).answer(*asked[:2]) == whole.answer(*asked[:2])


def test_groups_are_named_after_what_they_are(backbone: HFBackbone) -> None:
    names = {id(p): name for name, p in backbone.named_parameters()}
    found = {group: [names[id(p)] for p in ps] for group, ps in backbone.parameter_groups().items()}
    head = {"head": ["vlm.lm_head.weight"]} if not backbone.tied_heads else {}
    language = backbone._language
    assert found | head == found and ("head" in found) == bool(head)
    assert found["embeddings"] == [f"{language}.embed_tokens.weight"] and found["final_norm"] == [
        f"{language}.norm.weight"
    ]
    assert all(name.startswith(f"{language}.layers.1.") for name in found["layers.1"])
    assert not any(name.startswith(language) for name in found["vision"])


# --- what is recorded -----------------------------------------------------------------------------


def seen_by(cameras: int) -> Any:
    """Four frames of several cameras, each with its own size."""
    views = [images(4, seed)[:, :height] for seed, height in zip(range(cameras), (64, 48, 32))]
    return views[0] if cameras == 1 else list(zip(*views, strict=True))


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("cameras", [1, 2, 3])
def test_hidden_states_keys_and_values_are_the_models_own(
    cameras: int, native: Native, backbone: HFBackbone
) -> None:
    """transformers lists the last hidden state after the final norm.

    It keeps only the last keys of layers with a sliding window.
    """
    frames = seen_by(cameras)
    got = encode(backbone, frames, TEXTS)
    windows = []
    for i, (image, text) in enumerate(zip(frames, TEXTS, strict=True)):
        with torch.no_grad():
            out = native.model(
                **native.inputs(image, text), output_hidden_states=True, use_cache=True
            )
        mine = [h[i][got.mask[i]] for h in got.hidden]
        for ours, theirs in zip(mine[:-1], out.hidden_states[1:-1], strict=True):
            close(ours, theirs[0])
        close(
            backbone.get_submodule(f"{backbone._language}.norm")(mine[-1]), out.hidden_states[-1][0]
        )
        for ours, kept_by in zip(got.keys_values, out.past_key_values.layers, strict=True):
            kept = kept_by.keys.shape[2]
            windows.append(kept)
            close(ours.key[i][:, got.mask[i]][:, -kept:], kept_by.keys[0])
            close(ours.value[i][:, got.mask[i]][:, -kept:], kept_by.values[0])
    assert min(windows) > 1


def test_every_camera_counts_in_its_place(backbone: HFBackbone) -> None:
    """If pictures are swapped or changed, the prompt's last token changes too.

    A third picture adds its tokens.

    (One picture may have more than two views: LLaVA-OneVision looks closer at it.)
    """
    frames, more = seen_by(2), seen_by(3)
    turned, other = [row[::-1] for row in frames], [(x, 255 - y) for x, y in frames]
    last = [
        encode(backbone, rows, TEXTS[:1] * 4).hidden[-1][:, -1] for rows in (frames, turned, other)
    ]
    assert min((last[0] - x).abs().amax(1).min() for x in last[1:]) > 1e-3
    counts = [
        (e.image & e.mask).sum(1)
        for e in (encode(backbone, rows, TEXTS) for rows in (frames, more))
    ]
    assert (counts[1] > counts[0]).all() and len(counts[1].unique()) == 1


def test_nothing_is_left_behind(backbone: HFBackbone) -> None:
    """None of our hooks remains.

    transformers keeps one of its own on a vision tower whose layers it lists.
    """
    encode(backbone, images(1), TEXTS[:1])
    watched = [backbone._rotary, *backbone._layers.modules()]
    assert not any(m._forward_hooks or m._forward_pre_hooks for m in watched)


def test_no_two_calls_share_a_processor(backbone: HFBackbone) -> None:
    """If two threads call a tokenizer at once, it may raise "Already borrowed"."""
    processors = Processors(backbone._prompter._processors.original)
    with processors.one() as first, processors.one() as second:
        called = {id(processors.original), id(first), id(second)}
        called |= {id(each.tokenizer) for each in (processors.original, first, second)}
        assert len(called) == 6
    with copy.deepcopy(processors).one() as again:  # from a copy of the model
        assert again in (first, second)


def test_several_threads_make_the_same_of_images_and_texts(backbone: HFBackbone) -> None:
    """Each thread calls a copy of the processor, which has to act like the original."""
    seen = images(4)

    def make(turn: int) -> Any:
        rows = [(i + turn) % 4 for i in range(4 - turn % 2)]  # other lengths, so other padding
        return backbone.process(seen[rows], [TEXTS[i] for i in rows])

    wanted = [make(turn) for turn in range(4)]
    with ThreadPoolExecutor(4) as threads:
        made = list(threads.map(make, [turn % 4 for turn in range(24)]))
    for turn, batch in enumerate(made):
        like = wanted[turn % 4]
        assert torch.equal(batch.ids, like.ids) and torch.equal(batch.mask, like.mask)
        assert torch.equal(batch.pixels, like.pixels)
        assert all(torch.equal(batch.extra[name], like.extra[name]) for name in like.extra)


def test_what_threads_prepare_is_answered_and_read_alike(
    backbone: HFBackbone, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For a GPU, batches are prepared ahead; here the CPU is treated as one."""
    shown, image_of = images(3), torch.tensor([0, 1, 1, 2])
    batches = [(shown[[i, 2]], [TEXTS[i], TEXTS[2]], [SAID[i], SAID[1]]) for i in (0, 1, 2, 1)]
    told = []
    for waits in (False, True):
        monkeypatch.setattr(devices, "reading_stalls", lambda _, waits=waits: waits)
        monkeypatch.setattr(prefetch, "workers", lambda: 3)
        with torch.no_grad():
            parts = backbone.read_vqa(shown, image_of, TEXTS, SAID, together=1)
            scores = torch.cat([part.scores for part in parts])
            told.append((list(backbone.answers(iter(batches))), scores))
    (one, one_scores), (other, other_scores) = told
    assert [said for said, _ in one] == [said for said, _ in other] and len(one) == 4
    for (said, likelihood), (_, again), asked in zip(one, other, batches, strict=True):
        assert said == backbone.answer(*asked[:2])
        assert torch.equal(likelihood, again)
    assert torch.equal(one_scores, other_scores)


def test_padding_on_the_left_is_as_the_processor_has_it(backbone: HFBackbone) -> None:
    for texts in (TEXTS, TEXTS[:1] * 4):
        right, wanted = (backbone._prompter.process(images(4), texts, s) for s in ("right", "left"))
        found = backbone._prompter.padded_left(right)
        assert torch.equal(found.ids, wanted.ids) and torch.equal(found.mask, wanted.mask)
        assert torch.equal(found.pixels, wanted.pixels)
        assert found.extra.keys() == wanted.extra.keys()
        assert all(torch.equal(found.extra[name], own) for name, own in wanted.extra.items())


@torch.no_grad()
def test_an_image_is_processed_and_seen_once_for_its_answer_and_its_likelihood(
    backbone: HFBackbone, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both are, bit for bit, those of a pass of their own for each."""
    shown = images(4)
    wanted = backbone.answer(shown, TEXTS), backbone.answer_log_likelihood(shown, TEXTS, SAID)
    processed, seen = [], []
    process, model = backbone._prompter.process, backbone.vlm.base_model
    monkeypatch.setattr(
        backbone._prompter, "process", lambda *a: processed.append(len(a[0])) or process(*a)
    )
    tower = next(m for name, m in model.named_modules() if name in TOWERS)
    tower.register_forward_hook(lambda *_: seen.append(1))
    ((answers, likelihoods),) = backbone.answers([(shown, TEXTS, SAID)])
    assert processed == [4] and seen == [1]
    assert answers == wanted[0] and torch.equal(likelihoods, wanted[1])
    other = images(4, seed=5)  # no feature is left behind for the next batch
    ((answers, likelihoods),) = backbone.answers([(other, TEXTS, SAID)])
    assert answers == backbone.answer(other, TEXTS)
    assert torch.equal(likelihoods, backbone.answer_log_likelihood(other, TEXTS, SAID))
    assert not torch.equal(likelihoods, wanted[1])


def test_likelihoods_of_answers_have_a_graph_through_the_vision_tower(backbone: HFBackbone) -> None:
    ((_, likelihoods),) = backbone.answers([(images(4), TEXTS, SAID)])
    likelihoods.sum().backward()
    in_vision = {
        name: p.grad
        for name, p in backbone.named_parameters()
        if backbone.in_vision(name) and p.grad is not None
    }
    assert any(bool(gradient.any()) for gradient in in_vision.values())


def test_image_tokens_are_the_processors(backbone: HFBackbone) -> None:
    got = encode(backbone, images(4), TEXTS)
    assert (got.image & got.mask).sum(1).unique().numel() == 1 and got.image.any(1).all()
    assert (got.mask & ~got.image).any(1).all()


def test_a_suffix_takes_the_place_of_a_generated_answer(backbone: HFBackbone) -> None:
    """The expert rotates the keys as the model does for the words of an answer."""
    said = backbone._prompter.answer_ids(["red cube two", "x3 y5", "yes no", "left right"])
    prompts = backbone.prepare(images(4), TEXTS)
    attention, norm = backbone._layers[0].self_attn, backbone._layers[0].input_layernorm
    with torch.no_grad():
        short, whole = (
            backbone.encode(prompts),
            backbone.encode(backbone._prompter.extend(prompts, said)),
        )
        rotation = backbone.suffix(short, 2).rotation
        rotation = rotation[0] if isinstance(rotation, list) else rotation
        normed = getattr(attention, "k_norm", lambda keys: keys)
        for i, words in enumerate(said):
            n = int(prompts.mask[i].sum())
            embedded = backbone.get_submodule(backbone._table)(torch.tensor(words[:2]))
            heads = attention.k_proj(norm(embedded)).unflatten(-1, (backbone.kv_heads, -1))
            keys = normed(heads).transpose(0, 1)
            own = type(rotation)(rotation.cos[i : i + 1], rotation.sin[i : i + 1])
            close(
                rotate(keys[None, :, None], own)[0, :, 0], whole.keys_values[0].key[i, :, n : n + 2]
            )


@pytest.mark.parametrize("name", ["paligemma", "gemma3"])
def test_a_suffix_sees_as_far_back_as_the_layers_windows(name: str, hf_backbone: Loaded) -> None:
    """According to the model: what a generated word's output depends on, layer by layer."""
    backbone = hf_backbone(name)
    encoding = encode(backbone, images(4), TEXTS)
    visible = backbone.suffix(encoding, 3).visible
    windows = [layer.self_attn.sliding_window for layer in backbone._layers]
    assert isinstance(visible, tuple) and set(windows) == {None, 8}
    for window, seen in zip(windows, visible, strict=True):
        for b in range(4):
            n = int(encoding.mask[b].sum())
            for s in range(3):
                wanted = [
                    t < n and (window is None or n + s - t < window)
                    for t in range(encoding.mask.shape[1])
                ]
                assert seen.expand(-1, 3, -1)[b, s].tolist() == wanted


# --- weights -------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_products_in_bf16_leave_each_token_nearly_where_it_was(backbone: HFBackbone) -> None:
    """Autocast alone would give an image's features and the words two dtypes."""
    batch, types = backbone.prepare(images(2), TEXTS[:2]), list[torch.dtype]()
    if backbone._family.connector is not None:
        connector = backbone.vlm.get_submodule(backbone._family.connector)
        connector.register_forward_hook(lambda _, __, output: types.append(output.dtype))
    with torch.no_grad():
        wide = backbone.encode(batch)
        with torch.autocast("cpu", torch.bfloat16):
            narrow = backbone.encode(batch)
    assert set(types) <= {torch.float32}
    for one, other in zip(wide.hidden, narrow.hidden, strict=True):
        assert other.dtype == torch.float32
        own = one[wide.mask]
        assert (other[wide.mask] - own).norm() < 0.1 * own.norm()


def test_axes_that_attention_would_mix_have_one_rotation_at_the_places_of_text(
    hf_backbone: Callable[[str], HFBackbone], monkeypatch: pytest.MonkeyPatch
) -> None:
    """transformers 5.5 leaves the mixing to Qwen2.5-VL's attention."""
    backbone = hf_backbone("qwen2_5_vl")
    encoding, ahead = encode(backbone, images(2), TEXTS[:2]), torch.arange(3)
    mixed, rotary = backbone._rotations(encoding, ahead)[0], type(backbone._rotary)
    answer = rotary.forward

    def apart(*given: Tensor) -> tuple[Tensor, ...]:
        assert given[-1].shape == (3, 2, 3)  # axes, rows and places
        return tuple(x if x.dim() == 4 else x.expand(3, *x.shape) for x in answer(*given))

    monkeypatch.setattr(rotary, "forward", apart)
    for one, other in zip(mixed, backbone._rotations(encoding, ahead)[0], strict=True):
        assert one.shape[:2] == (2, 3) and torch.equal(one, other)


def test_gradients_are_checkpointed_by_either_name(
    hf_backbone: Callable[[str], HFBackbone], monkeypatch: pytest.MonkeyPatch
) -> None:
    backbone, asked = hf_backbone("paligemma"), list[dict[str, bool]]()
    monkeypatch.delattr(transformers.PreTrainedModel, "activation_checkpointing_enable", False)
    monkeypatch.setattr(
        type(backbone.vlm), "gradient_checkpointing_enable", lambda _, how: asked.append(how)
    )
    backbone.checkpoint_gradients()
    assert asked == [{"use_reentrant": False}]


@pytest.mark.parametrize("deeper", ["", ".vision_model"])
def test_what_a_clip_tower_leaves_unread_is_found_in_both_its_places(deeper: str) -> None:
    class Model(torch.nn.Module):
        config = SimpleNamespace(
            vision_config=SimpleNamespace(num_hidden_layers=3), vision_feature_layer=-2
        )

    model, at = Model(), Model()
    model.add_module("model", at)
    for name in f"vision_tower{deeper}".split("."):
        at.add_module(name, Model())
        at = at.get_submodule(name)
    tower = f"model.vision_tower{deeper}"
    assert FAMILIES["llava"].idle(model) == (f"{tower}.encoder.layers.2", f"{tower}.post_layernorm")


def test_bf16_weights_leave_positions_alone(backbone: HFBackbone) -> None:
    before = {name: buffer.clone() for name, buffer in backbone.named_buffers()}
    backbone.round_weights(torch.bfloat16)
    assert all(p.dtype == torch.bfloat16 for p in backbone.parameters())
    assert before and all(
        torch.equal(buffer, before[name]) for name, buffer in backbone.named_buffers()
    )
    assert all(
        h.dtype == torch.bfloat16 and h.isfinite().all()
        for h in encode(backbone, images(2), TEXTS[:2]).hidden
    )


def test_a_model_stored_in_bf16_loads_in_float32_with_its_very_weights(tmp_path: Path) -> None:
    half = backbones.load(str(write("smolvlm", tmp_path / "half", dtype=torch.bfloat16)))
    assert all(
        p.dtype == torch.float32 and torch.equal(p, p.bfloat16().float()) for p in half.parameters()
    )
