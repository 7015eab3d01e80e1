"""A tiny dual encoder with random weights, and streams of small pictures that take no time."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch
from torch import Tensor, nn

from aegis_cli import recipes
from aegis_cli.common.errors import AegisError
from aegis_cli.continual import images
from aegis_cli.data.streams.contract import Part, StreamTask
from aegis_cli.models.backbones.dual import DualEncoder
from aegis_cli.recipes import Igsp, MoeAdapters, StreamRecipe, StreamTrain

SIZE, WIDTH = 8, 16
FILE = "tiny.safetensors"


class Block(nn.Module):
    """Attention without heads, and an MLP."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm, self.qkv, self.out = (
            nn.LayerNorm(width),
            nn.Linear(width, 3 * width),
            nn.Linear(width, width),
        )
        self.second, self.up, self.down = (
            nn.LayerNorm(width),
            nn.Linear(width, 2 * width),
            nn.Linear(2 * width, width),
        )

    def forward(self, x: Tensor) -> Tensor:
        q, k, v = self.qkv(self.norm(x)).chunk(3, -1)
        x = x + self.out((q @ k.mT / WIDTH**0.5).softmax(-1) @ v)
        return x + self.down(nn.functional.gelu(self.up(self.second(x))))


class TinyDual(DualEncoder):
    """Four image tokens of 4 x 4 pixels; texts by their letters."""

    def __init__(self, seed: int = 0) -> None:
        super().__init__()
        self.image_size, self.width = SIZE, WIDTH
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self.patch, self.letters = nn.Conv2d(3, WIDTH, 4, stride=4), nn.Embedding(128, WIDTH)
            self.image, self.text = Block(WIDTH), Block(WIDTH)
            self.log_scale = nn.Parameter(torch.tensor(2.0))

    def pixels(self, images: Tensor) -> Tensor:
        return images.to(self.device).permute(0, 3, 1, 2).float() / 127.5 - 1

    def image_features(self, pixels: Tensor) -> Tensor:
        tokens = self.patch(pixels).flatten(2).transpose(1, 2)
        return nn.functional.normalize(self.image(tokens).mean(1).float(), dim=-1)

    def looks(self, pixels: Tensor) -> Tensor:
        return self.patch(pixels).flatten(2).mean(2).float()

    def text_features(self, texts: Sequence[str]) -> Tensor:
        rows = [
            torch.tensor([ord(c) for c in text.ljust(16)[:16]], device=self.device)
            for text in texts
        ]
        return nn.functional.normalize(
            self.text(self.letters(torch.stack(rows))).mean(1).float(), dim=-1
        )

    def scale(self) -> Tensor:
        return self.log_scale.exp()

    def sites(self) -> dict[str, nn.Linear]:
        towers = {"image": self.image, "text": self.text}
        return {
            f"{name}.{site}": getattr(tower, site)
            for name, tower in towers.items()
            for site in ("out", "up", "down")
        }

    def in_text(self, site: str) -> bool:
        return site.startswith("text.")

    def save(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        safetensors.torch.save_file(self.state_dict(), folder / FILE)


def load(name: str) -> TinyDual:
    """`tiny`, or a model from a folder that `save` wrote."""
    model = TinyDual()
    if name != "tiny":
        if not (Path(name) / FILE).is_file():
            raise AegisError(f"no dual encoder '{name}'", "tiny, or a folder", "check the name")
        model.load_state_dict(safetensors.torch.load_file(Path(name) / FILE))
    return model.eval()


COUNTS, NOISE = (48, 12, 30), 0.4  # images of the three parts


def task(name: str, classes: int = 3, seed: int = 0) -> StreamTask:
    """One random picture per class, with noise."""
    generator = torch.Generator().manual_seed(seed)
    pictures = torch.rand(classes, SIZE, SIZE, 3, generator=generator)

    def part(count: int) -> Part:
        labels = torch.arange(count) % classes
        images = pictures[labels] + NOISE * torch.randn(count, SIZE, SIZE, 3, generator=generator)
        pixels = (images.clamp(0, 1) * 255).to(torch.uint8)
        return Part(labels, lambda rows: pixels[rows])

    names = tuple(f"{name} {chr(97 + i)}" for i in range(classes))
    return StreamTask(name, names, ("a {}", "the {}"), *(part(count) for count in COUNTS))


STREAMS: dict[str, tuple[StreamTask, ...]] = {
    "small": (task("one", seed=1), task("two", 4, seed=2), task("three", seed=3)),
    "pair": (task("one", seed=1), task("again", seed=1)),
    "contrary": (task("one", seed=1), task("other", seed=1)),
}


def load_stream(name: str, image_size: int, cache: Path, on_event: Any) -> tuple[StreamTask, ...]:
    assert image_size == SIZE
    if name not in STREAMS:
        raise AegisError(f"no stream '{name}'", f"one of {', '.join(STREAMS)}", "check the name")
    return STREAMS[name]


def edition(name: str) -> list[str]:
    return [task.name for task in load_stream(name, SIZE, Path(), None)]


@pytest.fixture
def tiny_streams(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let stages find the encoder `tiny` and the streams above by their names."""
    offer(monkeypatch)


def offer(patch: pytest.MonkeyPatch) -> None:
    """The same as `tiny_streams`, for as long as the patches last."""
    patch.setattr(images.backbones, "load_dual", load, raising=False)
    patch.setattr(images.streams, "load", load_stream, raising=False)
    patch.setattr(images.streams, "edition", edition)


def recipe(method: str = "igsp", **changes: Any) -> StreamRecipe:
    """A stream that takes a second to learn; `changes` replace keys of `train`, or sections."""
    train = {
        "method": method,
        "steps": 12,
        "batch_size": 16,
        "lr": 1e-2,
        "warmup": 2,
        "checkpoint_every": 5,
        "log_every": 4,
    }
    top = {
        name: changes.pop(name)
        for name in list(changes)
        if name in StreamRecipe.__dataclass_fields__
    }
    made = StreamRecipe(
        name="small",
        stream="small",
        encoder="tiny",
        train=StreamTrain(**train | changes),
        igsp=Igsp(rank=2, identify=0.5, check_every=2, checks=2),
        moe_adapters=MoeAdapters(rank=2),
    )
    return dataclasses.replace(made, **top)


def write(folder: Path, made: StreamRecipe) -> Path:
    path = folder / "stream.yaml"
    path.write_text(recipes.to_yaml(made))
    return path
