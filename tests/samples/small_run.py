"""Small recipes, a small trained run, and a small VLM that has knowledge to lose."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from aegis_cli.data.vqa.dataset import VQASet
from aegis_cli.models.backbones.embedded import EmbeddedVLM
from aegis_cli.recipes import Anchor, Demos, Expert, Probe, Recipe, Rollout, Train, to_yaml
from aegis_cli.training import train

TRAIN: dict[str, Any] = {
    "steps": 4,
    "batch_size": 4,
    "flow_samples": 2,
    "chunk": 20,  # all of them are executed, so a rollout needs few predictions
    "warmup": 1,
    "checkpoint_every": 2,
    "validate_every": 4,
    "log_every": 1,
    "backbone_lr": 1e-3,
    "precision": "float32",
}


def recipe(
    backbone: str | Path, methods: tuple[str, ...] = ("naive", "aegis"), **train: Any
) -> Recipe:
    """A recipe whose stages take about a second each."""
    return Recipe(
        name="small",
        backbone=str(backbone),
        methods=methods,
        demos=Demos(episodes=4),
        anchor=Anchor(samples=14, batch_size=14),
        train=Train(**{**TRAIN, **train}),
        expert=Expert(width=16, mlp_ratio=1),
        probe=Probe(questions=14),
        rollout=Rollout(episodes=2, replan=20),
    )


def write(folder: Path, backbone: str | Path, **changes: Any) -> Path:
    """The same recipe as a file."""
    path = folder / "small.yaml"
    path.write_text(to_yaml(recipe(backbone, **changes)))
    return path


@pytest.fixture(scope="module")
def run_folder(
    tiny_folder: Path, demos_file: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A two-step run of `naive`, one per module."""
    folder = tmp_path_factory.mktemp("runs") / "naive"
    train.run(recipe(tiny_folder, steps=2), "naive", demos_file, None, folder)
    return folder


def teach(model: EmbeddedVLM, asked: VQASet, steps: int = 120) -> EmbeddedVLM:
    """Train the model until it knows the answers to these questions by heart."""
    images = torch.from_numpy(asked.images[asked.image_of])
    texts, answers = [q.text for q in asked.questions], [q.answer for q in asked.questions]
    optimizer = torch.optim.AdamW(model.parameters(), lr=3e-3)
    for _ in range(steps):
        optimizer.zero_grad()
        (-model.answer_log_likelihood(images, texts, answers).mean()).backward()
        optimizer.step()
    return model


def flipped(data: bytes) -> bytes:
    """The data with one bit flipped."""
    return data[:-1] + bytes([data[-1] ^ 1])
