"""The guard of a Hugging Face model accepts an anchor of `aegis anchor` on its folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from samples.hf import write
from torch import nn

from aegis_cli import Guard
from aegis_cli.anchors import measure
from aegis_cli.common.errors import AegisError
from aegis_cli.recipes import Anchor

LAYERS = "model.language_model.layers"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write("paligemma", tmp_path_factory.mktemp("model"))


@pytest.fixture(scope="module")
def anchor(folder: Path) -> Path:
    path = folder.parent / "anchor.safetensors"
    settings = Anchor(samples=21, parts=("moments", "inputs", "curvature"))
    measure.run(str(folder), settings, path)
    return path


def load(folder: Path) -> nn.Module:
    from transformers import AutoModelForImageTextToText

    return AutoModelForImageTextToText.from_pretrained(folder, dtype=torch.float32).eval()


@pytest.mark.parametrize(
    ("method", "given"),
    [
        ("aegis", {"layers": LAYERS}),
        ("nullspace", {"energy": 0.9, "protect": ("maps",)}),
        ("kfac", {"protect": ("maps",)}),
    ],
)
def test_the_guard_knows_the_model_of_the_folder(
    method: str, given: dict[str, Any], folder: Path, anchor: Path
) -> None:
    guard = Guard(load(folder), anchor, method=method, **given)
    guard.remove()


def test_weights_that_have_moved_are_refused(folder: Path, anchor: Path) -> None:
    model = load(folder)
    with torch.no_grad():
        next(model.parameters()).add_(1e-3)
    with pytest.raises(AegisError, match="the weights are not those that anchor"):
        Guard(model, anchor, LAYERS)
