"""Where LeRobot's dataset format v3.0 keeps what, and `meta/info.json`, which says so.

meta/info.json  meta/stats.json  meta/tasks.parquet
meta/episodes/chunk-000/file-000.parquet    a row per episode
data/chunk-000/file-000.parquet             a row per frame; embedded images are in it
videos/<camera>/chunk-000/file-000.mp4      episodes one after the other
"""

from __future__ import annotations

import contextlib
import glob
import json
import math
import re
import string
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError

VERSION = "v3.0"
INFO, STATS, TASKS = Path("meta/info.json"), Path("meta/stats.json"), Path("meta/tasks.parquet")
EPISODES = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
STATE, ACTION, CAMERA = "observation.state", "action", "observation.images."
ROBOT = "aegis/"  # robot type of a simulated task; LeRobot's own tools carry it along
# What every dataset has besides its own features, in this order.
INDEX_FEATURES = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
_NUMBER = re.compile(r"(0?[1-9])?d?")  # how a path's number may be formatted
AGAIN = "get the dataset again, or another one"  # the cure for one that is not whole

_CONVERTER = (
    "python -m lerobot.scripts.convert_dataset_v21_to_v30 --repo-id={name} "
    "--root={folder} --push-to-hub=false"
)


@dataclass(frozen=True)
class Feature:
    """One column, or one video per file.

    `names` is a list, a mapping or None, as the dataset has it.
    """

    dtype: str
    shape: tuple[int, ...]
    names: Any
    is_depth: bool

    @property
    def components(self) -> tuple[str, ...]:
        """The names of its numbers, or of a picture's channels; empty texts where it has none."""
        if self.dtype in ("image", "video"):
            return ("red", "green", "blue")
        names = self.names
        if isinstance(names, Mapping):  # {"motors": [...]}, as some datasets have them
            names = next((list(value) for value in names.values() if isinstance(value, list)), None)
        if isinstance(names, list):
            return tuple(map(str, names))
        return ("",) * math.prod(self.shape)


@dataclass(frozen=True)
class Info:
    """What `meta/info.json` says, as far as Aegis reads it."""

    version: str
    fps: float
    features: Mapping[str, Feature]
    episodes: int
    frames: int
    robot_type: str | None
    data_path: str
    video_path: str | None
    splits: Mapping[str, str] = field(default_factory=dict)

    @property
    def cameras(self) -> tuple[str, ...]:
        """The features that are colour pictures, as images or video."""
        return tuple(
            k for k, f in self.features.items() if f.dtype in ("image", "video") and not f.is_depth
        )

    @property
    def task(self) -> str | None:
        """The simulated task that `aegis demos` recorded; None for any other dataset."""
        kind = self.robot_type or ""
        return kind.removeprefix(ROBOT) if kind.startswith(ROBOT) else None


def short(camera: str) -> str:
    """A camera's name without what LeRobot's names of cameras begin with."""
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
    """Whether this is a folder with a dataset of any version in it."""
    return (folder / INFO).is_file()


def read_info(folder: Path) -> Info:
    """What the dataset in `folder` is.

    Raises:
        AegisError: no dataset, one of another version, or an `info.json` that is not sound.
    """
    if not is_dataset(folder):
        raise AegisError(
            f"'{folder}' is no dataset folder: it has no {INFO}",
            f"a LeRobot dataset {VERSION}",
            "give the folder that holds meta/ and data/",
        )
    raw = files.load_json(folder / INFO)
    with damaged(folder / INFO):
        _check_version(folder, str(raw["codebase_version"]))
        return _parse(raw)


def _check_version(folder: Path, version: str) -> None:
    major, minor = (int(part) for part in f"{version.lstrip('v')}.0".split(".")[:2])
    if (major, minor) < (2, 1):
        fix = (
            "convert it to v2.1 with a release of LeRobot that reads it, then to v3.0 with a "
            "later one"
        )
        raise AegisError(f"'{folder}' is a LeRobot dataset {version}", f"version {VERSION}", fix)
    if major < 3:
        fix = _CONVERTER.format(name=folder.resolve().name, folder=folder)
        raise AegisError(
            f"'{folder}' is a LeRobot dataset {version}",
            f"version {VERSION}",
            f"convert it with LeRobot: {fix}",
        )
    if major > 3:
        upgrade = "upgrade aegis: git pull && pip install -e ."
        raise AegisError(
            f"'{folder}' is a LeRobot dataset {version}", f"version {VERSION}", upgrade
        )


def _parse(raw: Mapping[str, Any]) -> Info:
    features = {str(name): _feature(entry) for name, entry in raw["features"].items()}
    info = Info(
        str(raw["codebase_version"]),
        float(raw["fps"]),
        features,
        int(raw["total_episodes"]),
        int(raw["total_frames"]),
        raw.get("robot_type"),
        str(raw["data_path"]),
        raw.get("video_path"),
        _splits(raw.get("splits")),
    )
    if not 0 < info.fps < math.inf:
        raise ValueError(f"fps is {info.fps:g}")
    if not isinstance(info.robot_type, str | None):
        raise ValueError(f"robot_type is {info.robot_type}")
    data_file(info, 0, 0)
    for name, feature in features.items():
        if feature.dtype == "video":
            video_file(info, name, 0, 0)
    return info


def _splits(raw: Any) -> dict[str, str]:
    """Names of splits and their episodes; what is said in another way than LeRobot's is left out.

    Nothing but a split's own name in a recipe asks for it.
    """
    if not isinstance(raw, Mapping):
        return {}
    return {str(name): said for name, said in raw.items() if isinstance(said, str)}


def data_file(info: Info, chunk: int, file: int) -> Path:
    """The parquet file with these numbers, from the dataset's folder.

    Raises:
        ValueError: the dataset's template is none, or leads out of the folder.
    """
    return _filled(info.data_path, {"chunk_index": chunk, "file_index": file})


def data_files(info: Info, folder: Path) -> list[Path]:
    """The parquet files below `folder` whose names the dataset's template can give."""
    pattern, name = [], []
    for text, field_name, _, _ in string.Formatter().parse(info.data_path):
        pattern.append(glob.escape(text) + ("" if field_name is None else "*"))
        name.append(re.escape(text) + ("" if field_name is None else r"\d+"))
    fits = re.compile("".join(name))
    found = sorted(folder.glob("".join(pattern)))
    return [path for path in found if fits.fullmatch(path.relative_to(folder).as_posix())]


def video_file(info: Info, camera: str, chunk: int, file: int) -> Path:
    """The video file of a camera with these numbers, from the dataset's folder.

    Raises:
        ValueError: the dataset's template is none, or it or the camera's name leads out of the
            folder.
    """
    values = {"video_key": camera, "chunk_index": chunk, "file_index": file}
    return _filled(str(info.video_path), values)


def _filled(template: str, values: Mapping[str, str | int]) -> Path:
    """A template with its numbers filled in.

    Python's own formatting would follow attributes, and pad to a billion digits.

    Raises:
        KeyError: a field that is no value's name.
        ValueError: another format than that of a plain number, or a path that leads out.
    """
    for _, name, form, conversion in string.Formatter().parse(template):
        if name is None:
            continue  # text alone
        value = values[name]
        if conversion or not (_NUMBER.fullmatch(form) if isinstance(value, int) else not form):
            raise ValueError(f"the path {template}, in which '{name}' has a format of its own")
    path = Path(template.format(**values))
    if path.is_absolute() or ".." in path.parts or "\0" in str(path):
        raise ValueError(f"the path {path} leaves the folder")
    return path


def _feature(entry: Mapping[str, Any]) -> Feature:
    notes = [entry.get("info") or {}, entry.get("video_info") or {}]
    depth = any(note.get("is_depth_map") or note.get("video.is_depth_map") for note in notes)
    return Feature(
        str(entry["dtype"]), tuple(int(n) for n in entry["shape"]), entry.get("names"), depth
    )


def read_stats(folder: Path) -> dict[str, dict[str, Any]] | None:
    """`meta/stats.json`; None where it is missing, for LeRobot does without it, too."""
    if not (folder / STATS).is_file():
        return None
    stats = files.load_json(folder / STATS)
    with damaged(folder / STATS):
        return {str(name): dict(figures) for name, figures in stats.items()}


@contextlib.contextmanager
def damaged(path: Path) -> Iterator[None]:
    """Turn exceptions of wrong types, missing keys or wrong values into an error about a file."""
    try:
        yield
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        what = f"no {error}" if isinstance(error, KeyError) else str(error)
        raise AegisError(
            f"'{path}' is damaged: {what}", f"a file of LeRobot's format {VERSION}", AGAIN
        ) from error


@contextlib.contextmanager
def reading_parquet(path: Path) -> Iterator[None]:
    """Turn a parquet file that is missing or damaged into the one error a user sees."""
    from pyarrow import ArrowException

    try:
        yield
    except FileNotFoundError as error:
        raise AegisError(
            f"no file '{path}'", "every file that the dataset's meta folder names", AGAIN
        ) from error
    except (ArrowException, OSError, ValueError, MemoryError) as error:
        what = (str(error).splitlines() or ["it cannot be read"])[0]
        raise AegisError(f"'{path}' is damaged: {what}", "a parquet file", AGAIN) from error


def open_parquet(path: Path) -> Any:
    """A `pyarrow.parquet.ParquetFile` that checks the pages' checksums, where the file has them."""
    from pyarrow import parquet

    files.refuse_special(path)
    return parquet.ParquetFile(path, page_checksum_verification=True)


def next_file(chunk: int, file: int, per_chunk: int) -> tuple[int, int]:
    """The place after this one: files are counted within their chunk."""
    return (chunk + 1, 0) if file == per_chunk - 1 else (chunk, file + 1)


def save_json(path: Path, value: Any) -> None:
    """JSON as LeRobot writes it: indented, in the order given."""
    text = json.dumps(value, indent=4, ensure_ascii=False, allow_nan=False) + "\n"
    files.write_text(path, text)
