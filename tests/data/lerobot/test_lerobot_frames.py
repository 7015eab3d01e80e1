"""Frames of videos found by their time, and resized to the backbone's input."""

from __future__ import annotations

import dataclasses
import math
import os
import sys
from pathlib import Path

import av
import numpy as np
import pyarrow as pa
import pytest
from numpy.lib import format as npy
from PIL import Image
from pyarrow import parquet
from samples.lerobot import edit_table, episodes, frames, read, replaced, save

from aegis_cli.common import cache
from aegis_cli.common.errors import AegisError
from aegis_cli.common.pictures import GREY
from aegis_cli.data.lerobot import dataset, rows, source, video
from aegis_cli.data.lerobot import frames as camera_frames
from aegis_cli.data.lerobot.write import NewEpisode

pytestmark = pytest.mark.usefixtures("frame_cache")

EPISODES = "meta/episodes/chunk-000/file-000.parquet"
DATA = "data/chunk-000/file-000.parquet"

# --- video ---------------------------------------------------------------------------------------


def test_frames_are_found_by_their_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """This includes episodes longer than a part of the decoding, with key frames far apart."""
    made = episodes(40, size=(16, 16), smooth=True, seed=3)
    folder = save(tmp_path / "d", made, as_video=True)
    path = folder / "videos/observation.images.top/chunk-000/file-000.mp4"
    whole = frames(made)
    reencode(path, gop=1000)
    monkeypatch.setattr(camera_frames, "_PART", 8)
    found = source.find(dataset.load(folder))
    index = rows.read_index(found)
    parts = list(camera_frames.split(found, index, "observation.images.top"))
    assert len(parts) > 1 and sum(part.count for part in parts) == len(whole)
    numbers = [0, 3, 4, len(whole) // 2, len(whole) - 1]
    for number, frame in zip(
        numbers, camera_frames.pick(found, index, "observation.images.top", numbers), strict=True
    ):
        np.testing.assert_allclose(frame.mean((0, 1)), whole[number].mean((0, 1)), atol=12)
    np.testing.assert_allclose(read(folder).mean((1, 2)), whole.mean((1, 2)), atol=12)


def test_frames_of_open_groups_are_found_wherever_reading_begins(tmp_path: Path) -> None:
    """HEVC as its encoder makes it: some pictures are shown before a key frame.

    They refer to the group before it.
    """
    path, noise = (
        tmp_path / "v.mp4",
        np.random.default_rng(0).integers(0, 256, (40, 40, 3), dtype=np.uint8),
    )
    scene = np.array(Image.fromarray(noise).resize((200, 200), Image.Resampling.BICUBIC))
    encode(
        path,
        [np.ascontiguousarray(scene[i : i + 64, i // 2 : i // 2 + 64]) for i in range(60)],
        gop=10,
        codec="libx265",
    )
    times = [i / 10 for i in range(60)]
    for time, frame in zip(times, video.read(path, times, 0.05), strict=True):
        (alone,) = video.read(path, [time], 0.05)
        assert np.array_equal(alone, frame)


def test_what_a_killed_decoding_left_is_removed_by_the_next(tmp_path: Path) -> None:
    """It may be of another dataset, which might never be decoded again, and takes as much space."""
    folder = cache.folder("frames")
    folder.mkdir(parents=True)
    left, own = folder / ".0123456789abcdef.npy.12345.tmp", folder / "mine.tmp"
    left.write_bytes(b"half")
    own.write_bytes(b"mine")
    read(save(tmp_path / "d", episodes(2)))
    assert not left.exists() and own.exists()


def reencode(path: Path, gop: int) -> None:
    with av.open(str(path)) as container:
        pictures = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    encode(path, pictures, gop, "libx264")


def encode(path: Path, pictures: list[np.ndarray], gop: int, codec: str) -> None:
    with av.open(str(path), "w", format="mp4") as out:
        stream = out.add_stream(
            codec, rate=10, options={"g": str(gop), "crf": "18"}
        )  # with frames out of order
        stream.height, stream.width, stream.pix_fmt = *pictures[0].shape[:2], "yuv420p"
        for picture in pictures:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        out.mux(stream.encode())


@pytest.mark.parametrize(("shift", "fine"), [(0.4, True), (-0.4, True), (0.6, False)])
def test_the_tolerance_is_half_a_frame(shift: float, fine: bool, tmp_path: Path) -> None:
    """A clock that is off by less still finds every frame; by more, the last frame is missing."""
    made = episodes(1, size=(16, 16), smooth=True)
    folder = save(tmp_path / "d", made, as_video=True)
    path = folder / "meta/episodes/chunk-000/file-000.parquet"
    table = parquet.read_table(path)
    name = "videos/observation.images.top/from_timestamp"
    parquet.write_table(
        table.set_column(table.schema.names.index(name), name, pa.array([shift / 10])), path
    )
    if fine:
        np.testing.assert_allclose(read(folder).mean((1, 2)), frames(made).mean((1, 2)), atol=12)
        return
    with pytest.raises(AegisError, match="1 frame of episode 0 .* past the end of its video"):
        read(folder)
    table = parquet.read_table(path)
    end = "videos/observation.images.top/to_timestamp"
    parquet.write_table(table.drop_columns([end]), path)  # as if no end were stated
    with pytest.raises(AegisError, match=r"no frame at 0\.460 s"):
        read(folder)


@pytest.mark.parametrize(
    ("what", "past"),
    [("a gap", 10), ("a late begin", 2), ("lost frames", 2), ("a slow clock", 1), (None, 0)],
)
def test_no_episode_has_pictures_of_another_one(
    what: str | None, past: int, tmp_path: Path
) -> None:
    """The episodes' videos are in one file, one after the other."""
    made = [whole(number) for number in range(3)]
    folder = save(tmp_path / "d", made, as_video=True)
    times = np.arange(20) / 10
    if what == "a gap":
        times[10:] += 1.0
    elif what == "a late begin":
        times += 0.2
    elif what == "a slow clock":
        times *= 1.05
    elif what == "lost frames":
        edit_table(folder / EPISODES, lambda table: ending(table, 1, -0.2))
    edit_table(folder / DATA, lambda table: timed(table, 1, times))
    if what is None:
        np.testing.assert_allclose(read(folder).mean((1, 2)), frames(made).mean((1, 2)), atol=12)
        return
    said = "1 frame" if past == 1 else f"{past} frames"
    with pytest.raises(
        AegisError, match=f"{said} of episode 1 .* timestamps past the end of its video"
    ):
        read(folder)
    found = source.find(dataset.load(folder))
    with pytest.raises(AegisError, match="with timestamps past the end of its video"):
        list(camera_frames.pick(found, rows.read_index(found), "observation.images.top", [0]))
    found = source.find(dataset.load(folder), [0, 2])  # without it
    assert list(camera_frames.split(found, rows.read_index(found), "observation.images.top"))


def whole(number: int) -> NewEpisode:
    """An episode of 20 frames, all of one colour that identifies it."""
    (plain,) = episodes(1, size=(16, 16), smooth=True, seed=number)
    return dataclasses.replace(
        plain,
        frames={"top": np.full((20, 16, 16, 3), 40 + 80 * number, np.uint8)},
        state=np.resize(plain.state, (20, plain.state.shape[1])),
        actions=np.resize(plain.actions, (20, plain.actions.shape[1])),
    )


def ending(table: pa.Table, episode: int, later_s: float) -> pa.Table:
    """The same episodes, with one episode's video ending later."""
    name = "videos/observation.images.top/to_timestamp"
    ends = table[name].to_pylist()
    ends[episode] += later_s
    return replaced(table, name, pa.array(ends))


def timed(table: pa.Table, episode: int, times: np.ndarray) -> pa.Table:
    """The same frames, with those of one episode at these times."""
    own = np.array(table["timestamp"].to_pylist(), np.float32)
    own[np.array(table["episode_index"].to_pylist()) == episode] = times
    return replaced(table, "timestamp", pa.array(own))


# --- sizes ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(64, 64), (30, 90), (90, 31), (8, 8)])
def test_frames_are_fitted_whole_into_a_square(size: tuple[int, int], tmp_path: Path) -> None:
    made = episodes(2, size=size, smooth=True)
    fitted, plain = read(save(tmp_path / "d", made), side=64), frames(made)
    assert fitted.shape == (len(plain), 64, 64, 3)
    inner = [max(1, round(64 * s / max(size))) for s in size]
    shown = (fitted == plain[:, :1, :1]).all(-1)
    assert (
        shown.sum((1, 2)) >= math.prod(inner)
    ).all()  # the whole picture, of one colour each; the rest is grey
    assert ((fitted == GREY).all(-1) | shown).all()
    if size == (64, 64):
        np.testing.assert_array_equal(fitted, plain)


def test_a_reduction_averages_over_what_it_leaves_out(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    made = episodes(1, size=(128, 128))
    made[0].frames["top"][:] = rng.integers(0, 2, (5, 128, 128, 1), dtype=np.uint8) * 255
    assert read(save(tmp_path / "d", made), side=8).std() < 20  # a single pixel's is 127


@pytest.mark.skipif(sys.platform != "linux", reason="other systems charge for a private mapping")
def test_frames_need_not_fit_into_memory(tmp_path: Path) -> None:
    """A sparse file with more frames than fit in memory; one is read and written."""
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    count = 2 * memory // (256 * 256 * 3) + 1
    path = tmp_path / "frames.npy"
    try:
        npy.open_memmap(path, "w+", np.uint8, (count, 256, 256, 3))
    except OSError as error:
        pytest.skip(f"no room for a sparse file here: {error}")
    found = camera_frames._open(path, count)
    found[-1] = 255
    assert found.shape == (count, 256, 256, 3) and found[-1].all() and not found[0].any()
    assert not camera_frames._open(path, count)[-1].any()
