"""The layout of LeRobot's dataset format, and `meta/info.json`, which describes it.

Version 3.0, which is also written:

    meta/info.json  meta/stats.json  meta/tasks.parquet
    meta/episodes/chunk-000/file-000.parquet    a row per episode
    data/chunk-000/file-000.parquet             a row per frame; embedded images are in it
    videos/<camera>/chunk-000/file-000.mp4      episodes one after the other

Versions 2.0 and 2.1, which have one file per episode:

    meta/info.json  meta/tasks.jsonl  meta/episodes.jsonl
    meta/stats.json (2.0)  meta/episodes_stats.jsonl (2.1)
    data/chunk-000/episode_000000.parquet
    videos/chunk-000/<camera>/episode_000000.mp4
"""

from __future__ import annotations

import contextlib
import glob
import json
import math
import re
import string
from collections.abc import Generator, Iterable, Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError

VERSION = "v3.0"  # the version that is written
READ = "version 2.0, 2.1 or 3.0"
INFO, STATS = Path("meta/info.json"), Path("meta/stats.json")
EPISODES = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
STATE, ACTION, CAMERA = "observation.state", "action", "observation.images."
ROBOT = "aegis/"  # prefix of a simulated task's robot type; LeRobot's own tools keep it
# The columns that every dataset has besides its own features, in this order.
INDEX_FEATURES = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
_NUMBER = re.compile(r"(0?[1-9])?d?")  # the allowed formats of a path's number
AGAIN = "get the dataset again, or another one"  # the advice for an incomplete dataset

Place = Mapping[str, int]  # the numbers for the fields of a path template

_T = TypeVar("_T")


@dataclass(frozen=True)
class Feature:
    """One column, or one video per file.

    `names` is a list, a mapping or None, as in the dataset.
    """

    dtype: str
    shape: tuple[int, ...]
    names: Any
    is_depth: bool

    @property
    def components(self) -> tuple[str, ...]:
        """The names of its numbers, or of a picture's channels.

        They are empty strings if it has none, or a wrong number of them: openpi's datasets name
        eight positions `["state"]`. An array, such as a depth map in the rows, has no components:
        it may hold hundreds of thousands of numbers.
        """
        if self.dtype in ("image", "video"):
            # For pictures, datasets name the axes instead: height, width and channels.
            return ("depth",) if self.is_depth else ("red", "green", "blue")
        if len(self.shape) > 1:
            return ()
        names = self.names
        count = math.prod(self.shape)
        if isinstance(names, Mapping):
            names = _listed(names, count)
        if isinstance(names, list) and len(names) == count:
            return tuple(map(str, names))
        return ("",) * count


def _listed(names: Mapping[Any, Any], count: int) -> list[Any] | None:
    """The names of `count` numbers in a mapping; None if it has none.

    Some datasets have {"motors": [...]}; those of LeRobot's end-effector teleoperators have
    {"delta_x": 0, "delta_y": 1}, an index for each name.
    """
    places = {place: name for name, place in names.items() if isinstance(place, int)}
    if len(names) == count and places.keys() == set(range(count)):
        return [places[place] for place in range(count)]
    return next((list(value) for value in names.values() if isinstance(value, list)), None)


@dataclass(frozen=True)
class Info:
    """The contents of `meta/info.json` that Aegis reads.

    Attributes:
        chunk_episodes: the number of episodes per chunk folder in versions 2.0 and 2.1.
    """

    version: str
    fps: float
    features: Mapping[str, Feature]
    episodes: int
    frames: int
    robot_type: str | None
    data_path: str
    video_path: str | None
    splits: Mapping[str, str] = field(default_factory=dict)
    chunk_episodes: int = 1000

    @property
    def cameras(self) -> tuple[str, ...]:
        """The features that are colour pictures, stored as images or video."""
        found = list[str]()
        for name, feature in self.features.items():
            if feature.dtype in ("image", "video") and not feature.is_depth:
                found.append(name)
        return tuple(found)

    @property
    def videos(self) -> tuple[str, ...]:
        """The features stored as video, including depth."""
        return tuple(name for name, feature in self.features.items() if feature.dtype == "video")

    @property
    def has_episode_files(self) -> bool:
        """Whether each episode has its own files, as before version 3.0."""
        return _numbers_of(self.version)[0] < 3

    @property
    def task(self) -> str | None:
        """The simulated task that `aegis demos` recorded; None for any other dataset."""
        return simulated_task(self.robot_type)


@dataclass(frozen=True)
class Clip:
    """The video file of an episode, and its start and end in that file, in seconds.

    The end is infinity if the meta folder does not give it.
    """

    file: Path
    start_s: float
    end_s: float = math.inf


@dataclass(frozen=True)
class EpisodeIndex:
    """The location of an episode; paths are relative to the dataset's folder.

    Attributes:
        length: number of its frames.
        data: the parquet file with its rows, according to the meta folder (see `source`).
        clips: its clip for each video feature.
        tasks: its instructions; empty if the meta folder does not give them.
    """

    length: int
    data: Path
    clips: Mapping[str, Clip]
    tasks: tuple[str, ...] = ()


def tasks_of(row: Mapping[str, Any]) -> tuple[str, ...]:
    """The instructions in an episode's row of the meta folder; () if they are not texts.

    Training uses the instructions of the data files. These only help to select episodes.
    """
    told = row.get("tasks")
    is_list = isinstance(told, list) and all(isinstance(text, str) for text in told)
    return tuple(told) if is_list else ()


def simulated_task(robot_type: str | None) -> str | None:
    """The simulated task that a dataset's robot type names; None for any other."""
    kind = robot_type or ""
    return kind.removeprefix(ROBOT) if kind.startswith(ROBOT) else None


def short(camera: str) -> str:
    """A camera's name without LeRobot's prefix."""
    return camera.removeprefix(CAMERA)


def require_pyarrow() -> None:
    """Raise AegisError unless the package for LeRobot's tables is installed."""
    if find_spec("pyarrow") is None:
        raise AegisError(
            "no package 'pyarrow'",
            "the package for LeRobot datasets",
            "pip install 'aegis-vla[lerobot]'",
        )


def is_dataset(folder: Path) -> bool:
    """Whether this folder holds a dataset of any version."""
    return (folder / INFO).is_file()


def read_info(folder: Path) -> Info:
    """Read `meta/info.json` of the dataset in `folder`.

    Raises:
        AegisError: there is no dataset, its version is unsupported, `info.json` is invalid, or the
            path is not valid UTF-8, which pyarrow does not accept.
    """
    if not is_dataset(folder):
        raise AegisError(
            f"'{folder}' is no dataset folder: it has no {INFO}",
            f"a LeRobot dataset of {READ}",
            "give the folder that holds meta/ and data/",
        )
    files.check_utf8(folder, files.RENAME)
    raw = files.load_json(folder / INFO)
    with damaged(folder / INFO):
        _check_version(folder, str(raw["codebase_version"]))
        return _parse(raw)


def _check_version(folder: Path, version: str) -> None:
    major, minor = _numbers_of(version)
    if 2 <= major <= 3:
        return
    fix = "upgrade aegis: git pull && pip install -e ."
    if (major, minor) < (2, 0):
        fix = "convert it to version 2.0 with a release of LeRobot that reads it"
    raise AegisError(f"'{folder}' is a LeRobot dataset {version}", READ, fix)


def _numbers_of(version: str) -> tuple[int, int]:
    """The first two numbers of a version.

    Raises:
        ValueError: it is no version.
    """
    padded = f"{version.lstrip('v')}.0"  # `v3` is version 3.0
    major, minor = padded.split(".")[:2]
    return int(major), int(minor)


def _parse(raw: Mapping[str, Any]) -> Info:
    features = {str(name): _feature(entry) for name, entry in raw["features"].items()}
    info = Info(
        version=str(raw["codebase_version"]),
        fps=float(raw["fps"]),
        features=features,
        episodes=int(raw["total_episodes"]),
        frames=int(raw["total_frames"]),
        robot_type=raw.get("robot_type"),
        data_path=str(raw["data_path"]),
        video_path=raw.get("video_path"),
        splits=_splits(raw.get("splits")),
        chunk_episodes=int(raw.get("chunks_size", 1000)),
    )
    if not 0 < info.fps < math.inf:
        raise ValueError(f"fps is {info.fps:g}")
    if not isinstance(info.robot_type, str | None):
        raise ValueError(f"robot_type is {info.robot_type}")
    if info.chunk_episodes < 1:
        raise ValueError(f"chunks_size is {info.chunk_episodes}")
    # Make the first paths to check that the templates are valid, before anything is read.
    first = episode_place(info, 0) if info.has_episode_files else file_place(0, 0)
    data_file(info, first)
    for name in info.videos:
        video_file(info, name, first)
    return info


def _splits(raw: Any) -> dict[str, str]:
    """Names of splits and their episodes; those in another form than LeRobot's are left out.

    A split is only used if a recipe names it.
    """
    if not isinstance(raw, Mapping):
        return {}
    return {str(name): said for name, said in raw.items() if isinstance(said, str)}


def file_place(chunk: int, file: int) -> Place:
    """The path numbers of a file in version 3.0."""
    return {"chunk_index": chunk, "file_index": file}


def episode_place(info: Info, number: int) -> Place:
    """The path numbers of an episode's own file, before version 3.0."""
    return {"episode_chunk": number // info.chunk_episodes, "episode_index": number}


def data_file(info: Info, place: Place) -> Path:
    """The parquet file with these numbers, relative to the dataset's folder.

    Raises:
        KeyError: the dataset's template has another field.
        ValueError: the template is invalid, or leads out of the folder.
    """
    return _filled(info.data_path, place)


def data_files(info: Info, folder: Path) -> list[Path]:
    """The parquet files below `folder` whose names match the dataset's template."""
    pattern, name = "", ""
    for text, field_name, _, _ in string.Formatter().parse(info.data_path):
        pattern += glob.escape(text)
        name += re.escape(text)
        if field_name is not None:
            pattern += "*"
            name += r"\d+"
    # A glob cannot match numbers only: it would also find a copy such as `file-000 (1).parquet`.
    fits = re.compile(name)
    found = sorted(folder.glob(pattern))
    return [path for path in found if fits.fullmatch(path.relative_to(folder).as_posix())]


def video_file(info: Info, camera: str, place: Place) -> Path:
    """The video file of a camera with these numbers, relative to the dataset's folder.

    Raises:
        KeyError: the dataset's template has another field.
        ValueError: the template is invalid, or it or the camera's name leads out of the folder.
    """
    return _filled(str(info.video_path), {"video_key": camera, **place})


def _filled(template: str, values: Mapping[str, str | int]) -> Path:
    """Fill the numbers into a path template.

    Python's own formatting would follow attributes, or pad to a billion digits.

    Raises:
        KeyError: a field is not among the values.
        ValueError: a field has another format than a plain number's, or the path leads out.
    """
    for _, name, form, conversion in string.Formatter().parse(template):
        if name is None or form is None:
            continue  # only text
        value = values[name]
        plain = _NUMBER.fullmatch(form) if isinstance(value, int) else not form
        if conversion or not plain:
            raise ValueError(f"the path {template}, in which '{name}' has a format of its own")
    path = Path(template.format(**values))
    if path.is_absolute() or ".." in path.parts or "\0" in str(path):
        raise ValueError(f"the path {path} leaves the folder")
    return path


def _feature(entry: Mapping[str, Any]) -> Feature:
    # Versions differ in where this is stored, and under which key.
    notes = [entry.get("info") or {}, entry.get("video_info") or {}]
    depth = any(note.get("is_depth_map") or note.get("video.is_depth_map") for note in notes)
    shape = tuple(int(side) for side in entry["shape"])
    return Feature(str(entry["dtype"]), shape, entry.get("names"), depth)


def read_stats(folder: Path) -> dict[str, dict[str, Any]] | None:
    """`meta/stats.json`; None if it is missing, which LeRobot accepts too."""
    if not (folder / STATS).is_file():
        return None
    stats = files.load_json(folder / STATS)
    with damaged(folder / STATS):
        return {str(name): dict(figures) for name, figures in stats.items()}


def by_number(entries: Iterable[tuple[Any, _T]]) -> dict[int, _T]:
    """The entries of a file of episodes or tasks, by number in ascending order.

    Raises:
        ValueError: a number is invalid, or occurs twice.
    """
    found: dict[int, _T] = {}
    for said, entry in entries:
        number = int(said)
        if number in found:
            raise ValueError(f"number {number} is there twice")
        found[number] = entry
    return dict(sorted(found.items()))


def texts_of(tasks: Mapping[int, Any]) -> tuple[str, ...]:
    """The tasks' texts in order of their numbers.

    Raises:
        ValueError: a text is no string, or a number is missing.
    """
    if list(tasks) != list(range(len(tasks))):
        raise ValueError("the tasks are not numbered from 0")
    if not all(isinstance(text, str) for text in tasks.values()):
        raise ValueError("a task is no text")
    return tuple(tasks.values())


def check_episodes(where: Path, info: Info, episodes: Mapping[int, EpisodeIndex]) -> None:
    """Raise AegisError unless these are exactly the episodes and frames that `info.json` counts."""
    numbers = list(episodes)
    if len(numbers) != info.episodes or numbers != list(range(len(numbers))):
        # Of one more candidate than there are rows, at least one is always missing.
        missing = sorted(set(range(min(info.episodes, len(numbers) + 1))) - set(numbers))
        which = f"episode {missing[0]} is missing" if missing else f"{len(numbers)} rows"
        raise AegisError(
            f"'{where}': {which}", f"a row for each of {info.episodes} episodes", AGAIN
        )
    frames = sum(episode.length for episode in episodes.values())
    if frames != info.frames:
        raise AegisError(f"'{where}': {frames} frames", f"{info.frames}, as {INFO} says", AGAIN)


@contextlib.contextmanager
def damaged(path: Path) -> Generator[None]:
    """Turn exceptions about types, missing keys or values into an AegisError about a file."""
    try:
        yield
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        files.refuse_pointer(path)  # a Git LFS pointer has its own advice
        # The text of a KeyError is only the key.
        what = f"no {error}" if isinstance(error, KeyError) else str(error)
        raise AegisError(
            f"'{path}' is damaged: {what}", "a file of LeRobot's dataset format", AGAIN
        ) from error


@contextlib.contextmanager
def reading_parquet(path: Path) -> Generator[None]:
    """Turn errors of a missing or damaged parquet file into an AegisError."""
    from pyarrow import ArrowException

    try:
        yield
    except FileNotFoundError as error:
        raise AegisError(
            f"no file '{path}'", "every file that the dataset's meta folder names", AGAIN
        ) from error
    except (ArrowException, OSError, ValueError, MemoryError) as error:
        files.refuse_pointer(path)
        what = (str(error).splitlines() or ["it cannot be read"])[0]  # the rest may fill pages
        raise AegisError(f"'{path}' is damaged: {what}", "a parquet file", AGAIN) from error


def open_parquet(path: Path) -> Any:
    """A `pyarrow.parquet.ParquetFile` that checks the pages' checksums, if the file has them."""
    from pyarrow import parquet

    files.refuse_special(path)
    return parquet.ParquetFile(path, page_checksum_verification=True)


def next_file(chunk: int, file: int, per_chunk: int) -> tuple[int, int]:
    """The (chunk, file) after this one: files are counted within their chunk."""
    return (chunk + 1, 0) if file == per_chunk - 1 else (chunk, file + 1)


def save_json(path: Path, value: Any) -> None:
    """JSON as LeRobot writes it: indented, in the order given."""
    text = json.dumps(value, indent=4, ensure_ascii=False, allow_nan=False) + "\n"
    files.write_text(path, text)
