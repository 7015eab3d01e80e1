"""The numbers of a dataset's frames: their times, their instructions, and their vectors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from aegis_cli.common.errors import AegisError
from aegis_cli.data.episodes import as_text
from aegis_cli.data.lerobot import layout
from aegis_cli.data.lerobot.source import CHOOSING, WITHOUT, DataFile, Source, column, numbers

_RATE_TOLERANCE = 0.1  # the share of 1 / fps by which the median step may differ from it


@dataclass(frozen=True)
class Index:
    """Times and tasks of all N frames of a dataset; 0 for frames that are not read.

    Attributes:
        timestamp: [N] float64, seconds from the episode's start.
        task: [N] int64, number of the instruction.
    """

    timestamp: np.ndarray
    task: np.ndarray


def read_index(source: Source) -> Index:
    """Times and tasks of the frames, after a check that the frames of an episode are in order.

    Raises:
        AegisError: a file is missing or damaged, rows are out of order, a task has no text, or
            times have another rate than the dataset's.
    """
    frames, texts = source.dataset.info.frames, len(source.dataset.tasks)
    index = Index(np.zeros(frames), np.zeros(frames, np.int64))
    steps = [np.zeros(0)]
    for file in source.data:
        time = _numbers(file, "timestamp")
        frame = _numbers(file, "frame_index")
        task = _numbers(file, "task_index")
        _check_order(source, file, frame)
        if ((task < 0) | (task >= texts)).any():
            tasks, *_ = source.dataset.table_files
            found = f"'{file.path}' has a task_index that '{tasks}' lacks"
            known = f"0 to {texts - 1}" if texts else "a table with the tasks' texts"
            raise AegisError(found, known, layout.AGAIN)
        steps.append(np.diff(time)[frame[1:] > 0])  # steps within an episode
        _put(index.timestamp, file, time)
        _put(index.task, file, task.astype(np.int64))
    _check_rate(source, np.concatenate(steps))
    return index


def read_vectors(source: Source, feature: str) -> np.ndarray:
    """One vector feature of all frames, [N, D] float32; 0 for frames that are not read.

    Raises:
        AegisError: a file is missing or damaged, vectors have another size, or numbers are not
            finite.
    """
    size, feature = source.dataset.size(feature), source.dataset.own(feature)
    vectors = np.zeros((source.dataset.info.frames, size), np.float32)
    # All files are read first, so that the error can name every bad episode.
    bad = list[tuple[DataFile, np.ndarray]]()
    for file in source.data:
        rows = _matrix(_read(file, feature), size, feature, file.path)
        places = np.flatnonzero(~np.isfinite(rows).all(axis=1))
        if len(places):
            bad.append((file, places))
        _put(vectors, file, rows)
    if bad:
        raise _not_finite(source, feature, bad)
    return vectors


def _not_finite(
    source: Source, feature: str, bad: Sequence[tuple[DataFile, np.ndarray]]
) -> AegisError:
    """The error for values that are not finite; it lists all episodes that have any.

    Args:
        bad: files, each with the indices of such rows among those that are read.
    """
    episodes = set[int]()
    for file, places in bad:
        episodes |= _episodes_at(source, file, places)
    file, places = bad[0]
    count = sum(len(places) for _, places in bad)
    where = f"row {int(_rows_of(file)[places[0]])} of '{file.path}'"
    sound = [number for number in source.episodes if number not in episodes]
    alone = f"take only episodes {as_text(sound)}" if sound else "take other episodes"
    return AegisError(
        f"'{feature}' of '{source.dataset.folder}' has NaN or infinite values in {count} rows of "
        f"episodes {as_text(sorted(episodes))}, the first in {where}",
        "finite numbers",
        f"{alone} ({CHOOSING}), or record these again",
    )


def _put(target: np.ndarray, file: DataFile, values: np.ndarray) -> None:
    """Write the values of a file's rows to the indices of their frames."""
    done = 0  # values written so far
    for rows in file.rows:
        places = slice(rows.first_frame, rows.first_frame + rows.count)
        target[places] = values[done : done + rows.count]
        done += rows.count


def _rows_of(file: DataFile) -> np.ndarray:
    """The numbers [n] int64 of the rows that are read."""
    return np.concatenate([np.arange(rows.first, rows.first + rows.count) for rows in file.rows])


def _episodes_at(source: Source, file: DataFile, places: np.ndarray) -> set[int]:
    """The episodes of a file's rows, given by their indices [n] among those that are read."""
    ends = np.cumsum([source.dataset.episodes[number].length for number in file.episodes])
    # "right", since the end of one episode is the first index of the next.
    within = np.searchsorted(ends, places, side="right")
    return {file.episodes[i] for i in np.unique(within)}


def _read(file: DataFile, name: str) -> Any:
    """The rows of a column that are read."""
    with layout.reading_parquet(file.path):
        cells = column(layout.open_parquet(file.path), file.path, name)
    if len(file.rows) == 1:  # a slice is no copy
        return cells.slice(file.rows[0].first, file.rows[0].count)
    return cells.take(_rows_of(file))


def _numbers(file: DataFile, name: str) -> np.ndarray:
    return numbers(_read(file, name), name, file.path)


def _check_order(source: Source, file: DataFile, frame: np.ndarray) -> None:
    """Raise AegisError unless the rows of each episode are its frames 0, 1, 2, ... in order."""
    lengths = [source.dataset.episodes[number].length for number in file.episodes]
    wanted = np.concatenate([np.arange(length) for length in lengths])
    wrong = np.flatnonzero(frame != wanted)
    if len(wrong):
        place = int(wrong[0])
        row = int(_rows_of(file)[place])
        (episode,) = _episodes_at(source, file, wrong[:1])
        raise AegisError(
            f"row {row} of '{file.path}' is frame {int(frame[place])} of episode {episode}",
            f"frame {wanted[place]} of episode {episode}",
            WITHOUT,
        )


def _check_rate(source: Source, steps: np.ndarray) -> None:
    """Raise AegisError if the median step between frames, in seconds, does not match `fps`.

    LeRobot refuses any step that is off by 0.1 ms, and so also a recording with a gap.
    """
    if not len(steps):
        return
    # The median, because single gaps do not change the rate.
    fps, step = source.dataset.info.fps, float(np.median(steps))
    if abs(step - 1 / fps) > _RATE_TOLERANCE / fps:
        folder = source.dataset.folder
        raise AegisError(
            f"frames of '{folder}' are {1000 * step:.4g} ms apart, by their timestamps",
            f"{1000 / fps:.4g} ms, since {layout.INFO} says fps {fps:g}",
            f"set fps in {folder / layout.INFO} to the rate at which the robot was controlled"
            + (f", here {1 / step:.4g}" if step > 0 else "")
            + ", or correct the timestamps",
        )


def _matrix(cells: Any, size: int, feature: str, path: Path) -> np.ndarray:
    with layout.damaged(path):
        if cells.null_count:
            raise ValueError(f"'{feature}' has {cells.null_count} empty cells")
        values = _flat(cells.combine_chunks(), size, feature, path)
        return np.asarray(values, np.float32).reshape(-1, size)


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
    # Not `.values`, which also has what lies before and after a slice.
    flat = array.flatten() if pa.types.is_nested(kind) else array
    return flat.to_numpy(zero_copy_only=False)  # booleans are bits, and have to be copied
