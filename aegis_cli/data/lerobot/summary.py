"""A summary of a LeRobot dataset, and a contact sheet."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from aegis_cli.common import media
from aegis_cli.common.errors import AegisError
from aegis_cli.data.lerobot import dataset, frames, layout, rows, source
from aegis_cli.data.lerobot.dataset import Dataset


@dataclass(frozen=True)
class FeatureInfo:
    """One feature; `components` has the names of its numbers, if the dataset has any.

    `statistics` has one number per component, or per channel of a camera in [0, 1]; it is empty if
    the dataset has none, and for an array, which has no components.
    """

    name: str
    dtype: str
    shape: tuple[int, ...]
    components: tuple[str, ...]
    statistics: dict[str, tuple[float, ...]]


def dataset_facts(found: Dataset) -> dict[str, Any]:
    """The facts that `aegis inspect` shows first."""
    info, lengths = found.info, [episode.length for episode in found.episodes]
    return {
        "version": info.version,
        "robot_type": info.robot_type,
        "task": info.task,
        "episodes": info.episodes,
        "frames": info.frames,
        "fps": info.fps,
        "duration_s": info.frames / info.fps,
        "frames_an_episode": {"least": min(lengths, default=0), "most": max(lengths, default=0)},
        "cameras": list(info.cameras),
        "tasks": list(found.tasks),
        "statistics": found.stats is not None,
    }


def dataset_features(found: Dataset) -> tuple[FeatureInfo, ...]:
    """Every feature with its statistics."""
    stats = found.stats or {}
    features = []
    for name, own in found.info.features.items():
        # For an array LeRobot has statistics of every single number.
        figures = _figures(found, stats.get(name, {})) if own.components else {}
        features.append(FeatureInfo(name, own.dtype, own.shape, own.components, figures))
    return tuple(features)


def _figures(found: Dataset, stats: Mapping[str, Any]) -> dict[str, tuple[float, ...]]:
    """Each statistic's numbers, flattened: a camera's have the shape [3, 1, 1]."""
    figures = {}
    with layout.damaged(found.folder / layout.STATS):
        for name, value in stats.items():
            figures[name] = tuple(np.asarray(value, np.float64).ravel().tolist())
    return figures


def on_sheet(found: Dataset) -> list[int]:
    """The numbers of the episodes that `save_sheet` shows, spread evenly over the dataset."""
    spread = np.linspace(0, len(found.episodes) - 1, media.SHEET_EPISODES)
    # If there are fewer episodes than places, some are found several times.
    return np.unique(spread.round().astype(int)).tolist()


def save_sheet(folder: Path, out: Path) -> None:
    """Write a PNG with the first and last frame of some episodes, from every camera.

    Other episodes are not read.

    Raises:
        AegisError: the dataset is invalid or has no camera, or the path cannot be written.
    """
    media.check_sheet(out)
    found = dataset.load(folder)
    if not found.info.cameras:
        raise AegisError(f"no camera in '{folder}'", "a dataset with pictures", "leave out --plot")
    if not found.episodes:
        raise AegisError(f"no episode in '{folder}'", "a recorded one", "leave out --plot")
    shown = on_sheet(found)
    read = source.find(found, shown)
    index = rows.read_index(read)
    starts = np.cumsum([0, *(episode.length for episode in found.episodes)])
    spans = [(int(starts[e]), int(starts[e + 1]) - 1) for e in shown]  # first and last frame
    # A set, because an episode of one frame starts and ends with it; `pick` needs them sorted.
    ends = sorted({*itertools.chain(*spans)})
    pictures = {}
    for camera in found.info.cameras:
        picked = frames.pick(read, index, camera, ends)
        pictures[camera] = dict(zip(ends, picked, strict=True))
    entries = []
    for first, last in spans:
        caption = f"{found.tasks[index.task[first]]}  ({last - first + 1} steps)"
        shots = [of_camera[n] for of_camera in pictures.values() for n in (first, last)]
        entries.append((caption, shots))
    media.save_sheet(out, entries)
