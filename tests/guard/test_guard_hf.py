"""The guard on a small, untrained PaliGemma 2 from Hugging Face, in a plain loop."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from samples.guard import vector
from torch import Tensor, nn

from aegis_cli import Guard
from aegis_cli.anchors.anchor_file import from_artifact
from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError

IMAGE, PAD, WORDS, PATCHES = 31, 0, 32, 4
LAYERS = "model.language_model.layers"
PIXELS = ("model.vision_tower", "model.multi_modal_projector")
Inputs = dict[str, Tensor]


def make() -> nn.Module:
    from transformers import PaliGemmaConfig, PaliGemmaForConditionalGeneration

    common = {
        "hidden_size": 16,
        "intermediate_size": 32,
        "num_hidden_layers": 2,
        "num_attention_heads": 2,
    }
    vision = common | {
        "model_type": "siglip_vision_model",
        "image_size": 8,
        "patch_size": 4,
        "vision_use_head": False,
    }
    text = common | {
        "model_type": "gemma2",
        "num_key_value_heads": 1,
        "head_dim": 8,
        "vocab_size": WORDS,
        "pad_token_id": PAD,
    }
    config = PaliGemmaConfig(
        vision_config=vision | {"projection_dim": 16},
        text_config=text,
        image_token_index=IMAGE,
        projection_dim=16,
        vocab_size=WORDS,
        pad_token_id=PAD,
        attn_implementation="eager",
    )
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return PaliGemmaForConditionalGeneration(config).eval()


def batch(seed: int) -> Inputs:
    """Three texts about an image; the first ends in padding."""
    generator = torch.Generator().manual_seed(seed)
    ids = torch.randint(3, 30, (3, 5), generator=generator)
    ids[0, -2:] = PAD
    ids = torch.cat([torch.full((3, PATCHES), IMAGE), ids], 1)
    return {
        "input_ids": ids,
        "attention_mask": (ids != PAD).long(),
        "pixel_values": torch.randn(3, 3, 8, 8, generator=generator),
        "token_type_ids": torch.zeros_like(ids),
        "labels": ids.masked_fill((ids == PAD) | (ids == IMAGE), -100),
    }


@pytest.fixture(scope="module")
def anchor(tmp_path_factory: pytest.TempPathFactory) -> Path:
    model, path = make(), tmp_path_factory.mktemp("anchor") / "anchor.safetensors"
    with Guard.measure(
        model, LAYERS, parts=("moments", "inputs"), vision=PIXELS, energy=1.0
    ) as measured:
        for seed in range(3):
            asked = batch(seed)
            with measured.watch(asked["attention_mask"], image=asked["input_ids"] == IMAGE):
                model(**asked)
    measured.save(path)
    return path


def train(
    anchor: Path, change: Callable[[nn.Module], object] = lambda model: None
) -> tuple[Tensor, dict[str, Tensor], Guard]:
    model = make()
    change(model)
    guard = Guard(model, anchor, LAYERS)
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-3)
    for seed in range(10, 13):
        robot = batch(seed)
        with guard.watch(robot["attention_mask"]):
            loss = model(**robot).loss
        guard.backward(loss)
        optimizer.step()
        optimizer.zero_grad()
    return vector(model), guard.ledger.tensors(), guard


def test_the_loop_of_the_readme(anchor: Path, tmp_path: Path) -> None:
    after, rows, guard = train(anchor)
    outside = (
        "model.vision_tower",
        "model.multi_modal_projector",
        "embeddings",
        "model.language_model.norm",
    )
    assert guard.ledger.groups == (
        "layers.0",
        "layers.1",
        *outside,
    )  # the head shares the embeddings' weight
    assert len(guard.ledger) == 3 and (rows["ta"] < 0).any() and (rows["w2"] > 0).all()
    assert (rows["aa"][:, :-1] > 0).all() and not rows["aa"][:, -1].any()
    assert not torch.equal(after, vector(make()))
    guard.ledger.save(tmp_path / "ledger.safetensors")
    assert (
        artifacts.load(tmp_path / "ledger.safetensors", "ledger").header.meta["method"] == "aegis"
    )


def checkpointed(reentrant: bool) -> Callable[[nn.Module], None]:
    def change(model: nn.Module) -> None:
        model.train()
        model.gradient_checkpointing_enable(
            gradient_checkpointing_kwargs={"use_reentrant": reentrant}
        )

    return change


@pytest.mark.filterwarnings(
    "ignore:`gradient_checkpointing_enable` is deprecated"
)  # its new name is not in older versions
def test_gradient_checkpointing(anchor: Path) -> None:
    plain, rows, _ = train(anchor)
    saved, saved_rows, _ = train(anchor, checkpointed(reentrant=False))
    assert torch.equal(plain, saved) and torch.equal(rows["ta"], saved_rows["ta"])
    with pytest.raises(AegisError, match="use_reentrant"):
        train(anchor, checkpointed(reentrant=True))


def test_two_towers_are_ambiguous(anchor: Path) -> None:
    with pytest.raises(AegisError, match="2 lists of blocks") as caught:
        Guard(make(), anchor)
    assert f"'{LAYERS}' (2 Gemma2DecoderLayer)" in caught.value.fix


def test_moments_are_those_of_the_hidden_states_at_valid_tokens(anchor: Path) -> None:
    model, seen = make(), []
    with torch.no_grad():
        for seed in range(3):
            asked = batch(seed)
            states = model(**asked, output_hidden_states=True).hidden_states[
                1
            ]  # the first layer's hidden states
            seen.append(
                states[(asked["attention_mask"] == 1) & (asked["input_ids"] != IMAGE)].double()
            )
    first = from_artifact(artifacts.load(anchor, "anchor")).text[0]
    rows = torch.cat(seen)
    assert first.count == len(rows) == 39
    torch.testing.assert_close(first.mean, rows.mean(0), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(first.var, rows.var(0, correction=0), rtol=1e-4, atol=1e-6)


def test_the_null_space_holds_every_part_of_the_model(anchor: Path) -> None:
    """This includes Gemma's normalisations, scaled table and tied head; nothing is frozen."""
    model = make()
    with Guard(model, anchor, method="nullspace", vision=PIXELS, energy=1.0) as guard:
        assert guard.unprotected == ()
        optimizer = torch.optim.AdamW(model.parameters(), lr=1e-3)
        asked, before = [batch(seed) for seed in range(3)], vector(model)
        said = [model(**b).logits for b in asked]
        for seed in range(10, 13):
            guard.backward(model(**batch(seed)).loss)
            guard.step(optimizer)
            optimizer.zero_grad()
    change = max(
        (model(**b).logits - s)[b["attention_mask"] == 1].abs().max().item()
        for b, s in zip(asked, said, strict=True)
    )
    assert (vector(model) - before).norm() > 1e-3
    assert change < 1e-3


def test_the_null_space_names_what_it_cannot_hold(anchor: Path) -> None:
    """The weights are the same, but one normalisation does more than scale."""
    model = make()
    norm = model.model.language_model.norm
    plain = type(norm)
    norm.__class__ = type(
        "Shifted", (plain,), {"forward": lambda self, x: plain.forward(self, x) + 1}
    )
    with pytest.raises(AegisError) as caught:
        Guard(model, anchor, method="nullspace", vision=PIXELS)
    assert (
        "a Shifted (model.language_model.norm)" in caught.value.found
        and "protect=" in caught.value.fix
    )


@pytest.mark.filterwarnings("ignore:the weight of kfac")  # strong on purpose
def test_kfac_in_a_loop_draws_back_what_answers_mind(tmp_path: Path) -> None:
    """As in the README: normalisations and tables frozen, words drawn where labels are."""
    for_maps = (nn.Linear, nn.Conv2d)
    model, path = make(), tmp_path / "anchor.safetensors"
    for module in model.modules():
        if not isinstance(module, for_maps):
            for parameter in module.parameters(recurse=False):
                parameter.requires_grad_(False)
    with Guard.measure(model, parts=("curvature",)) as measured:
        for seed in range(3):
            asked = batch(seed)
            with measured.watch(asked["attention_mask"]):
                scores = model(**asked).logits[:, :-1]
            measured.answer(scores[asked["labels"][:, 1:] != -100])
    measured.save(path)
    maps = {
        name
        for name, module in model.named_modules()
        if isinstance(module, for_maps) and name != "lm_head"
    }
    found = from_artifact(artifacts.load(path, "anchor")).curvature
    assert {name.rpartition(".")[0] for name in found} == maps and len(maps) > 20
    moved = []
    for pull in (0.0, 100.0):
        tuned = make()
        for parameter, other in zip(tuned.parameters(), model.parameters(), strict=True):
            parameter.requires_grad_(other.requires_grad)
        guard = Guard(tuned, path, method="kfac", weight=pull)
        optimizer = torch.optim.AdamW(tuned.parameters(), lr=1e-3)
        for seed in range(10, 13):
            guard.backward(tuned(**batch(seed)).loss)
            guard.step(optimizer)
            optimizer.zero_grad()
        divergence = 0.0
        with torch.no_grad():
            for seed in range(3):
                # In float64: if drawn back strongly, the difference is less than float32 resolves.
                asked = batch(seed)
                asked["pixel_values"] = asked["pixel_values"].double()
                before, after = (
                    copy.deepcopy(m).double()(**asked).logits[:, PATCHES:].log_softmax(-1)
                    for m in (model, tuned)
                )
                divergence += float((before.exp() * (before - after)).sum())
        moved.append(divergence)
    assert 0 < 3 * moved[1] < moved[0]
