"""LeRobot datasets of noise, small enough for every test, and their files taken apart."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from aegis_cli.data.lerobot import dataset, rows, source, write
from aegis_cli.data.lerobot import frames as camera_frames
from aegis_cli.data.lerobot.write import Limits, NewEpisode, Spec

STATE, ACTION = ("x", "y", "z"), ("dx", "dy")
TEXTS = ("go to the red pad", "go to the blue pad", 'grüße "the" robot')
SPEC = Spec(10.0, STATE, ACTION, "arm")


@pytest.fixture
def frame_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Decoded frames of every test lie in a folder of its own."""
    folder = tmp_path_factory.mktemp("cache")
    monkeypatch.setenv("AEGIS_CACHE", str(folder))
    return folder


def episodes(
    count: int = 5,
    cameras: tuple[str, ...] = ("top",),
    size: tuple[int, int] = (16, 24),
    seed: int = 0,
    smooth: bool = False,
) -> list[NewEpisode]:
    """Episodes of 1 to 9 frames of noise; `smooth` frames have one colour, fit for video."""
    rng = np.random.default_rng(seed)

    def pictures(length: int) -> np.ndarray:
        if smooth:
            colors = rng.integers(0, 256, (length, 1, 1, 3), dtype=np.uint8)
            return np.broadcast_to(colors, (length, *size, 3)).copy()
        return rng.integers(0, 256, (length, *size, 3), dtype=np.uint8)

    def episode(number: int) -> NewEpisode:
        length = int(rng.integers(1, 10)) if number else 5
        state, actions = (
            rng.normal(size=(length, len(names))).astype(np.float32) for names in (STATE, ACTION)
        )
        return NewEpisode(
            {camera: pictures(length) for camera in cameras},
            state,
            actions,
            TEXTS[number % len(TEXTS)],
        )

    return [episode(number) for number in range(count)]


def save(
    folder: Path, made: list[NewEpisode] | None = None, limits: Limits = Limits(), **spec: Any
) -> Path:
    """Write a dataset with the sample's names; returns its folder."""
    write.write(
        folder, episodes() if made is None else made, dataclasses.replace(SPEC, **spec), limits
    )
    return folder


def joined(made: list[NewEpisode]) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """States and actions of all frames, and each frame's text."""
    texts = [e.instruction for e in made for _ in e.actions]
    return np.concatenate([e.state for e in made]), np.concatenate([e.actions for e in made]), texts


def frames(made: list[NewEpisode], camera: str = "top") -> np.ndarray:
    return np.concatenate([e.frames[camera] for e in made])


def read(folder: Path, camera: str | None = None, side: int | None = None) -> np.ndarray:
    """All frames of a camera, as training gets them."""
    found = dataset.load(folder)
    (key,) = found.cameras(camera)
    read = source.find(found)
    return camera_frames.load(
        read,
        rows.read_index(read),
        key,
        side,
        source.digests(read, [key])[0],
        1,
        lambda _: None,
    )


# --- taking files apart --------------------------------------------------------------------------


def data_files(folder: Path) -> list[Path]:
    return sorted((folder / "data").glob("*/*.parquet"))


def edit_info(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    path = folder / "meta/info.json"
    info = json.loads(path.read_text())
    change(info)
    path.write_text(json.dumps(info))


def edit_table(path: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    parquet.write_table(change(parquet.read_table(path)), path)


def replaced(table: pa.Table, name: str, values: pa.Array) -> pa.Table:
    return table.set_column(table.schema.names.index(name), name, values)
