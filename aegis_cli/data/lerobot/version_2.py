"""The meta folder of formats v2.0 and v2.1: JSON lines. Each episode has files of its own."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from aegis_cli.common import files
from aegis_cli.data.lerobot import layout, statistics
from aegis_cli.data.lerobot.layout import Clip, EpisodeIndex, Info

TASKS, EPISODES = Path("meta/tasks.jsonl"), Path("meta/episodes.jsonl")
_STATS = Path("meta/episodes_stats.jsonl")  # of v2.1; v2.0 has the file of v3.0


def table_files(folder: Path) -> list[Path]:
    """The meta folder's files of tasks and episodes."""
    return [folder / TASKS, folder / EPISODES]


def read_tasks(folder: Path) -> tuple[str, ...]:
    """The texts of the tasks, by their numbers.

    Raises:
        AegisError: a file that is missing or damaged.
    """
    rows = _lines(folder / TASKS)
    with layout.damaged(folder / TASKS):
        return layout.texts_of(layout.by_number((row["task_index"], row["task"]) for row in rows))


def read_episodes(folder: Path, info: Info) -> tuple[EpisodeIndex, ...]:
    """Where each episode is, by its number.

    Raises:
        AegisError: a file that is missing or damaged, or counts that do not agree.
    """
    rows = _lines(folder / EPISODES)
    with layout.damaged(folder / EPISODES):
        episodes = layout.by_number((row["episode_index"], _episode(row, info)) for row in rows)
    layout.check_episodes(folder / EPISODES, info, episodes)
    return tuple(episodes.values())


def read_stats(folder: Path) -> dict[str, dict[str, Any]] | None:
    """The statistics of each feature, joined from those of the episodes; None where there are none.

    Raises:
        AegisError: a file that is damaged.
    """
    if not (folder / _STATS).is_file():
        return layout.read_stats(folder)
    rows = _lines(folder / _STATS)
    with layout.damaged(folder / _STATS):
        parts: dict[str, list[statistics.Statistics]] = {}
        for row in rows:
            for feature, figures in row["stats"].items():
                arrays = {name: np.asarray(value, np.float64) for name, value in figures.items()}
                parts.setdefault(feature, []).append(arrays)
        return {feature: dict(statistics.merge(found)) for feature, found in parts.items()}


def _episode(row: Mapping[str, Any], info: Info) -> EpisodeIndex:
    length = int(row["length"])
    if length < 1:
        raise ValueError(f"episode {row['episode_index']} has {length} frames")
    place = layout.episode_place(info, int(row["episode_index"]))
    clips = {key: Clip(layout.video_file(info, key, place), 0.0) for key in info.videos}
    return EpisodeIndex(length, layout.data_file(info, place), clips)


def _lines(path: Path) -> list[dict[str, Any]]:
    """The objects of a file that has one a line.

    Raises:
        AegisError: a file that is missing, or a line that is no JSON.
    """
    with files.reading(path, layout.AGAIN):
        content = path.read_bytes()
    with layout.damaged(path):
        text = content.decode()
        return [files.parse_json(line) for line in text.splitlines() if line.strip()]
