"""The meta folder of format v3.0: parquet tables of tasks and of episodes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from aegis_cli.common.errors import AegisError
from aegis_cli.data.lerobot import layout
from aegis_cli.data.lerobot.layout import Clip, EpisodeIndex, Info

TASKS = Path("meta/tasks.parquet")
_EPISODES = Path("meta/episodes")


def table_files(folder: Path) -> list[Path]:
    """The meta folder's files of tasks and episodes."""
    return [folder / TASKS, *_episode_files(folder)]


def read_tasks(folder: Path) -> tuple[str, ...]:
    """The texts of the tasks, by their numbers.

    pandas writes the texts as the table's index: named `task`, or unnamed in older files.
    """
    path = folder / TASKS
    with layout.reading_parquet(path):
        columns = layout.open_parquet(path).read().to_pydict()
    with layout.damaged(path):
        texts = columns["task"] if "task" in columns else columns["__index_level_0__"]
        return layout.texts_of(layout.by_number(zip(columns["task_index"], texts, strict=True)))


def read_episodes(folder: Path, info: Info) -> tuple[EpisodeIndex, ...]:
    """The location of each episode, in order of their numbers.

    Raises:
        AegisError: a file is missing or damaged, counts do not agree, or an episode does not begin
            where the previous one ends.
    """
    where, paths = folder / _EPISODES, _episode_files(folder)
    if not paths:
        raise AegisError(
            f"no parquet file in '{where}'",
            "a row per episode there, which LeRobot writes when a recording ends",
            f"{layout.AGAIN}; if the recording broke off, record it again",
        )
    rows: list[dict[str, Any]] = []
    for path in paths:
        with layout.reading_parquet(path):
            file = layout.open_parquet(path)
            # The episodes' statistics are most of the file, and are not needed here.
            names = [name for name in file.schema_arrow.names if not name.startswith("stats/")]
            rows += file.read(columns=names).to_pylist()
    with layout.damaged(where):
        rows.sort(key=lambda row: int(row["episode_index"]))
        episodes = layout.by_number((row["episode_index"], _episode(row, info)) for row in rows)
        starts = [int(row["dataset_from_index"]) for row in rows]
    layout.check_episodes(where, info, episodes)
    frames = 0
    for (number, episode), start in zip(episodes.items(), starts, strict=True):
        if start != frames:
            found = f"'{where}': episode {number} begins at frame {start}"
            raise AegisError(found, f"frame {frames}, where the one before ends", layout.AGAIN)
        frames += episode.length
    return tuple(episodes.values())


def _episode_files(folder: Path) -> list[Path]:
    """The tables of episodes, in the order of their names."""
    return sorted((folder / _EPISODES).glob("*/*.parquet"))


def _episode(row: Mapping[str, Any], info: Info) -> EpisodeIndex:
    length = int(row["length"])
    if length < 1 or int(row["dataset_to_index"]) - int(row["dataset_from_index"]) != length:
        span = f"{row['dataset_from_index']} to {row['dataset_to_index']}"
        raise ValueError(f"episode {row['episode_index']} has {length} frames from {span}")
    place = layout.file_place(int(row["data/chunk_index"]), int(row["data/file_index"]))
    clips = {key: _clip(row, key, info) for key in info.videos}
    return EpisodeIndex(length, layout.data_file(info, place), clips, layout.tasks_of(row))


def _clip(row: Mapping[str, Any], key: str, info: Info) -> Clip:
    chunk, file = int(row[f"videos/{key}/chunk_index"]), int(row[f"videos/{key}/file_index"])
    path = layout.video_file(info, key, layout.file_place(chunk, file))
    start_s = float(row[f"videos/{key}/from_timestamp"])
    if not math.isfinite(start_s):
        raise ValueError(f"a video of episode {row['episode_index']} begins at {start_s} s")
    # The end is optional (`Clip`): a dataset without one, or with a wrong one, can be read.
    end_s = row.get(f"videos/{key}/to_timestamp")
    told = isinstance(end_s, int | float) and math.isfinite(end_s) and end_s > start_s
    return Clip(path, start_s, float(end_s) if told else math.inf)
