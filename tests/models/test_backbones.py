"""One suite that every backbone must pass, and where one is found."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from samples.backbones import LONGEST, TEXTS, close, encode, images, outspoken_tiny
from samples.tiny import make_tiny

from aegis_cli.common.errors import AegisError
from aegis_cli.data.vqa.questions import vocabulary
from aegis_cli.models import backbones
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.models.backbones.families import FAMILIES

BACKBONES = ("embedded", *FAMILIES)


@pytest.fixture(params=BACKBONES)
def backbone(request: pytest.FixtureRequest, hf_backbone: Callable[[str], Backbone]) -> Backbone:
    return outspoken_tiny() if request.param == "embedded" else hf_backbone(request.param)


# --- the contract ---------------------------------------------------------------------------------


@pytest.mark.parametrize("inside", ["", "/backbone"])
def test_a_path_may_have_a_sign_that_else_begins_the_layers(inside: str, tmp_path: Path) -> None:
    name = f"{tmp_path}/run #2{inside}"
    make_tiny().save(Path(name))
    assert backbones.load(name).fingerprint() == make_tiny().fingerprint()
    with pytest.raises(AegisError, match="'#text.layers' after the embedded VLM"):
        backbones.load(f"{name}#text.layers")


def test_there_are_backbones_to_test() -> None:
    assert BACKBONES


def test_shapes_are_those_it_declares(backbone: Backbone) -> None:
    got = encode(backbone, images(4), TEXTS)
    tokens = got.mask.shape[1]
    assert len(got.hidden) == len(got.keys_values) == backbone.depth
    assert all(h.shape == (4, tokens, backbone.width) for h in got.hidden)
    assert all(
        t.shape == (4, backbone.kv_heads, tokens, backbone.head_dim)
        for pair in got.keys_values
        for t in pair
    )
    assert backbone.heads % backbone.kv_heads == 0
    assert got.mask.dtype == torch.bool


def test_the_mask_counts_each_rows_own_tokens(backbone: Backbone) -> None:
    together = encode(backbone, images(4), TEXTS).mask.sum(1)
    alone = [encode(backbone, images(1), [text]).mask for text in TEXTS]
    assert all(mask.all() for mask in alone)
    assert together.tolist() == [mask.shape[1] for mask in alone]
    assert len(set(together.tolist())) > 1


def test_padding_never_changes_valid_tokens(backbone: Backbone) -> None:
    together, mask = (e := encode(backbone, images(4), TEXTS)).hidden, e.mask
    for i, text in enumerate(TEXTS):
        alone = encode(backbone, images(4)[i : i + 1], [text])
        for layer, single in zip(together, alone.hidden, strict=True):
            close(layer[i][mask[i]], single[0])
        for layer, single in zip(e.keys_values, alone.keys_values, strict=True):
            close(layer.key[i][:, mask[i]], single.key[0])
            close(layer.value[i][:, mask[i]], single.value[0])


def test_image_and_text_both_reach_the_text_tokens(backbone: Backbone) -> None:
    first, other_image = (
        encode(backbone, images(1, seed), [TEXTS[0]]).hidden[-1][0, -1] for seed in (0, 1)
    )
    other_text = encode(backbone, images(1), [TEXTS[0].replace("balls", "cubes")]).hidden[-1][0, -1]
    assert (first - other_image).abs().max() > 1e-3
    assert (first - other_text).abs().max() > 1e-3


def test_every_parameter_is_in_exactly_one_group(backbone: Backbone) -> None:
    groups = backbone.parameter_groups()
    grouped = [id(p) for group in groups.values() for p in group]
    assert len(grouped) == len(set(grouped))
    assert set(grouped) == {id(p) for p in backbone.parameters()}
    assert [name for name in groups if name.startswith("layers.")] == [
        f"layers.{i}" for i in range(backbone.depth)
    ]


def test_every_parameter_is_of_exactly_one_site(backbone: Backbone) -> None:
    """A module's, or a lone row that is a site itself; unused parameters belong to none."""
    sites, modules = backbone.sites(), backbone.site_modules()
    of_modules = [p for module in modules.values() for p in module.parameters(recurse=False)]
    owned = of_modules + [backbone.get_parameter(site) for site in sites if site not in modules]
    assert modules.keys() <= sites.keys() and len(owned) == len({id(p) for p in owned})
    idle = {id(p) for part in backbone.idle for p in backbone.get_submodule(part).parameters()}
    assert {id(p) for p in owned} == {id(p) for p in backbone.parameters()} - idle
    assert set(sites.values()) == {"maps", "norms", "embeddings", "stem"}
    assert all((kind == "stem") == backbone.in_vision(site) for site, kind in sites.items())


def test_language_maps_are_linear_maps_of_the_layers_by_their_path(backbone: Backbone) -> None:
    maps = backbone.language_maps()
    assert all(backbone.get_submodule(name) is linear for name, linear in maps.items())
    groups = backbone.parameter_groups()
    in_layers = {id(p) for i in range(backbone.depth) for p in groups[f"layers.{i}"]}
    assert all(id(linear.weight) in in_layers for linear in maps.values())
    for i in range(backbone.depth):
        assert any(
            id(linear.weight) in {id(p) for p in groups[f"layers.{i}"]} for linear in maps.values()
        )


# --- weights --------------------------------------------------------------------------------------


def test_the_fingerprint_changes_with_any_weight(backbone: Backbone) -> None:
    original = backbone.fingerprint()
    assert original == backbone.fingerprint()
    for name, tensor in backbone.state_dict().items():
        flat = tensor.view(-1)
        kept = flat[-1].clone()
        flat[-1] = torch.nextafter(kept, torch.tensor(math.inf))
        assert backbone.fingerprint() != original, name
        flat[-1] = kept
    assert backbone.fingerprint() == original


def test_a_saved_backbone_loads_as_the_same(backbone: Backbone, tmp_path: Path) -> None:
    backbone.save(tmp_path)
    loaded = backbones.load(str(tmp_path))
    assert type(loaded) is type(backbone)
    assert loaded.fingerprint() == backbone.fingerprint()
    assert loaded.answer(images(4), TEXTS) == backbone.answer(images(4), TEXTS)
    for x, y in zip(
        encode(loaded, images(4), TEXTS).hidden,
        encode(backbone, images(4), TEXTS).hidden,
        strict=True,
    ):
        assert torch.equal(x, y)
    assert not loaded.training and all(p.dtype == torch.float32 for p in loaded.parameters())


def test_saving_twice_gives_the_same_bytes(backbone: Backbone, tmp_path: Path) -> None:
    contents = []
    for folder in (tmp_path / "a", tmp_path / "b"):
        backbone.save(folder)
        contents.append({p.name: p.read_bytes() for p in folder.iterdir()})
    assert contents[0] and contents[0] == contents[1]


def test_asking_leaves_the_weights_alone(backbone: Backbone) -> None:
    before = backbone.fingerprint()
    backbone.answer(images(2), TEXTS[:2])
    backbone.answer_log_likelihood(images(2), TEXTS[:2], ["red", "two"])
    assert backbone.fingerprint() == before
    assert all(p.grad is None for p in backbone.parameters())


# --- answers --------------------------------------------------------------------------------------


def test_who_else_is_in_the_batch_does_not_matter(backbone: Backbone) -> None:
    """Also where rows share an image, in a run or scattered."""
    frames, texts, said = (
        images(3)[[0, 0, 1, 2, 0]],
        [*TEXTS, LONGEST],
        ["red", "two", "x3 y5", "no", "blue cube"],
    )
    answers, scores = (
        backbone.answer(frames, texts),
        backbone.answer_log_likelihood(frames, texts, said),
    )
    assert len(set(answers)) > 1
    for order in ([4, 2, 0, 1, 3], [1], [3, 0], [0, 4, 1, 2]):
        rows = frames[order], [texts[i] for i in order]
        assert backbone.answer(*rows) == [answers[i] for i in order]
        close(backbone.answer_log_likelihood(*rows, [said[i] for i in order]), scores[order])


def test_what_is_prepared_of_answers_gives_the_same_likelihoods(backbone: Backbone) -> None:
    asked = images(2), TEXTS[:2], ["red", "two"]
    scores = backbone.answer_log_likelihood(*asked)
    prepared = backbone.prepare_answers(*asked)
    assert torch.equal(backbone.answer_log_likelihood(*asked, prepared), scores)


def test_an_answer_depends_on_its_own_image(backbone: Backbone) -> None:
    first, second = (
        backbone.answer_log_likelihood(images(1, s), TEXTS[:1], ["red"]) for s in (0, 1)
    )
    assert (first - second).abs() > 1e-4


def test_likelihoods_are_those_of_disjoint_events(backbone: Backbone) -> None:
    """Different answers exclude each other, so their probabilities add to at most 1."""
    words = list(vocabulary())
    said = ["", *words, *(f"{a} {b}" for a in words[:6] for b in words[:6])]
    scores = backbone.answer_log_likelihood(
        images(1).expand(len(said), -1, -1, -1), TEXTS[:1] * len(said), said
    )
    assert scores.shape == (len(said),) and scores.dtype == torch.float32
    assert (scores < 0).all()
    assert 0 < scores.double().exp().sum() <= 1 + 1e-5


def test_an_unknown_word_is_refused_with_a_close_one() -> None:
    backbone = outspoken_tiny()
    for ask in (
        lambda: backbone.prepare(images(1), ["where is the bal"]),
        lambda: backbone.answer(images(1), ["where is the bal"]),
        lambda: backbone.answer_log_likelihood(images(1), TEXTS[:1], ["bal"]),
    ):
        with pytest.raises(AegisError) as caught:
            ask()
        assert "'bal'" in caught.value.found and "'ball'" in caught.value.fix


def test_a_text_that_is_too_long_is_refused(backbone: Backbone) -> None:
    long = "ball " * 3000
    for ask in (
        lambda: backbone.prepare(images(1), [long]),
        lambda: backbone.answer(images(1), [long]),
        lambda: backbone.answer_log_likelihood(images(1), TEXTS[:1], [long]),
    ):
        with pytest.raises(AegisError, match="3[0-9]{3} tokens"):
            ask()


# --- finding one ----------------------------------------------------------------------------------


def test_a_backbone_is_found_by_folder_file_or_run(tiny_folder: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    make_tiny(1).save(run / "checkpoints" / "last" / "backbone")
    assert backbones.load(str(tiny_folder)).fingerprint() == make_tiny().fingerprint()
    assert (
        backbones.load(str(tiny_folder / "model.safetensors")).fingerprint()
        == make_tiny().fingerprint()
    )
    assert backbones.load(str(run)).fingerprint() == make_tiny(1).fingerprint()


def test_the_digest_of_a_model_is_that_of_all_it_is_made_of(
    hf_folder: Callable[[str], Path], tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(hf_folder("smolvlm"), tmp_path / "model"))
    original = backbones.sha256(str(folder))
    assert original == backbones.sha256(str(hf_folder("smolvlm")))
    (folder / "notes.md").write_text("what nobody loads")
    assert backbones.sha256(
        str(folder)
    ) == original and folder / "notes.md" not in backbones.model_files(str(folder))
    for name in ("model.safetensors", "config.json", "tokenizer.json", "chat_template.jinja"):
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data + b" ")
        assert backbones.sha256(str(folder)) != original, name
        assert folder / name in backbones.model_files(str(folder))
        (folder / name).write_bytes(data)


def test_a_missing_backbone_is_refused(tmp_path: Path) -> None:
    with pytest.raises(AegisError) as caught:
        backbones.load(str(tmp_path / "nowhere"))
    assert "nowhere" in caught.value.found and "embedded" in caught.value.expected
