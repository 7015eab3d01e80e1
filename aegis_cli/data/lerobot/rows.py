"""The numbers of a dataset's frames: which episode a row belongs to, and its vectors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from aegis_cli.common.errors import AegisError
from aegis_cli.data.lerobot import layout
from aegis_cli.data.lerobot.dataset import Dataset

_INDEX = ("episode_index", "frame_index", "timestamp", "task_index")


@dataclass(frozen=True)
class DataFile:
    """A file of `data/`, and which of the dataset's frames and episodes are in it."""

    path: Path
    first_frame: int
    frames: int
    first_episode: int
    lengths: tuple[int, ...]


@dataclass(frozen=True)
class Index:
    """What the rows say about all N frames.

    Attributes:
        timestamp: [N] float64, seconds from the episode's start.
        task: [N] int64, number of the instruction.
    """

    timestamp: np.ndarray
    task: np.ndarray


def data_files(dataset: Dataset) -> Iterator[DataFile]:
    """The files in the order of their frames."""
    frame = number = 0
    for path, group in groupby(dataset.episodes, lambda episode: episode.data):
        lengths = tuple(episode.length for episode in group)
        yield DataFile(dataset.folder / path, frame, sum(lengths), number, lengths)
        frame, number = frame + sum(lengths), number + len(lengths)


def read_index(dataset: Dataset) -> Index:
    """Times and tasks of all frames, after a check that every row is where the meta folder says.

    Raises:
        AegisError: a file that is missing or damaged, rows that are missing or out of place, a task
            without a text.
    """
    times, tasks = [], []
    for file in data_files(dataset):
        columns = zip(_INDEX, _read(file, _INDEX), strict=True)
        episode, frame, time, task = (_numbers(column, name, file.path) for name, column in columns)
        _check_rows(file, episode.astype(np.int64), frame.astype(np.int64))
        if ((task < 0) | (task >= len(dataset.tasks))).any():
            found = f"'{file.path}' has a task_index outside {layout.TASKS}"
            raise AegisError(found, f"0 to {len(dataset.tasks) - 1}", layout.AGAIN)
        times.append(time)
        tasks.append(task.astype(np.int64))
    return Index(np.concatenate(times), np.concatenate(tasks))


def read_vectors(dataset: Dataset, feature: str) -> np.ndarray:
    """One vector feature of all frames, [N, D] float32.

    Raises:
        AegisError: a file that is missing or damaged, vectors of another size, or numbers that are
            not finite.
    """
    size = dataset.size(feature)
    parts = []
    for file in data_files(dataset):
        (column,) = _read(file, (feature,))
        parts.append(_matrix(column, size, feature, file.path))
    return np.concatenate(parts)


def _read(file: DataFile, names: Sequence[str]) -> list[Any]:
    with layout.reading_parquet(file.path):
        found = layout.open_parquet(file.path)
        if missing := [name for name in names if name not in found.schema_arrow.names]:
            what = f"no column '{missing[0]}' in '{file.path}'"
            raise AegisError(what, f"every feature that {layout.INFO} lists", layout.AGAIN)
        if found.metadata.num_rows != file.frames:
            episodes = f"{len(file.lengths)} episodes from number {file.first_episode}"
            raise AegisError(
                f"{found.metadata.num_rows} rows in '{file.path}'",
                f"the {file.frames} rows of its {episodes}",
                layout.AGAIN,
            )
        table = found.read(columns=list(names))
    return [table.column(name) for name in names]


def _numbers(column: Any, name: str, path: Path) -> np.ndarray:
    """A column's numbers [n] float64, which is exact for any index."""
    with layout.damaged(path):
        if column.null_count:
            raise ValueError(f"'{name}' has {column.null_count} empty cells")
        numbers = column.to_numpy().astype(np.float64)
        if not np.isfinite(numbers).all():
            raise ValueError(f"NaN or infinite values in '{name}'")
        return numbers


def _check_rows(file: DataFile, episode: np.ndarray, frame: np.ndarray) -> None:
    numbers = file.first_episode + np.repeat(np.arange(len(file.lengths)), file.lengths)
    frames = np.concatenate([np.arange(length) for length in file.lengths])
    wrong = np.flatnonzero((episode != numbers) | (frame != frames))
    if len(wrong):
        row = int(wrong[0])
        raise AegisError(
            f"row {row} of '{file.path}' is frame {frame[row]} of episode {episode[row]}",
            f"frame {frames[row]} of episode {numbers[row]}, as the meta folder says",
            layout.AGAIN,
        )


def _matrix(column: Any, size: int, feature: str, path: Path) -> np.ndarray:
    with layout.damaged(path):
        if column.null_count:
            raise ValueError(f"'{feature}' has {column.null_count} empty cells")
        values = _flat(column.combine_chunks(), size, feature, path)
        rows = np.asarray(values, np.float32).reshape(-1, size)
    bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if len(bad):
        raise AegisError(
            f"'{feature}' in '{path}' has NaN or infinite values in {len(bad)} rows, the first "
            f"in row {bad[0]}",
            "finite numbers",
            "leave those episodes out of the dataset, or record them again",
        )
    return rows


def _flat(array: Any, size: int, feature: str, path: Path) -> np.ndarray:
    """The numbers of a column of scalars or lists, row after row."""
    import pyarrow as pa

    kind = array.type
    if pa.types.is_fixed_size_list(kind):
        sizes = np.array([kind.list_size])
    elif pa.types.is_list(kind) or pa.types.is_large_list(kind):
        sizes = np.unique(array.value_lengths().to_numpy())
    else:
        sizes = np.array([1])
    if wrong := [int(n) for n in sizes if n != size]:
        raise AegisError(
            f"'{feature}' in '{path}' has {wrong[0]} numbers per row",
            f"{size}, as {layout.INFO} and the files before say",
            "give a dataset of one robot: features keep their size",
        )
    flat = array.flatten() if pa.types.is_nested(kind) else array
    return flat.to_numpy(zero_copy_only=False)
