"""Write episodes as a LeRobot dataset v3.0: aside, in one pass, and renamed once complete."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from aegis_cli.common import commands
from aegis_cli.common.errors import AegisError
from aegis_cli.common.files import check_utf8, cure, folder_aside, followed, put
from aegis_cli.common.media import Mp4Writer
from aegis_cli.data.lerobot import layout, pictures, statistics, tables, version_3
from aegis_cli.data.lerobot.statistics import Statistics

_MB = 1024**2
_BUFFERED = 100  # episodes whose rows are written together
# As in LeRobot: reading one frame decodes at most two.
_KEYFRAME_EVERY = 2


@dataclass(frozen=True)
class NewEpisode:
    """An episode of T frames.

    `frames` are [T, H, W, 3] uint8 by camera, `state` [T, P] and `actions` [T, A] float32.
    """

    frames: Mapping[str, np.ndarray]
    state: np.ndarray
    actions: np.ndarray
    instruction: str


@dataclass(frozen=True)
class Spec:
    """What all episodes have in common.

    `as_video` stores pictures as H.264, which is smaller but lossy.
    """

    fps: float
    state_names: tuple[str, ...]
    action_names: tuple[str, ...]
    robot_type: str | None = None
    as_video: bool = False


@dataclass(frozen=True)
class Limits:
    """Sizes at which the next file or folder begins; the defaults are LeRobot's own."""

    files_per_chunk: int = 1000
    data_mb: int = 100
    video_mb: int = 200


def check_new(folder: Path) -> None:
    """Raise AegisError unless a dataset can be written to `folder`; to be called beforehand."""
    layout.require_pyarrow()
    check_utf8(folder, "choose another --out")
    if not folder.name:  # it is first written beside `folder` under another name
        raise AegisError(
            f"'{folder}', which names no folder", "a folder's name", "choose another --out"
        )
    folder = followed(folder)
    if not folder.parent.is_dir():
        raise AegisError(
            f"no folder '{folder.parent}'",
            f"a folder to write '{folder.name}' to",
            commands.shell("mkdir", "-p", folder.parent),
        )
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise AegisError(
            f"'{folder}' exists",
            "a new or empty folder for the dataset",
            "choose another --out, or remove it",
        )
    if not os.access(folder.parent, os.W_OK):
        raise AegisError(
            f"'{folder}' cannot be written", "a writable folder", "choose another --out"
        )


def write(
    folder: Path, episodes: Iterable[NewEpisode], spec: Spec, limits: Limits = Limits()
) -> None:
    """Write a dataset of one or more episodes; equal episodes give equal bytes.

    One episode is held in memory at a time. A symbolic link is followed, and kept.

    Raises:
        AegisError: the folder is not new, or the disk cannot be written.
    """
    check_new(folder)
    folder = followed(folder)
    try:
        with folder_aside(folder) as aside:
            _Writer(aside, spec, limits).write(episodes)
            put(aside, folder)
    except OSError as error:
        raise AegisError(
            f"cannot write '{folder}': {error.strerror or error}",
            "a writable folder with free space",
            cure(folder.parent, error),
        ) from error


class _Sink(Protocol):
    def write(self, content: Any, /) -> None: ...
    def size(self) -> int: ...
    def close(self) -> None: ...


class _Files:
    """Files that are filled one after the other.

    The next one is started when the open one would exceed the limit.
    """

    def __init__(
        self,
        path: Callable[[int, int], Path],
        start: Callable[[Path], _Sink],
        limit: int,
        per_chunk: int,
    ) -> None:
        self._path, self._start, self._limit, self._per_chunk = path, start, limit, per_chunk
        self._sink: _Sink | None = None
        self.place, self._rows = (0, 0), 0

    @property
    def filled(self) -> int:
        """Rows in the open file."""
        return 0 if self._sink is None else self._rows

    def make_room(self, rows: int) -> tuple[int, int]:
        """(chunk, file) of the file that the next `rows` rows go to.

        Their size is estimated from the mean size of the file's rows so far.
        """
        if self._sink is not None:
            expected = self._sink.size() * (1 + rows / self._rows)
            if expected >= self._limit:
                self.close()
                self.place = layout.next_file(*self.place, self._per_chunk)
        return self.place

    def write(self, content: Any, rows: int) -> None:
        """Append content of `rows` rows, after a call of `make_room`."""
        if self._sink is None:
            path = self._path(*self.place)
            path.parent.mkdir(parents=True, exist_ok=True)
            self._sink, self._rows = self._start(path), 0
        self._sink.write(content)
        self._rows += rows

    def close(self) -> None:
        """Close the open file; later writes start the next one."""
        if self._sink is not None:
            self._sink.close()
            self._sink = None


class _Writer:
    """Writes the episodes of one dataset, and at the end the meta folder."""

    def __init__(self, folder: Path, spec: Spec, limits: Limits) -> None:
        self._folder, self._spec, self._limits = folder, spec, limits
        self._data = self._parquet(layout.DATA)
        self._episodes = self._parquet(layout.EPISODES)
        self._videos: dict[str, _Files] = {}
        self._tasks: dict[str, int] = {}
        self._rows: list[dict[str, Any]] = []
        self._stats: dict[str, Statistics] = {}
        self._shapes: dict[str, tuple[int, ...]] = {}
        self._count = self._frames = 0

    def _parquet(self, template: str) -> _Files:
        def path(chunk: int, file: int) -> Path:
            return self._folder / template.format(chunk_index=chunk, file_index=file)

        return _Files(path, tables.Sink, self._limits.data_mb * _MB, self._limits.files_per_chunk)

    def _video(self, camera: str) -> _Files:
        def path(chunk: int, file: int) -> Path:
            return self._folder / layout.VIDEO.format(
                video_key=camera, chunk_index=chunk, file_index=file
            )

        def start(path: Path) -> _Sink:
            return Mp4Writer(path, self._spec.fps, _KEYFRAME_EVERY)

        return _Files(path, start, self._limits.video_mb * _MB, self._limits.files_per_chunk)

    def write(self, episodes: Iterable[NewEpisode]) -> None:
        try:
            for episode in episodes:
                self._add(episode)
            self._flush()
        finally:
            # Also after an error; `folder_aside` then removes the files.
            for files in (self._data, self._episodes, *self._videos.values()):
                files.close()
        self._save_meta()

    def _add(self, episode: NewEpisode) -> None:
        length = len(episode.actions)
        pictured = {layout.CAMERA + name: frames for name, frames in episode.frames.items()}
        if not self._shapes:
            self._shapes = {camera: frames.shape[1:] for camera, frames in pictured.items()}
        columns = self._index_columns(episode, length)
        vectors = {layout.STATE: episode.state, layout.ACTION: episode.actions, **columns}
        stats = {name: statistics.of_vectors(rows) for name, rows in vectors.items()}
        stats |= {camera: statistics.of_images(frames) for camera, frames in pictured.items()}
        # A row of the table of episodes: the location of this one's parts, and its statistics.
        row: dict[str, Any] = {
            "episode_index": self._count,
            "tasks": [episode.instruction],
            "length": length,
        }
        row["data/chunk_index"], row["data/file_index"] = self._data.make_room(length)
        row |= {"dataset_from_index": self._frames, "dataset_to_index": self._frames + length}
        embedded: dict[str, list[bytes]] = {}  # pictures in the table, if not stored as video
        for camera, frames in pictured.items():
            if self._spec.as_video:
                row |= self._append_video(camera, frames)
            else:
                embedded[camera] = [pictures.to_png(frame) for frame in frames]
        self._data.write(tables.of_frames(vectors, embedded), length)
        for name, own in stats.items():
            for figure, value in own.items():
                row[f"stats/{name}/{figure}"] = value.tolist()
            # Merged incrementally, so that no episode is kept in memory.
            known = self._stats.get(name)
            self._stats[name] = own if known is None else statistics.merge([known, own])
        self._count, self._frames = self._count + 1, self._frames + length
        self._rows.append(row)
        if len(self._rows) == _BUFFERED:
            self._flush()

    def _index_columns(self, episode: NewEpisode, length: int) -> dict[str, np.ndarray]:
        task = self._tasks.setdefault(episode.instruction, len(self._tasks))
        frames = np.arange(length)
        return {
            "timestamp": (frames / self._spec.fps).astype(np.float32),
            "frame_index": frames,
            "episode_index": np.full(length, self._count),
            "index": self._frames + frames,
            "task_index": np.full(length, task),
        }

    def _append_video(self, camera: str, frames: np.ndarray) -> dict[str, Any]:
        """Write an episode's frames; return their location, in seconds from the file's start."""
        files = self._videos.setdefault(camera, self._video(camera))
        chunk, file = files.make_room(len(frames))
        first = files.filled
        files.write(frames, len(frames))
        fps, key = self._spec.fps, f"videos/{camera}"
        return {
            f"{key}/chunk_index": chunk,
            f"{key}/file_index": file,
            f"{key}/from_timestamp": first / fps,
            f"{key}/to_timestamp": (first + len(frames)) / fps,
        }

    def _flush(self) -> None:
        if not self._rows:
            return
        chunk, file = self._episodes.make_room(len(self._rows))
        # A row also names the table file that it is in, as in LeRobot.
        own_place = {"meta/episodes/chunk_index": chunk, "meta/episodes/file_index": file}
        rows = [row | own_place for row in self._rows]
        self._episodes.write(tables.of_rows(rows), len(rows))
        self._rows = []

    def _save_meta(self) -> None:
        tables.save_tasks(self._folder / version_3.TASKS, list(self._tasks))
        stats = {}
        for name, own in self._stats.items():
            stats[name] = {figure: value.tolist() for figure, value in own.items()}
        layout.save_json(self._folder / layout.STATS, stats)
        layout.save_json(self._folder / layout.INFO, self._info())

    def _info(self) -> dict[str, Any]:
        spec, limits = self._spec, self._limits
        return {
            "codebase_version": layout.VERSION,
            # Other readers may expect whole numbers, as in LeRobot's own datasets.
            "fps": int(spec.fps) if spec.fps == int(spec.fps) else spec.fps,
            "features": self._features(),
            "total_episodes": self._count,
            "total_frames": self._frames,
            "total_tasks": len(self._tasks),
            "chunks_size": limits.files_per_chunk,
            "data_files_size_in_mb": limits.data_mb,
            "video_files_size_in_mb": limits.video_mb,
            "data_path": layout.DATA,
            "video_path": layout.VIDEO if spec.as_video else None,
            "robot_type": spec.robot_type,
            "splits": {"train": f"0:{self._count}"},
        }

    def _features(self) -> dict[str, dict[str, Any]]:
        spec = self._spec
        named = {layout.STATE: spec.state_names, layout.ACTION: spec.action_names}
        features: dict[str, dict[str, Any]] = {
            name: {"dtype": "float32", "shape": [len(names)], "names": list(names)}
            for name, names in named.items()
        }
        for camera, shape in self._shapes.items():
            kind = "video" if spec.as_video else "image"
            features[camera] = {
                "dtype": kind,
                "shape": list(shape),
                "names": ["height", "width", "channels"],
            }
            if spec.as_video:
                features[camera]["info"] = _video_info(shape, spec.fps)
        return features | {
            name: {"dtype": kind, "shape": [1], "names": None}
            for name, kind in layout.INDEX_FEATURES.items()
        }


def _video_info(shape: tuple[int, ...], fps: float) -> dict[str, Any]:
    """LeRobot's description of the videos of a camera whose frames have the shape (H, W, 3)."""
    return {
        "video.height": shape[0],
        "video.width": shape[1],
        "video.codec": "h264",
        "video.pix_fmt": "yuv420p",
        "video.fps": fps,
        "video.channels": 3,
        "has_audio": False,
        "is_depth_map": False,
    }
