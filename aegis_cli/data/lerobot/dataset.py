"""A dataset's meta folder: its episodes, where their frames are, and the texts of its tasks."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aegis_cli.common.errors import AegisError
from aegis_cli.data.lerobot import layout
from aegis_cli.data.lerobot.layout import Info

_EPISODES = Path("meta/episodes")


@dataclass(frozen=True)
class Clip:
    """The video file that an episode is in, and where it begins there, in seconds."""

    file: Path
    start_s: float


@dataclass(frozen=True)
class EpisodeIndex:
    """Where an episode is; paths are relative to the dataset's folder.

    Attributes:
        length: number of its frames.
        data: the parquet file with its rows, as far as the meta folder knows (see `source`).
        clips: its clip for each video feature.
    """

    length: int
    data: Path
    clips: Mapping[str, Clip]


@dataclass(frozen=True)
class Dataset:
    """What the meta folder says; the folders `data` and `videos` have not been read.

    Attributes:
        tasks: texts, in the order of their `task_index`.
        episodes: in the order of their frames, which are numbered through from 0.
        stats: by feature and statistic a (nested) list of numbers; None without `meta/stats.json`.
    """

    folder: Path
    info: Info
    tasks: tuple[str, ...]
    episodes: tuple[EpisodeIndex, ...]
    stats: Mapping[str, Mapping[str, Any]] | None

    def cameras(self, names: str | Sequence[str] | None) -> tuple[str, ...]:
        """The features that one or several names stand for, in their order.

        None stands for the only one there is.

        Raises:
            AegisError: no such camera, one twice, or several to choose among.
        """
        cameras = self.info.cameras
        if names is None:
            if len(cameras) != 1:
                found = f"'{self.folder}' has {len(cameras)} cameras{_list(cameras)}"
                raise AegisError(found, "the cameras to learn from", _choose(cameras))
            return cameras
        listed = (names,) if isinstance(names, str) else names
        found = tuple(self._camera(name) for name in listed)
        if twice := [camera for i, camera in enumerate(found) if camera in found[:i]]:
            raise AegisError(
                f"the camera '{twice[0]}' twice",
                "each camera once",
                "take one of them out of demos.camera",
            )
        return found

    def _camera(self, name: str) -> str:
        cameras = self.info.cameras
        for camera in (name, layout.CAMERA + name):
            if camera in cameras:
                return camera
        listed = ", ".join(cameras) or "no camera at all"
        raise AegisError(
            f"no camera '{name}' in '{self.folder}'", f"one of: {listed}", _choose(cameras)
        )

    def size(self, feature: str) -> int:
        """How many numbers a vector feature has in each frame.

        Raises:
            AegisError: the feature is missing, or is no vector.
        """
        found = self.info.features.get(feature)
        if found is None:
            features = ", ".join(self.info.features)
            raise AegisError(
                f"no feature '{feature}' in '{self.folder}'; it has {features}",
                "the features with the robot's positions and with its actions",
                "name them: --set demos.state=NAME, --set demos.action=NAME",
            )
        if len(found.shape) != 1 or not found.dtype.startswith(("float", "int", "uint")):
            shape = " x ".join(map(str, found.shape))
            what = f"'{feature}' in '{self.folder}' is {found.dtype} of shape {shape}"
            raise AegisError(
                what, "a vector of numbers", "give a dataset whose frames have one vector of it"
            )
        return found.shape[0]


def _list(cameras: tuple[str, ...]) -> str:
    return f": {', '.join(cameras)}" if cameras else ""


def _choose(cameras: tuple[str, ...]) -> str:
    if not cameras:
        return "give a dataset with pictures"
    one = f"--set demos.camera={cameras[0]}"
    if len(cameras) == 1:
        return one
    several = f"--set 'demos.camera=[{', '.join(cameras)}]'"
    return f"{one}; a Hugging Face backbone also reads several: {several}"


def load(folder: Path) -> Dataset:
    """Read the meta folder and check that its parts agree.

    Raises:
        AegisError: no dataset, another version, a missing or damaged file, or counts that do not
            agree.
    """
    folder = Path(folder)
    info = layout.read_info(folder)
    layout.require_pyarrow()
    tasks, episodes = _read_tasks(folder), _read_episodes(folder, info)
    return Dataset(folder, info, tasks, episodes, layout.read_stats(folder))


def _read_tasks(folder: Path) -> tuple[str, ...]:
    """The texts of the tasks, by their numbers.

    pandas writes a text as the table's index: under `task`, or unnamed in older files.
    """
    path = folder / layout.TASKS
    with layout.reading_parquet(path):
        columns = layout.open_parquet(path).read().to_pydict()
    with layout.damaged(path):
        texts = columns["task"] if "task" in columns else columns["__index_level_0__"]
        by_number = dict(zip(columns["task_index"], texts, strict=True))
        numbered = sorted(by_number) == list(range(len(texts)))
        if not numbered or not all(isinstance(text, str) for text in texts):
            raise ValueError("the tasks are not numbered from 0")
        return tuple(by_number[i] for i in range(len(texts)))


def episode_files(folder: Path) -> list[Path]:
    """The files that have a row per episode."""
    return sorted((folder / _EPISODES).glob("*/*.parquet"))


def _read_episodes(folder: Path, info: Info) -> tuple[EpisodeIndex, ...]:
    where, paths = folder / _EPISODES, episode_files(folder)
    if not paths:
        raise AegisError(f"no parquet file in '{where}'", "a row per episode there", layout.AGAIN)
    rows: list[dict[str, Any]] = []
    for path in paths:
        with layout.reading_parquet(path):
            file = layout.open_parquet(path)
            names = [name for name in file.schema_arrow.names if not name.startswith("stats/")]
            rows += file.read(columns=names).to_pylist()
    with layout.damaged(where):
        rows.sort(key=lambda row: int(row["episode_index"]))
        numbers = [int(row["episode_index"]) for row in rows]
        episodes = tuple(_episode(row, info) for row in rows)
        starts = [int(row["dataset_from_index"]) for row in rows]
    _check_counts(where, info, numbers, episodes, starts)
    return episodes


def _episode(row: Mapping[str, Any], info: Info) -> EpisodeIndex:
    videos = [key for key, feature in info.features.items() if feature.dtype == "video"]
    length = int(row["length"])
    if length < 1 or int(row["dataset_to_index"]) - int(row["dataset_from_index"]) != length:
        span = f"{row['dataset_from_index']} to {row['dataset_to_index']}"
        raise ValueError(f"episode {row['episode_index']} has {length} frames from {span}")
    data = layout.data_file(info, int(row["data/chunk_index"]), int(row["data/file_index"]))
    return EpisodeIndex(length, data, {key: _clip(row, key, info) for key in videos})


def _clip(row: Mapping[str, Any], key: str, info: Info) -> Clip:
    chunk, file = (int(row[f"videos/{key}/{name}"]) for name in ("chunk_index", "file_index"))
    path = layout.video_file(info, key, chunk, file)
    start_s = float(row[f"videos/{key}/from_timestamp"])
    if not math.isfinite(start_s):
        raise ValueError(f"a video of episode {row['episode_index']} begins at {start_s} s")
    return Clip(path, start_s)


def _check_counts(
    where: Path,
    info: Info,
    numbers: list[int],
    episodes: tuple[EpisodeIndex, ...],
    starts: list[int],
) -> None:
    if len(numbers) != info.episodes or numbers != list(range(len(numbers))):
        # Among one more than there are rows, a number is always missing.
        missing = sorted(set(range(min(info.episodes, len(numbers) + 1))) - set(numbers))
        which = f"episode {missing[0]} is missing" if missing else f"{len(numbers)} rows"
        raise AegisError(
            f"'{where}': {which}", f"a row for each of {info.episodes} episodes", layout.AGAIN
        )
    frames = 0
    for number, (episode, start) in enumerate(zip(episodes, starts, strict=True)):
        if start != frames:
            found = f"'{where}': episode {number} begins at frame {start}"
            raise AegisError(found, f"frame {frames}, where the one before ends", layout.AGAIN)
        frames += episode.length
    if frames != info.frames:
        raise AegisError(
            f"'{where}': {frames} frames", f"{info.frames}, as {layout.INFO} says", layout.AGAIN
        )
