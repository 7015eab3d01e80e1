"""The embedded stream's tasks: pictures made from a seed and cached, one artifact per task."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from aegis_cli.common import artifacts, files
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Progress
from aegis_cli.data.streams import masks
from aegis_cli.data.streams.contract import Part, StreamTask
from aegis_cli.data.streams.names import SIZE, TASKS

EDITION = 1  # cached pictures of another edition are made again
PARTS = ("train", "validation", "test")
COUNTS = {"train": 800, "validation": 200, "test": 500}
REAL = 1797  # scikit-learn's digits; training gets those left by validation and test
REPORT_EVERY = 250
Painter = Callable[[int, np.random.Generator], np.ndarray]


def file(cache: Path, name: str) -> Path:
    """The file in which a task's pictures are cached."""
    return Path(cache) / f"{name}.safetensors"


def task(name: str, image_size: int, cache: Path, on_event: OnEvent) -> StreamTask:
    """One of `names.TASKS`, read from `cache`, or made and stored there."""
    path = file(cache, name)
    if not _current(path, name):
        masks.need_freetype()
        images, labels = make(name, on_event)
        files.make_folder(path.parent)
        save(path, name, images, labels)
    return read(path, image_size)


def _current(path: Path, name: str) -> bool:
    """Whether the file is there and holds what this version would make."""
    if not path.exists():
        return False
    try:
        # Words are included: a task whose classes have other names is made again.
        return artifacts.load(path, "stream-task").header.meta == meta(name)
    except AegisError as error:
        raise AegisError(
            error.found, error.expected, f"rm '{path}', and it is made again"
        ) from error


def meta(name: str) -> dict[str, object]:
    """Everything that determines a task's pictures and words."""
    words, counts = TASKS[name], COUNTS
    # The number of real digits is limited.
    if name.startswith("digits"):
        counts = COUNTS | {"train": REAL - COUNTS["validation"] - COUNTS["test"]}
    return {
        "name": name,
        "classes": list(words.classes),
        "templates": list(words.templates),
        "parts": {part: counts[part] for part in PARTS},
        "edition": EDITION,
    }


def save(path: Path, name: str, images: np.ndarray, labels: np.ndarray) -> None:
    """Write the pictures [N, S, S, 3] and labels [N] of all parts, concatenated."""
    tensors = {"images": torch.from_numpy(images), "labels": torch.from_numpy(labels)}
    artifacts.save(
        path,
        "stream-task",
        tensors,
        seed=0,
        units={"images": "grey level", "labels": "class"},
        meta=meta(name),
    )


def read(path: Path, image_size: int) -> StreamTask:
    """The task in a file; its pictures stay memory-mapped and are resized on access.

    Raises:
        AegisError: the file is missing or damaged.
    """
    artifact = artifacts.load(path, "stream-task")
    meta, tensors = artifact.header.meta, artifact.tensors
    parts: dict[str, Part] = {}
    start = 0
    for name in PARTS:
        rows = slice(start, start + meta["parts"][name])  # as concatenated by `save`
        parts[name] = _part(tensors["images"][rows], tensors["labels"][rows], image_size)
        start = rows.stop
    return StreamTask(meta["name"], tuple(meta["classes"]), tuple(meta["templates"]), **parts)


def _part(images: Tensor, labels: Tensor, image_size: int) -> Part:
    # The labels are copied, since they are small and read often; the images stay in the file.
    return Part(labels.clone(), lambda rows: resized(images[rows], image_size))


def resized(images: Tensor, size: int) -> Tensor:
    """[B, S, S, 3] uint8 -> [B, size, size, 3] uint8, bilinear."""
    if images.shape[1] == size:
        return images
    channels_first = images.permute(0, 3, 1, 2).float()
    scaled = F.interpolate(
        channels_first, (size, size), mode="bilinear", antialias=True, align_corners=False
    )
    return scaled.round().clamp(0, 255).to(torch.uint8).permute(0, 2, 3, 1).contiguous()


# --- making them ----------------------------------------------------------------------------------


def make(name: str, on_event: OnEvent) -> tuple[np.ndarray, np.ndarray]:
    """All parts' pictures [N, S, S, 3] uint8 and labels [N] int64; the same in every call."""
    if name.startswith("digits"):
        return _real(name)
    paint, count = _painter(name), sum(COUNTS.values())
    seed = zlib.crc32(name.encode())  # Python's own hash of a text differs between processes
    labels = _balanced(name, seed)
    images = np.empty((count, SIZE, SIZE, 3), np.uint8)
    for i in range(count):
        # One generator per picture: no two parts share a draw.
        images[i] = paint(int(labels[i]), np.random.default_rng([EDITION, seed, i]))
        if (i + 1) % REPORT_EVERY == 0:
            on_event(Progress(f"stream {name}", i + 1, count, "images"))
    return images, labels


def _balanced(name: str, seed: int) -> np.ndarray:
    """Labels of all parts; in each part, class counts differ by at most one."""
    classes = len(TASKS[name].classes)
    rng = np.random.default_rng([EDITION, seed])
    shuffled = [rng.permutation(np.arange(COUNTS[part]) % classes) for part in PARTS]
    return np.concatenate(shuffled).astype(np.int64)


def _real(name: str) -> tuple[np.ndarray, np.ndarray]:
    """The real digits in a fixed shuffled order; the variants' parts hold the same digits."""
    from aegis_cli.data.streams import scanned

    images, labels = scanned.digits()
    order = np.random.default_rng(EDITION).permutation(len(images))
    images, labels = images[order], labels[order]
    return (255 - images if name == "digits-inverted" else images), labels


def _painter(name: str) -> Painter:
    """The painter of a task; imported here, since only some need OpenGL."""
    if name in ("colors", "places", "targets"):
        from aegis_cli.data.streams import rendered

        return {
            "colors": rendered.lamplit_solid,
            "places": rendered.pad_place,
            "targets": rendered.night_target,
        }[name]
    if name == "domains":
        from aegis_cli.data.streams import robots

        return robots.thermal_domain
    from aegis_cli.data.streams import drawn

    return {
        "counts": drawn.mixed_count,
        "directions": drawn.dart_direction,
        "letters": drawn.scratched_letter,
        "shapes": drawn.chalk_shape,
        "textures": drawn.worn_texture,
    }[name]
