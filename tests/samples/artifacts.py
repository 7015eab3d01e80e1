"""A small valid sample of every artifact kind, as the arguments of `artifacts.save`."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from torch import Tensor

from aegis_cli.common import artifacts

FINGERPRINT = "0123456789abcdef" * 4
Sample = dict[str, Any]


def anchor() -> Sample:
    names = [
        f"layers.{i}.{kind}.{part}"
        for i in range(2)
        for kind in ("image", "text")
        for part in ("mean", "var")
    ]
    moments = {name: torch.arange(4, dtype=torch.float64) for name in names}
    inputs = {
        "inputs.map.values": torch.tensor([3.0, 2.0, 1.0]).double(),
        "inputs.map.vectors": torch.eye(3)[:, :2].contiguous(),
        "inputs.norm.values": torch.ones(4, 2).double(),
        "inputs.norm.vectors": torch.eye(2).repeat(4, 1, 1),
        "inputs.table.values": torch.tensor([0.5, 0.0, 0.5]).double(),
    }
    tensors = {
        **moments,
        "count": torch.tensor([12, 5]),
        **inputs,
        "fisher.map.weight": torch.ones(2, 3),
    }
    return {"tensors": tensors, "fingerprint": FINGERPRINT, "seed": 3}


def demos() -> Sample:
    tensors = {
        "frames": torch.arange(5 * 64 * 64 * 3).remainder(251).to(torch.uint8).view(5, 64, 64, 3),
        "proprio": torch.linspace(-1, 1, 15).view(5, 3),
        "actions": torch.linspace(-1, 1, 10).view(5, 2),
        "episode_starts": torch.tensor([0, 2, 5]),
        "instruction": torch.tensor([1, 0]),
        "target_color": torch.tensor([0, 1]),
    }
    meta = {
        "task": "reach",
        "instructions": ["go to red", "go to blue"],
        "colors": ["red", "blue"],
        "control_hz": 12.5,
        "action_names": ["vx", "vy"],
        "proprio_names": ["x", "y", "z"],
    }
    return {"tensors": tensors, "meta": meta, "seed": 0}


def ledger() -> Sample:
    squares = {name: torch.ones(3, 2, dtype=torch.float64) for name in ("tt", "aa")}
    rest = {
        "ta": -squares["tt"],
        "w2": torch.ones(3, 1, dtype=torch.float64),
        "step": torch.tensor([1, 2, 5]),
    }
    meta = {"groups": ["embed", "layer 0"], "layers": ["0"], "method": "aegis"}
    return {"tensors": {**squares, **rest}, "meta": meta}


def model() -> Sample:
    generator = torch.Generator().manual_seed(0)
    return {
        "tensors": {
            "half": torch.randn(3, 5, generator=generator).bfloat16(),
            "flag": torch.tensor([True, False, True]),
            "step": torch.tensor(7),
            "none": torch.zeros(0, 4),
        }
    }


def experts() -> Sample:
    tensors = {f"map.experts.{n}.a": torch.arange(6.0).view(2, 3) for n in (0, 2)}
    tensors |= {f"map.experts.{n}.b": torch.ones(4, 2) for n in (0, 2)}
    return {
        "tensors": tensors,
        "fingerprint": FINGERPRINT,
        "meta": {"structure": {"map": {"experts": {"0": {}, "2": {}}}}},
    }


def routers() -> Sample:
    tensors = {
        "map.routers.0.experts": torch.tensor([0, 2]),
        "map.routers.0.scale": torch.tensor(1.5),
        "map.routers.0.read": torch.ones(2, 2),
        "map.routers.0.bias": torch.zeros(2),
        "map.routers.0.mass": torch.tensor([0.25, 0.75]).double(),
        "map.routers.0.load": torch.tensor([1.0, 0.0]).double(),
        "map.routers.1.experts": torch.tensor([2]),
        "map.routers.1.scale": torch.tensor(1.0),
        "map.routers.1.mass": torch.ones(1).double(),
        "map.routers.1.load": torch.ones(1).double(),
        "tasks.mean": torch.zeros(2, 5).double(),
        "tasks.directions": torch.eye(5)[:, :3].double().expand(2, 5, 3).clone(),
        "tasks.variances": torch.ones(2, 3).double(),
        "tasks.noise": torch.ones(2).double(),
        "tasks.threshold": torch.ones(2).double(),
    }
    return {"tensors": tensors, "fingerprint": FINGERPRINT}


def stream_task() -> Sample:
    tensors = {
        "images": torch.arange(5 * 4 * 4 * 3).remainder(251).to(torch.uint8).view(5, 4, 4, 3),
        "labels": torch.tensor([0, 1, 0, 1, 1]),
    }
    meta = {"name": "sizes", "classes": ["small", "large"], "templates": ["a {} thing"]}
    return {
        "tensors": tensors,
        "meta": meta | {"parts": {"train": 2, "validation": 1, "test": 2}},
        "seed": 0,
    }


SAMPLES: dict[str, Callable[[], Sample]] = {
    "anchor": anchor,
    "demos": demos,
    "ledger": ledger,
    "backbone": model,
    "expert": model,
    "training-state": model,
    "experts": experts,
    "routing": routers,
    "dual-encoder": model,
    "stream-task": stream_task,
    "policy": model,
}


def write(folder: Path, kind: str, **changes: Any) -> Path:
    """The kind's sample file, with some of `save`'s arguments replaced."""
    path = folder / f"{kind}.safetensors"
    artifacts.save(path, kind, **{**SAMPLES[kind](), **changes})
    return path


def forge(
    path: Path, change: Callable[[dict[str, Any]], None] = lambda header: None, **tensors: Tensor
) -> None:
    """Rewrite a file with another program: change its header's JSON and some tensors.

    The result has no digest, like files from before digests existed.
    """
    with safetensors.safe_open(path, "pt") as file:
        header = json.loads(file.metadata()["aegis"])
    del header["digest"]
    change(header)
    safetensors.torch.save_file(
        {**safetensors.torch.load_file(path), **tensors}, path, {"aegis": json.dumps(header)}
    )
