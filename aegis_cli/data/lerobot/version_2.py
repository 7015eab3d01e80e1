"""The meta folder of formats v2.0 and v2.1: JSON lines. Each episode has its own files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from aegis_cli.common import files
from aegis_cli.data.lerobot import layout, statistics
from aegis_cli.data.lerobot.layout import Clip, EpisodeIndex, Info

TASKS, EPISODES = Path("meta/tasks.jsonl"), Path("meta/episodes.jsonl")
_STATS = Path("meta/episodes_stats.jsonl")  # in v2.1; v2.0 has the same file as v3.0


def table_files(folder: Path) -> list[Path]:
    """The meta folder's files of tasks and episodes."""
    return [folder / TASKS, folder / EPISODES]


def read_tasks(folder: Path) -> tuple[str, ...]:
    """The texts of the tasks, by their numbers.

    Raises:
        AegisError: a file is missing or damaged.
    """
    with layout.damaged(folder / TASKS):
        rows = ((row["task_index"], row["task"]) for row in _lines(folder / TASKS))
        return layout.texts_of(layout.by_number(rows))


def read_episodes(folder: Path, info: Info) -> tuple[EpisodeIndex, ...]:
    """The location of each episode, in order of their numbers.

    Raises:
        AegisError: a file is missing or damaged, or counts do not agree.
    """
    with layout.damaged(folder / EPISODES):
        rows = ((row["episode_index"], _episode(row, info)) for row in _lines(folder / EPISODES))
        episodes = layout.by_number(rows)
    layout.check_episodes(folder / EPISODES, info, episodes)
    return tuple(episodes.values())


def read_stats(folder: Path) -> dict[str, dict[str, Any]] | None:
    """The statistics of each feature, merged from those of the episodes; None if there are none.

    Raises:
        AegisError: a file is damaged.
    """
    if not (folder / _STATS).is_file():
        return layout.read_stats(folder)
    joined: dict[str, statistics.Statistics] = {}
    with layout.damaged(folder / _STATS):
        for row in _lines(folder / _STATS):
            for feature, figures in row["stats"].items():
                # Episode by episode, so that they are not all held in memory.
                own = {name: np.asarray(value, np.float64) for name, value in figures.items()}
                if not np.all(own["count"] > 0):  # also refuses NaN, which `null` becomes
                    where = f"'{feature}' in episode {row.get('episode_index')}"
                    raise ValueError(f"the count of {where} is {figures['count']}, not above 0")
                known = [joined[feature], own] if feature in joined else [own]
                joined[feature] = statistics.merge(known)
    return dict(joined)


def _episode(row: Mapping[str, Any], info: Info) -> EpisodeIndex:
    length = int(row["length"])
    if length < 1:
        raise ValueError(f"episode {row['episode_index']} has {length} frames")
    place = layout.episode_place(info, int(row["episode_index"]))
    # Each video holds one episode only, which ends with its file.
    clips = {key: Clip(layout.video_file(info, key, place), 0.0) for key in info.videos}
    return EpisodeIndex(length, layout.data_file(info, place), clips, layout.tasks_of(row))


def _lines(path: Path) -> Iterator[dict[str, Any]]:
    """The objects of a file with one JSON object per line.

    Raises:
        AegisError: the file is missing.
        ValueError: a line is not JSON.
    """
    # Split only at \n: an instruction may contain other line separators.
    with files.reading(path, layout.AGAIN), open(path, "rb") as file:
        for line in file:
            if line.strip():
                yield files.parse_json(line)
