"""Models with real shapes and random weights, built from tables in the code."""

from __future__ import annotations

import pytest
import torch
from samples.shapes import small
from samples.training import images

from aegis_cli.common.errors import AegisError
from aegis_cli.models import backbones
from aegis_cli.models.backbones import of_shape, shapes


@pytest.mark.parametrize("name", shapes.SHAPES)
def test_a_shape_has_the_parameters_that_its_name_says(name: str) -> None:
    shape = shapes.SHAPES[name]
    with torch.device("meta"):  # takes no memory
        model = of_shape.assemble(shape)
    assert sum(p.numel() for p in model.parameters()) // 10**6 == shape.parameters


@pytest.mark.parametrize(
    ("name", "more"), [("smolvlm2-256m", 0), ("paligemma2-3b", 2)], ids=["smolvlm", "paligemma"]
)
def test_a_small_one_is_read_and_asked_like_any_other(
    name: str, more: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(shapes.SHAPES, name, small(name))
    model, again = backbones.load(f"random:{name}"), backbones.load(f"random:{name}")
    assert model.fingerprint() == again.fingerprint()
    assert all(torch.equal(p, p.bfloat16().float()) for p in model.parameters())
    encoding = model.encode(model.prepare(images(2), ["move up", "go to the red target"]))
    tokens = shapes.SHAPES[name].tokens
    assert encoding.image.sum(-1).tolist() == [tokens] * 2
    assert encoding.mask.sum(1).tolist() == [tokens + more + 2, tokens + more + 5]  # and the words
    said = model.answer_log_likelihood(images(2), ["is it red", "how many"], ["yes", "two"])
    assert said.isfinite().all() and (said < 0).all()
    assert set(model.sites().values()) == {"maps", "norms", "embeddings", "stem"}
    assert len(model.answer(images(1), ["is it red"])) == 1


def test_random_weights_are_no_files() -> None:
    assert backbones.model_files("random:smolvlm2-256m") == []


def test_an_unknown_shape_is_refused_with_those_that_there_are() -> None:
    with pytest.raises(AegisError, match="smolvlm3") as raised:
        backbones.load("random:smolvlm3")
    assert "paligemma2-3b" in raised.value.expected
