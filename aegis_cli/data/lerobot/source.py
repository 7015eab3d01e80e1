"""What is read of a dataset: the episodes, the files that hold them, and their digest.

The meta folder of v3.0 also names the file of each episode's rows. It is not used: before LeRobot
0.5.0, the converter from v2.1 named the previous file for the first episode of every file, and many
datasets on the hub were converted with it. A file's own rows show which episodes it holds, and
LeRobot itself reads all existing files.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from aegis_cli.common import files, kept_digests
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, ignore
from aegis_cli.data.lerobot import layout
from aegis_cli.data.lerobot.dataset import Dataset

CHOOSING = "demos.only, --only of aegis anchor, or --episodes of aegis evaluate"
WITHOUT = f"get the dataset again, or leave those episodes out ({CHOOSING})"


@dataclass(frozen=True)
class Rows:
    """Consecutive rows of a data file, and the dataset's frames that they hold.

    Attributes:
        first: number of the first row in its file.
        first_frame: number of that row's frame in the dataset.
        count: number of rows.
    """

    first: int
    first_frame: int
    count: int


@dataclass(frozen=True)
class DataFile:
    """A file of `data/` that holds episodes to be read.

    Attributes:
        episodes: their numbers, in the order of its rows.
        rows: their rows; those of consecutive episodes are joined.
    """

    path: Path
    episodes: tuple[int, ...]
    rows: tuple[Rows, ...]


@dataclass(frozen=True)
class Source:
    """Some or all of a dataset's episodes, and the data files that hold them.

    Frames and episodes keep their numbers in the whole dataset.

    Attributes:
        episodes: numbers of the episodes that are read, in ascending order.
        data: the files, in the order of their first episodes.
    """

    dataset: Dataset
    episodes: tuple[int, ...]
    data: tuple[DataFile, ...]

    @cached_property
    def frames(self) -> int:
        """The number of frames that are read."""
        return sum(self.dataset.episodes[number].length for number in self.episodes)


def find(dataset: Dataset, episodes: Sequence[int] | None = None) -> Source:
    """Find the rows of these episodes, or of all for None.

    Files that hold none of them may be missing.

    Raises:
        AegisError: a file is missing or damaged, or its rows contradict the meta folder.
    """
    wanted = range(len(dataset.episodes)) if episodes is None else sorted(episodes)
    # [E + 1], for the whole dataset: frames keep their numbers, whatever is read.
    starts = np.cumsum([0, *(episode.length for episode in dataset.episodes)])
    asked, seen = set(wanted), dict[int, Path]()
    found = []
    for path in _data_files(dataset, episodes):
        file = _file(dataset, path, asked, starts)
        for number in file.episodes:
            if number in seen:
                raise AegisError(
                    f"episode {number} in '{path}' and in '{seen[number]}'",
                    "the rows of an episode in one file",
                    layout.AGAIN,
                )
            seen[number] = path
        if file.episodes:
            found.append(file)
    for number in wanted:
        if number not in seen:
            raise _missing(dataset, number)
    # The files need not be in the order of their episodes.
    found.sort(key=lambda file: file.rows[0].first_frame)
    return Source(dataset, tuple(wanted), tuple(found))


def _data_files(dataset: Dataset, episodes: Sequence[int] | None) -> list[Path]:
    """The files that may hold these episodes; files of single episodes are known by name."""
    if episodes is None or not dataset.info.has_episode_files:
        return layout.data_files(dataset.info, dataset.folder)
    own = {dataset.folder / dataset.episodes[number].data for number in episodes}
    return sorted(path for path in own if path.exists())


def _file(dataset: Dataset, path: Path, asked: set[int], starts: np.ndarray) -> DataFile:
    """The episodes in a file that are in `asked`."""
    episode_of = _episode_of_rows(path)
    changes = np.flatnonzero(np.diff(episode_of)) + 1
    ends = [*changes.tolist(), len(episode_of)]  # of each run of rows of one episode
    numbers, rows, first = list[int](), list[Rows](), 0
    for end in ends if len(episode_of) else []:  # a file may be empty
        number = int(episode_of[first])
        if number in asked:
            _check_length(dataset, path, number, end - first)
            numbers.append(number)
            rows.append(Rows(first, int(starts[number]), end - first))
        elif not 0 <= number < len(dataset.episodes):
            raise AegisError(
                f"row {first} of '{path}' is of episode {number}",
                f"0 to {len(dataset.episodes) - 1}, as the meta folder says",
                layout.AGAIN,
            )
        first = end
    return DataFile(path, tuple(numbers), _together(rows))


def _episode_of_rows(path: Path) -> np.ndarray:
    """The episode of each row [n] int64."""
    name = "episode_index"
    with layout.reading_parquet(path):
        cells = column(layout.open_parquet(path), path, name)
    return numbers(cells, name, path).astype(np.int64)


def column(file: Any, path: Path, name: str) -> Any:
    """A column of an open parquet file.

    Raises:
        AegisError: the file has no column of that name.
    """
    if name not in file.schema_arrow.names:
        raise AegisError(
            f"no column '{name}' in '{path}'",
            f"every feature that {layout.INFO} lists",
            layout.AGAIN,
        )
    return file.read(columns=[name]).column(name)


def numbers(column: Any, name: str, path: Path) -> np.ndarray:
    """A column's numbers [n] float64, which is exact for any index.

    Raises:
        AegisError: a cell is empty, or not a finite number.
    """
    with layout.damaged(path):
        if column.null_count:
            raise ValueError(f"'{name}' has {column.null_count} empty cells")
        values = column.to_numpy().astype(np.float64)
        if not np.isfinite(values).all():
            raise ValueError(f"NaN or infinite values in '{name}'")
        return values


def _check_length(dataset: Dataset, path: Path, number: int, rows: int) -> None:
    length = dataset.episodes[number].length
    if rows != length:
        raise AegisError(
            f"{rows} row{'s' * (rows != 1)} of episode {number} in '{path}'",
            f"{length} rows one after the other, as the meta folder says",
            WITHOUT,
        )


def _together(rows: Sequence[Rows]) -> tuple[Rows, ...]:
    """Join consecutive rows: those that continue the previous ones in both file and dataset."""
    joined = list[Rows]()
    for own in rows:
        if joined:
            last = joined[-1]
            goes_on = (last.first + last.count, last.first_frame + last.count)
            # Both have to hold: a file may skip an episode of the dataset, or hold one that is not
            # read.
            if goes_on == (own.first, own.first_frame):
                joined[-1] = Rows(last.first, last.first_frame, last.count + own.count)
                continue
        joined.append(own)
    return tuple(joined)


def _missing(dataset: Dataset, number: int) -> AegisError:
    path = dataset.folder / dataset.episodes[number].data
    if path.exists():
        found = f"no rows of episode {number} in '{dataset.folder}'"
    else:
        found = f"no file '{path}'"
    return AegisError(found, f"episode {number}, which the meta folder says is there", WITHOUT)


# --- digests --------------------------------------------------------------------------------------


def digests(source: Source, cameras: Sequence[str], on_event: OnEvent = ignore) -> list[str]:
    """A digest per camera: sha256 over its name and every file that is read when training on it."""
    dataset = source.dataset
    read = [dataset.episodes[number] for number in source.episodes]
    shared = {layout.INFO}
    for path in [*dataset.table_files, *(file.path for file in source.data)]:
        shared.add(path.relative_to(dataset.folder))
    # A camera with embedded images has no clips: its pictures are in the row files.
    clips = {
        camera: {episode.clips[camera].file for episode in read if camera in episode.clips}
        for camera in cameras
    }
    wanted = {path: dataset.folder / path for path in sorted(shared.union(*clips.values()))}
    hashes = kept_digests.of_files(wanted.values(), dataset.folder, on_event, WITHOUT)
    found = []
    for camera in cameras:
        own = {str(path): hashes[wanted[path]] for path in shared | clips[camera]}
        found.append(files.sha256_value({"camera": camera, "files": own}))
    return found


def pixel_digests(source: Source, cameras: Sequence[str]) -> list[str]:
    """A digest per camera of what its decoded frames depend on.

    This is the content of its videos, and where and when each frame is in them. For a camera with
    embedded images it is the content of the row files. No words of the meta folder are part of it.
    """
    dataset = source.dataset
    data = {str(file.path.relative_to(dataset.folder)): file.path for file in source.data}
    # Of all episodes, because frames keep their numbers in the whole dataset.
    lengths = [episode.length for episode in dataset.episodes]
    found = []
    for camera in cameras:
        about: dict[str, Any] = {"lengths": lengths}
        if dataset.info.features[camera].dtype == "image":
            hashes = kept_digests.of_files(data.values(), dataset.folder, fix=layout.AGAIN)
            about["rows"] = {name: hashes[path] for name, path in data.items()}
        else:
            clips = [episode.clips[camera] for episode in dataset.episodes]
            read = {str(clips[number].file) for number in source.episodes}
            videos = {name: dataset.folder / name for name in sorted(read)}
            hashes = kept_digests.of_files(videos.values(), dataset.folder, fix=WITHOUT)
            about["videos"] = {name: hashes[path] for name, path in videos.items()}
            about["clips"] = [[str(clip.file), clip.start_s] for clip in clips]
            about["times"] = {name: _digest_of_times(path) for name, path in data.items()}
            about["fps"] = dataset.info.fps
        found.append(files.sha256_value(about))
    return found


def _digest_of_times(path: Path) -> str:
    """sha256 of the episode and the time of each row in a data file."""
    with layout.reading_parquet(path):
        times = column(layout.open_parquet(path), path, "timestamp")
    digest = hashlib.sha256(_episode_of_rows(path).tobytes())
    digest.update(numbers(times, "timestamp", path).tobytes())
    return digest.hexdigest()


def joined_digest(digests: Sequence[str], of: str) -> str:
    """sha256 over the digests of several parts; a single part keeps its own digest.

    Args:
        of: what they are, `cameras` or `sets`, so that the digests of the two never coincide.
    """
    if len(digests) == 1:
        return digests[0]
    return files.sha256_value({of: list(digests)})
