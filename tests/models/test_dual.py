"""The contract of every dual encoder, tested on the embedded one.

Features lie on the unit sphere, and each depends only on its own input.
"""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from samples.dual import TEXTS, make_dual, random_images
from torch import nn

from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError
from aegis_cli.data.streams.contract import Part, StreamTask
from aegis_cli.evaluation import zero_shot
from aegis_cli.models import backbones
from aegis_cli.models.backbones.dual import class_weights, early_layer
from aegis_cli.models.backbones.embedded_dual import MAX_WORDS, EmbeddedDual


@pytest.fixture(scope="module")
def dual() -> EmbeddedDual:
    return make_dual()


@torch.no_grad()
def test_features_have_length_one_and_the_promised_shape(dual: EmbeddedDual) -> None:
    images = dual.image_features(dual.pixels(random_images(5)))
    texts = dual.text_features(TEXTS)
    assert images.shape == (5, dual.width) and texts.shape == (len(TEXTS), dual.width)
    assert images.dtype == texts.dtype == torch.float32
    for features in (images, texts):
        torch.testing.assert_close(features.norm(dim=1), torch.ones(len(features)))
    assert dual.scale().shape == () and dual.scale() > 0


@torch.no_grad()
def test_pixels_are_what_bytes_say(dual: EmbeddedDual) -> None:
    image = torch.zeros(1, dual.image_size, dual.image_size, 3, dtype=torch.uint8)
    image[0, 1, 2, 0] = 255
    pixels = dual.pixels(image)
    assert (
        pixels.shape == (1, 3, dual.image_size, dual.image_size) and pixels.dtype == torch.float32
    )
    assert pixels[0, 0, 1, 2] == 1 and pixels.sum() == 2 - pixels.numel()


@torch.no_grad()
@pytest.mark.parametrize("seed", range(3))
def test_a_feature_does_not_depend_on_the_batch(dual: EmbeddedDual, seed: int) -> None:
    """Nor on its order, nor, for a text, on how much padding the others require."""
    order = torch.randperm(6, generator=torch.Generator().manual_seed(seed))
    pixels = dual.pixels(random_images(6, seed))
    together = dual.image_features(pixels)
    torch.testing.assert_close(dual.image_features(pixels[order]), together[order])
    torch.testing.assert_close(torch.cat([dual.image_features(p[None]) for p in pixels]), together)
    alone = torch.cat([dual.text_features([text]) for text in TEXTS])
    torch.testing.assert_close(dual.text_features(TEXTS), alone)


@torch.no_grad()
def test_looks_are_means_over_positions_of_an_early_layer_and_independent_of_the_batch(
    dual: EmbeddedDual,
) -> None:
    pixels, seen = dual.pixels(random_images(6)), []
    layers = dual.image.layers
    handle = layers[max(1, 2 * len(layers) // 3) - 1].register_forward_hook(
        lambda *args: seen.append(args[2][0])
    )
    looks = dual.looks(pixels)
    handle.remove()
    assert looks.dtype == torch.float32 and len(layers) > len(seen) == 1
    torch.testing.assert_close(looks, seen[0].squeeze(1).mean(1))
    torch.testing.assert_close(torch.cat([dual.looks(p[None]) for p in pixels]), looks)


@pytest.mark.parametrize("depth", range(1, 13))
def test_the_early_layer_is_one_of_the_tower(depth: int) -> None:
    assert 1 <= early_layer(depth) <= depth and (depth < 3 or early_layer(depth) < depth)


def test_each_tower_knows_its_sites(dual: EmbeddedDual) -> None:
    for text, read in (
        (False, dual.image_features(dual.pixels(random_images(2)))),
        (True, dual.text_features(TEXTS)),
    ):
        own = [name for name in dual.sites() if dual.in_text(name) == text]
        weights = [dual.get_submodule(name).weight for name in dual.sites()]
        touched = torch.autograd.grad(read.square().sum() + read.sum(), weights, allow_unused=True)
        assert [n for n, g in zip(dual.sites(), touched, strict=True) if g is not None] == own


@torch.no_grad()
def test_different_inputs_have_different_features(dual: EmbeddedDual) -> None:
    """Words, their order, and every part of the picture count."""
    texts = dual.text_features(["red cube", "cube red", "red ball", "red", "red cube red"])
    images = random_images(1).repeat(5, 1, 1, 1)
    half = dual.image_size // 2
    for i, (x, y) in enumerate([(0, 0), (0, half), (half, 0), (half, half)]):
        images[i + 1, y : y + half, x : x + half] = 0
    for features in (texts, dual.image_features(dual.pixels(images))):
        assert ((features @ features.T).fill_diagonal_(0) < 1 - 1e-6).all()


def test_every_weight_learns(dual: EmbeddedDual) -> None:
    logits = (
        dual.scale()
        * dual.image_features(dual.pixels(random_images(4)))
        @ dual.text_features(TEXTS).T
    )
    gradients = torch.autograd.grad(
        logits.log_softmax(1)[:, 0].sum(), list(dual.parameters()), allow_unused=True
    )
    idle = [
        name
        for (name, _), g in zip(dual.named_parameters(), gradients, strict=True)
        if g is None or not g.any()
    ]
    assert idle == []


def test_sites_are_the_mlps_and_attention_outputs_of_both_towers(dual: EmbeddedDual) -> None:
    sites, modules = dual.sites(), dict(dual.named_modules())
    assert all(
        modules[name] is site and isinstance(site, nn.Linear) for name, site in sites.items()
    )
    left = [n for n, m in modules.items() if isinstance(m, nn.Linear) and n not in sites]
    assert {n.rpartition(".")[2] for n in left} == {"qkv", "project"}
    depths = {"image": dual.shape.depth, "text": dual.shape.text_depth}
    assert len(sites) == 3 * sum(depths.values())
    for tower, depth in depths.items():
        expected = {
            f"{tower}.layers.{i}.{name}" for i in range(depth) for name in ("out", "up", "down")
        }
        assert {name for name in sites if name.startswith(f"{tower}.")} == expected


@torch.no_grad()
def test_what_is_saved_loads_as_the_same_encoder(dual: EmbeddedDual, tmp_path: Path) -> None:
    dual.save(tmp_path / "encoder")
    path = tmp_path / "encoder" / "model.safetensors"
    assert artifacts.read_header(path).kind == "dual-encoder"
    for name in (tmp_path / "encoder", path):
        again = backbones.load_dual(str(name))
        assert again.fingerprint() == dual.fingerprint() == artifacts.read_header(path).fingerprint
        pixels = dual.pixels(random_images(3))
        assert torch.equal(again.image_features(pixels), dual.image_features(pixels))
        assert torch.equal(again.text_features(TEXTS), dual.text_features(TEXTS))
    before = path.read_bytes()
    dual.save(tmp_path / "encoder")
    assert path.read_bytes() == before


@torch.no_grad()
def test_class_weights_are_the_mean_over_templates_brought_to_length_one(
    dual: EmbeddedDual,
) -> None:
    weights = class_weights(dual, ["red", "blue"], ["a {} cube", "{}"])
    by_hand = [dual.text_features([f"a {c} cube", c]).mean(0) for c in ("red", "blue")]
    torch.testing.assert_close(weights, torch.stack([mean / mean.norm() for mean in by_hand]))


def test_what_it_cannot_read_is_one_error(dual: EmbeddedDual) -> None:
    with pytest.raises(AegisError, match="the word 'blu'") as caught:
        dual.text_features(["a red cube", "a blu cube"])
    assert "'blue'" in caught.value.fix
    with pytest.raises(AegisError, match=f"{MAX_WORDS} words"):
        dual.text_features(["a", "red " * MAX_WORDS])
    assert dual.text_features(["red " * (MAX_WORDS - 1)]).shape == (1, dual.width)


def test_a_backbone_is_no_dual_encoder(
    dual: EmbeddedDual, tiny_folder: Path, tmp_path: Path
) -> None:
    with pytest.raises(AegisError, match="of kind 'backbone'"):
        backbones.load_dual(str(tiny_folder))
    dual.save(tmp_path)
    with pytest.raises(AegisError, match="of kind 'dual-encoder'"):
        backbones.load(str(tmp_path))
    with pytest.raises(AegisError, match="no backbone at 'nothing'"):
        backbones.load_dual("nothing")


@torch.no_grad()
def test_zero_shot_accuracy_is_the_share_of_pictures_named_right(
    dual: EmbeddedDual, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Features from several batches equal those from one picture at a time.

    The labels are the encoder's own answers except for three of eleven.
    """
    monkeypatch.setattr(zero_shot, "BATCH", 4)
    images, classes, templates = random_images(11), ("red", "blue", "size"), ("a {} cube", "{}")
    weights = class_weights(dual, classes, templates)
    said = [
        int((weights @ dual.image_features(dual.pixels(image[None]))[0]).argmax())
        for image in images
    ]
    labels = torch.tensor([(label + (i < 3)) % 3 for i, label in enumerate(said)])
    part = Part(labels, lambda rows: images[rows])
    assert zero_shot.accuracy(
        dual, StreamTask("x", classes, templates, part, part, part), part
    ) == pytest.approx(8 / 11)
