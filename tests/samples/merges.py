"""A tiny VLM that knows its validation questions by heart, and a policy trained on top of it."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import NamedTuple

import pytest
import torch

from aegis_cli.anchors import measure
from aegis_cli.data.vqa.dataset import load_scenes
from aegis_cli.models import backbones
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.recipes import Anchor
from aegis_cli.training import train
from samples.small_run import recipe, teach
from samples.tiny import make_tiny

QUESTIONS = 14  # for validation
SAMPLES = 14  # for an anchor


class Place(NamedTuple):
    """A run beside its demonstrations, as `aegis run` leaves them; read-only."""

    base: Path
    run: Path
    demos: Path
    anchor: Path


@pytest.fixture(scope="session")
def merge_place(tmp_path_factory: pytest.TempPathFactory, demos_file: Path) -> Place:
    folder = tmp_path_factory.mktemp("merge")
    found = Place(*(folder / name for name in ("base", "run", "demos.safetensors", "anchor.sft")))
    shutil.copyfile(demos_file, found.demos)
    teach(make_tiny(), load_scenes("validation", QUESTIONS)).eval().save(found.base)
    parts = ("inputs", "curvature")
    settings = Anchor(samples=SAMPLES, batch_size=64, parts=parts, energy=1.0)
    measure.run(str(found.base), settings, found.anchor)
    trained = recipe(found.base, steps=8, backbone_lr=1e-2, checkpoint_every=4)
    train.run(trained, "naive", found.demos, None, found.run)
    return found


def parameters(name: str | Path) -> dict[str, torch.Tensor]:
    """Every parameter of a model by its name."""
    model: Backbone = backbones.load(str(name))
    return {name: p.detach() for name, p in model.named_parameters()}
