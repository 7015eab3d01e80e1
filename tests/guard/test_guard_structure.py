"""Layers, parameter groups and maps of models that are not ours."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from samples.guard import LAYERS, Block, compiling, make
from samples.tiny import make_tiny
from torch import nn

from aegis_cli.common.errors import AegisError
from aegis_cli.models import structure


class Two(nn.Module):
    """A model with two towers."""

    def __init__(self) -> None:
        super().__init__()
        self.left = nn.ModuleList(Block() for _ in range(3))
        self.right = nn.ModuleList(Block() for _ in range(2))


class Experts(nn.Module):
    """Blocks, each with a list of blocks."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.ModuleList(
            nn.ModuleDict({"experts": nn.ModuleList(Block() for _ in range(4))}) for _ in range(2)
        )
        self.mixed = nn.ModuleList([Block(), nn.Sequential(nn.Linear(3, 3))])
        self.maps = nn.ModuleList(nn.Linear(3, 3) for _ in range(9))


@pytest.mark.parametrize(
    ("model", "layers"),
    [(make(), LAYERS), (make_tiny(), "layers"), (Experts(), "layers")],
)
def test_the_only_list_of_blocks_is_found(model: nn.Module, layers: str) -> None:
    found = structure.find_layers(model, None)
    assert list(found) == [f"{layers}.0", f"{layers}.1"]
    assert list(found.values()) == list(model.get_submodule(layers))
    assert (
        structure.find_layers(model, layers)
        == found
        == structure.find_layers(model, list(found.values()))
    )


def test_two_lists_are_ambiguous_however_long() -> None:
    with pytest.raises(AegisError, match="2 lists") as caught:
        structure.find_layers(Two(), None)
    assert "'left' (3 Block)" in caught.value.fix and "'right' (2 Block)" in caught.value.fix
    assert list(structure.find_layers(Two(), "right")) == ["right.0", "right.1"]


@pytest.mark.parametrize("layers", ["rigth", "left.0", "", [], [Block()], "twice"])
def test_layers_that_are_none(layers: object) -> None:
    model = Two()
    with pytest.raises(AegisError) as caught:
        structure.find_layers(
            model, [model.left[0], model.left[0]] if layers == "twice" else layers
        )  # type: ignore[arg-type]
    assert "'left'" in caught.value.fix


def test_a_model_without_blocks() -> None:
    with pytest.raises(AegisError, match="no list of equal blocks"):
        structure.find_layers(nn.Sequential(nn.Linear(2, 2)), None)


@compiling
@pytest.mark.parametrize("how", ["plain", "compiled", "some layers"])
def test_every_parameter_is_in_exactly_one_group(how: str) -> None:
    model = make()
    layers = structure.find_layers(
        model, [model.text.layers[1]] if how == "some layers" else LAYERS
    )
    if how == "compiled":
        model.text.layers[0], model.text = (
            torch.compile(model.text.layers[0]),
            torch.compile(model.text),
        )
        layers = structure.find_layers(model, list(model.text.layers))
    groups = structure.parameter_groups(model, layers)
    ids = [id(p) for group in groups.values() for p in group]
    assert len(ids) == len(set(ids)) and set(ids) == {id(p) for p in model.parameters()}
    rest = ["text.layers.0"] if how == "some layers" else []
    assert list(groups) == [
        "layers.0",
        *(["layers.1"] if not rest else []),
        "vision",
        "embeddings",
        *rest,
        "text.norm",
    ]
    assert all(
        p is q
        for p, q in zip(groups["layers.0"], next(iter(layers.values())).parameters(), strict=True)
    )


def test_the_embedded_vlm_has_the_groups_that_it_names_itself() -> None:
    model = make_tiny()
    groups, own = (
        structure.parameter_groups(model, structure.find_layers(model, None)),
        model.parameter_groups(),
    )
    assert list(groups) == list(own)
    for name in own:
        assert [id(p) for p in groups[name]] == [id(p) for p in own[name]]


@compiling
def test_the_fingerprint_is_the_embedded_ones_and_knows_no_compiler() -> None:
    model = make_tiny()
    before = structure.fingerprint(model)
    assert before == model.fingerprint()
    model.layers[1] = torch.compile(model.layers[1])
    assert structure.fingerprint(model) == before
    with torch.no_grad():
        model.words.weight[0, 0] += 1e-3
    assert structure.fingerprint(model) != before


# --- maps -----------------------------------------------------------------------------------------


class Tied(nn.Module):
    """Every way to share a weight."""

    def __init__(self) -> None:
        super().__init__()
        self.head = nn.Linear(4, 9, bias=False)  # before its table
        self.words, self.same_words = nn.Embedding(9, 4), nn.Embedding(9, 4)
        self.first, self.again, self.partly = nn.Linear(4, 4), nn.Linear(4, 4), nn.Linear(4, 4)
        self.second_head, self.head_with_bias = nn.Linear(4, 9, bias=False), nn.Linear(4, 9)
        for module in (self.head, self.same_words, self.second_head, self.head_with_bias):
            module.weight = self.words.weight
        self.again.weight, self.again.bias = self.first.weight, self.first.bias
        self.partly.weight = self.first.weight


def test_shared_weights_have_one_site() -> None:
    maps = structure.find_maps(Tied(), ())
    assert maps.kinds == {"words": "embeddings", "first": "maps"}
    assert maps.twins == {"same_words": "words", "again": "first"}
    assert maps.heads == {"words": "head"}
    assert maps.unknown.keys() == {"partly", "second_head", "head_with_bias"}


def test_what_is_not_known_is_named() -> None:
    model = nn.ModuleDict(
        {
            "a": nn.Linear(2, 2),
            "b": nn.GroupNorm(1, 2),
            "c": nn.Conv2d(4, 4, 1, groups=2),
            "d": nn.Conv2d(2, 2, 3, padding="same"),
            "e": nn.MultiheadAttention(4, 2),
            "f": nn.Conv2d(3, 3, 2),
        }
    )
    maps = structure.find_maps(model, "f")
    assert maps.kinds == {"a": "maps", "f": "stem"}
    assert (
        set(maps.unknown) == {"b", "c", "d", "e", "e.out_proj"} and "GroupNorm" in maps.unknown["b"]
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("eps", [None, 1e-5])
@pytest.mark.parametrize("size", [1, 1e-3, 1e-6])
def test_a_root_mean_square_of_pytorch_is_known_with_its_own_epsilon(
    dtype: torch.dtype, eps: float | None, size: float
) -> None:
    norm = nn.RMSNorm(6, eps=eps, dtype=dtype)
    norm.weight.data = torch.linspace(0.5, 2, 6, dtype=dtype)
    assert structure.site_kind(norm) == "norms"
    x = size * torch.linspace(-1, 2, 30, dtype=dtype).view(5, 6)
    torch.testing.assert_close(norm.weight * structure.rms_normed(norm, x), norm(x))


def test_a_part_of_the_model_by_its_whole_name() -> None:
    model = nn.ModuleDict(
        {"vision": nn.ModuleList([nn.Linear(2, 2)]), "vision_text": nn.Linear(2, 2)}
    )
    assert structure.find_maps(model, ("vision",)).kinds == {
        "vision.0": "stem",
        "vision_text": "maps",
    }
    with pytest.raises(AegisError, match="visoin"):
        structure.find_maps(model, ("visoin",))


def test_the_names_of_the_sample_are_those_the_tests_use(tmp_path: Path) -> None:
    maps = structure.find_maps(make(), ("vision",))
    assert (
        not maps.unknown
        and maps.heads == {"text.words": "head"}
        and maps.kinds["vision.0"] == "stem"
    )


class Patches(nn.Module):
    """nanoVLM's: a convolution, and a table of positions that is added to its output."""

    def __init__(self) -> None:
        super().__init__()
        self.conv = nn.Conv2d(3, 8, 4, stride=4)
        self.position_embedding = nn.Parameter(torch.rand(1, 16, 8))


class Mixing(nn.Module):
    """A matrix that is not in a torch map: it may multiply values that differ by question."""

    def __init__(self) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(8)
        self.mix = nn.Parameter(torch.eye(8))


def test_a_table_of_positions_is_a_row_that_is_held_still() -> None:
    model = nn.ModuleDict({"vision": Patches(), "text": Mixing()})
    maps = structure.find_maps(model, ("vision",))
    assert maps.kinds["vision.position_embedding"] == maps.kinds["vision.conv"] == "stem"
    assert maps.unknown == {"text": "a Mixing"}
