"""A model that is not ours: two transformer layers over image and text, in several variants."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.checkpoint import checkpoint

from aegis_cli import Guard

WIDTH, WORDS, PATCHES, TEXT = 16, 23, 3, 5
IMAGE = torch.arange(PATCHES + TEXT) < PATCHES
LAYERS = "text.layers"
ALL_PARTS = ("moments", "inputs")


class Block(nn.Module):
    """One attention head and a small feed-forward part."""

    def __init__(self) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.LayerNorm(WIDTH), nn.LayerNorm(WIDTH)
        self.qkv, self.out = nn.Linear(WIDTH, 3 * WIDTH), nn.Linear(WIDTH, WIDTH)
        self.up, self.down = nn.Linear(WIDTH, 2 * WIDTH), nn.Linear(2 * WIDTH, WIDTH)

    def forward(self, x: Tensor, hidden: Tensor) -> Tensor:
        q, k, v = self.qkv(self.norm1(x)).chunk(3, -1)
        x = x + self.out((q @ k.mT / 4).masked_fill(hidden[:, None], -1e4).softmax(-1) @ v)
        return x + self.down(F.gelu(self.up(self.norm2(x))))


class TupleBlock(Block):
    """Takes (x, mask) and returns (x, mask)."""

    def forward(self, both: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:  # type: ignore[override]
        return super().forward(*both), both[1]


class Text(nn.Module):
    def __init__(self, block: type[Block]) -> None:
        super().__init__()
        self.words = nn.Embedding(WORDS, WIDTH)
        self.layers = nn.ModuleList(block() for _ in range(2))
        self.norm = nn.LayerNorm(WIDTH)


class Vlm(nn.Module):
    """Pixels [B, 3, 6, 2] become 3 tokens, which pass the layers with the words.

    A tied head scores the words.

    `around` runs a layer: plainly, or through checkpointing.
    """

    def __init__(self, block: type[Block] = Block) -> None:
        super().__init__()
        self.vision = nn.Sequential(nn.Conv2d(3, WIDTH, 2, stride=2), nn.Flatten(2))
        self.text = Text(block)
        self.head = nn.Linear(WIDTH, WORDS, bias=False)
        self.head.weight = self.text.words.weight
        self.around: Callable[..., Any] = lambda layer, *inputs: layer(*inputs)

    def forward(self, pixels: Tensor, ids: Tensor, mask: Tensor) -> Tensor:
        x = torch.cat([self.vision(pixels).mT, self.text.words(ids)], 1)
        for layer in self.text.layers:
            tuples = isinstance(getattr(layer, "_orig_mod", layer), TupleBlock)
            x = self.around(layer, (x, ~mask))[0] if tuples else self.around(layer, x, ~mask)
        return self.head(self.text.norm(x))


def make(block: type[Block] = Block, seed: int = 0, dtype: torch.dtype = torch.float64) -> Vlm:
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return Vlm(block).to(dtype).eval()


Batch = tuple[Tensor, Tensor, Tensor]


def batch(seed: int, size: int = 4, dtype: torch.dtype = torch.float64) -> Batch:
    """Pixels, words and a mask.

    The second row ends in two padding tokens, which occur in no question.
    """
    generator = torch.Generator().manual_seed(seed)
    ids = torch.randint(2, WORDS - 3, (size, TEXT), generator=generator)
    mask = torch.ones(size, PATCHES + TEXT, dtype=torch.bool)
    mask[1, -2:] = False
    return (
        torch.randn(size, 3, 2 * PATCHES, 2, generator=generator, dtype=dtype),
        ids.masked_fill(~mask[:, PATCHES:], 0),
        mask,
    )


def task_loss(model: nn.Module, seed: int) -> Tensor:
    """A loss that pulls the layers somewhere else."""
    pixels, ids, mask = batch(seed)
    pixels = pixels.to(next(model.parameters()).dtype)
    return (model(pixels, ids, mask).float() - 1).square().mean(-1)[mask].mean().to(pixels.dtype)


def measured(model: nn.Module, path: Path, **options: Any) -> Path:
    """The anchor of a model on three batches of questions."""
    options = {"layers": LAYERS, "parts": ALL_PARTS, "vision": "vision", "energy": 1.0} | options
    with Guard.measure(model, **options) as found:
        for seed in range(100, 103):
            pixels, ids, mask = batch(seed, dtype=next(model.parameters()).dtype)
            with found.watch(mask, IMAGE):
                model(pixels, ids, mask)
    found.save(path)
    return path


def anchors_by_method(folder: Path) -> dict[str, Path]:
    """The anchors that the guard's methods read, by method."""
    both = measured(make(), folder / "both.safetensors")
    model = make()
    with Guard.measure(model, parts=("curvature",), energy=1.0) as found:
        pixels, ids, mask = batch(100)
        with found.watch(mask, IMAGE):
            scores = model(pixels, ids, mask)
        found.answer(scores[:, -3])
    found.save(folder / "curvature.safetensors")
    return {"aegis": both, "nullspace": both, "kfac": folder / "curvature.safetensors"}


def guarded_steps(model: nn.Module, guard: Guard, steps: int = 3, **adam: Any) -> list[float]:
    """Train with the guard, one batch per step."""
    optimizer = torch.optim.AdamW(
        [p for p in model.parameters() if p.requires_grad], **({"lr": 1e-2} | adam)
    )
    losses = []
    for seed in range(steps):
        with guard.watch(batch(seed)[2], IMAGE):
            loss = task_loss(model, seed)
        guard.backward(loss)
        guard.step(optimizer)
        optimizer.zero_grad()
        losses.append(loss.item())
    return losses


def vector(model: nn.Module) -> Tensor:
    """All parameters as one."""
    return torch.cat([p.detach().flatten() for p in model.parameters()])


def compiling(test: Callable[..., None]) -> Callable[..., None]:
    """Mark a test that compiles: warnings of the compiler itself are not ours."""
    for message in ("The .grad attribute of a Tensor", "`torch.jit.script_method` is deprecated"):
        test = pytest.mark.filterwarnings(f"ignore:{message}")(test)
    return test


def through_checkpoint(reentrant: bool) -> Callable[..., Any]:
    """Run layers inside a checkpoint, together with their hooks."""
    return lambda layer, *inputs: checkpoint(layer, *inputs, use_reentrant=reentrant)
