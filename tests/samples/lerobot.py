"""LeRobot datasets of noise, small enough for every test, and ways to take their files apart."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import pickle
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from aegis_cli import sim
from aegis_cli.data.lerobot import dataset, rows, source, write
from aegis_cli.data.lerobot import frames as camera_frames
from aegis_cli.data.lerobot.write import Limits, NewEpisode, Spec

STATE, ACTION = ("x", "y", "z"), ("dx", "dy")
TEXTS = ("go to the red pad", "go to the blue pad", 'grüße "the" robot')
READABLE = ("move the finger to the red target",)  # by the embedded model
SPEC = Spec(10.0, STATE, ACTION, "arm")
# The files of each dataset that was written, by a digest of what it was asked for.
_WRITTEN: dict[bytes, dict[Path, bytes]] = {}


@pytest.fixture
def frame_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Put every test's decoded frames into a folder of its own."""
    folder = tmp_path_factory.mktemp("cache")
    monkeypatch.setenv("AEGIS_CACHE", str(folder))
    return folder


def episodes(
    count: int = 5,
    cameras: tuple[str, ...] = ("top",),
    size: tuple[int, int] = (16, 24),
    seed: int = 0,
    smooth: bool = False,
    texts: Sequence[str] = TEXTS,
) -> list[NewEpisode]:
    """Episodes of 1 to 9 frames of noise; `smooth` frames have one colour, suitable for video."""
    rng = np.random.default_rng(seed)

    def pictures(length: int) -> np.ndarray:
        if smooth:
            colors = rng.integers(0, 256, (length, 1, 1, 3), dtype=np.uint8)
            return np.broadcast_to(colors, (length, *size, 3)).copy()
        return rng.integers(0, 256, (length, *size, 3), dtype=np.uint8)

    def episode(number: int) -> NewEpisode:
        length = int(rng.integers(1, 10)) if number else 5
        state, actions = (
            rng.normal(size=(length, len(names))).astype(np.float32) for names in (STATE, ACTION)
        )
        return NewEpisode(
            {camera: pictures(length) for camera in cameras},
            state,
            actions,
            texts[number % len(texts)],
        )

    return [episode(number) for number in range(count)]


def save(
    folder: Path, made: list[NewEpisode] | None = None, limits: Limits = Limits(), **spec: Any
) -> Path:
    """A dataset with the sample's names; returns its folder.

    It has the bytes that `written` gave for the same episodes before: most tests write some of a
    few datasets, and encoding takes twenty times as long as writing down what is known.
    """
    made = episodes() if made is None else made
    asked = (made, limits, sorted(spec.items()), write._MB, write._BUFFERED)
    key = hashlib.sha256(pickle.dumps(asked)).digest()
    if folder.exists() or key not in _WRITTEN:
        written(folder, made, limits, **spec)
        files = [path for path in folder.rglob("*") if path.is_file()]
        _WRITTEN[key] = {path.relative_to(folder): path.read_bytes() for path in files}
        return folder
    for name, data in _WRITTEN[key].items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder


def written(
    folder: Path, made: list[NewEpisode] | None = None, limits: Limits = Limits(), **spec: Any
) -> Path:
    """A dataset with the sample's names, always written anew; returns its folder."""
    write.write(
        folder, episodes() if made is None else made, dataclasses.replace(SPEC, **spec), limits
    )
    return folder


def joined(made: list[NewEpisode]) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """States and actions of all frames, and each frame's text."""
    texts = [e.instruction for e in made for _ in e.actions]
    return np.concatenate([e.state for e in made]), np.concatenate([e.actions for e in made]), texts


def frames(made: list[NewEpisode], camera: str = "top") -> np.ndarray:
    return np.concatenate([e.frames[camera] for e in made])


def read(folder: Path, camera: str | None = None, side: int | None = None) -> np.ndarray:
    """All frames of a camera, as training gets them."""
    found = dataset.load(folder)
    (key,) = found.cameras(camera)
    read = source.find(found)
    digest = source.pixel_digests(read, [key])[0]
    index = rows.read_index(read)
    return camera_frames.load(read, index, key, side, digest, 1, lambda _: None)[0]


def as_version_2(folder: Path, version: str) -> Path:
    """Convert a dataset of version v3.0 to v2.0 or v2.1, with two episodes per chunk.

    Videos are kept as they are, so each must hold one episode.
    """
    meta, info = folder / "meta", json.loads((folder / "meta/info.json").read_text())
    rows = parquet.read_table(meta / "episodes/chunk-000/file-000.parquet").to_pylist()
    _move_videos(folder, info, rows)
    _share_rows(folder, len(rows))
    _save_lines(meta / "tasks.jsonl", parquet.read_table(meta / "tasks.parquet").to_pylist())
    told = ("episode_index", "tasks", "length")
    _save_lines(meta / "episodes.jsonl", [{name: row[name] for name in told} for row in rows])
    if version == "v2.1":
        _save_lines(meta / "episodes_stats.jsonl", [_stats_row(row) for row in rows])
        (meta / "stats.json").unlink()
    (meta / "tasks.parquet").unlink()
    shutil.rmtree(meta / "episodes")
    chunk, episode = "chunk-{episode_chunk:03d}", "episode_{episode_index:06d}"
    info |= {
        "codebase_version": version,
        "chunks_size": 2,
        "total_chunks": -(-len(rows) // 2),
        "total_videos": len(list(folder.glob("videos/*/*/*.mp4"))),
        "data_path": f"data/{chunk}/{episode}.parquet",
        "video_path": f"videos/{chunk}/{{video_key}}/{episode}.mp4",
    }
    (meta / "info.json").write_text(json.dumps(info))
    return folder


def _move_videos(folder: Path, info: dict[str, Any], rows: list[dict[str, Any]]) -> None:
    keys = [key for key, feature in info["features"].items() if feature["dtype"] == "video"]
    for key in keys:
        for number, row in enumerate(rows):
            chunk, file = (row[f"videos/{key}/{name}"] for name in ("chunk_index", "file_index"))
            target = folder / f"videos/chunk-{number // 2:03d}/{key}/episode_{number:06d}.mp4"
            target.parent.mkdir(parents=True, exist_ok=True)
            (folder / f"videos/{key}/chunk-{chunk:03d}/file-{file:03d}.mp4").rename(target)
        shutil.rmtree(folder / "videos" / key)


def _share_rows(folder: Path, count: int) -> None:
    """Write a parquet file for each episode."""
    table = pa.concat_tables([parquet.read_table(path) for path in data_files(folder)])
    shutil.rmtree(folder / "data")
    of = table.column("episode_index").to_numpy()
    for number in range(count):
        path = folder / f"data/chunk-{number // 2:03d}/episode_{number:06d}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        parquet.write_table(table.filter(pa.array(of == number)), path)


def _stats_row(row: dict[str, Any]) -> dict[str, Any]:
    """An episode's statistics in the format of version 2.1, which had no quantiles."""
    stats: dict[str, dict[str, Any]] = {}
    for name, value in row.items():
        if name.startswith("stats/") and not name.rpartition("/")[2].startswith("q"):
            _, feature, figure = name.split("/")
            stats.setdefault(feature, {})[figure] = value
    return {"episode_index": row["episode_index"], "stats": stats}


def _save_lines(path: Path, rows: list[dict[str, Any]]) -> None:
    text = "".join(f"{json.dumps(row, ensure_ascii=False)}\n" for row in rows)
    path.write_text(text, "utf-8")


# --- taking files apart --------------------------------------------------------------------------


def data_files(folder: Path) -> list[Path]:
    return sorted((folder / "data").glob("*/*.parquet"))


def edit_info(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    path = folder / "meta/info.json"
    info = json.loads(path.read_text())
    change(info)
    path.write_text(json.dumps(info))


def edit_table(path: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    parquet.write_table(change(parquet.read_table(path)), path)


def replaced(table: pa.Table, name: str, values: pa.Array) -> pa.Table:
    return table.set_column(table.schema.names.index(name), name, values)


def otherwise(folder: Path, copy: Path, names: dict[str, str]) -> Path:
    """A copy of a dataset whose features and joints have other names.

    Its pictures are in its data files.
    """
    shutil.copytree(folder, copy)

    def rename(info: dict[str, Any]) -> None:
        for feature in info["features"].values():
            if isinstance(feature["names"], list):
                feature["names"] = [names.get(name, name) for name in feature["names"]]
        info["features"] = {names.get(name, name): f for name, f in info["features"].items()}

    edit_info(copy, rename)
    for path in data_files(copy):
        edit_table(path, lambda t: t.rename_columns([names.get(n, n) for n in t.schema.names]))
    return copy


class ReachArm:
    """What LeRobot's robots provide, for `reach`'s arm, which does not move.

    Attributes:
        sent: the actions, in order.
    """

    def __init__(self) -> None:
        self.spec = sim.make("reach").spec
        self.is_connected, self.sent = False, list[dict[str, float]]()

    def connect(self) -> None:
        self.is_connected = True

    def disconnect(self) -> None:
        self.is_connected = False

    def get_observation(self) -> dict[str, Any]:
        assert self.is_connected
        seen = dict.fromkeys(reversed(self.spec.proprio_names), 0.1)
        return {**seen, self.spec.camera: np.zeros((48, 64, 3), np.uint8)}

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        assert self.is_connected and tuple(action) == self.spec.action_names
        assert all(type(x) is float for x in action.values())
        self.sent.append(action)
        return action
