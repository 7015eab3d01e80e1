"""Written data follows the rules of LeRobot's format v3.0, and is read back unchanged."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet
from samples.lerobot import (
    STATE,
    TEXTS,
    data_files,
    edit_info,
    episodes,
    frames,
    joined,
    read,
)
from samples.lerobot import written as save  # what is tested is how it is written

from aegis_cli.common.errors import AegisError
from aegis_cli.data.lerobot import dataset, layout, rows, source, version_3, write
from aegis_cli.data.lerobot.write import Limits

pytestmark = pytest.mark.usefixtures("frame_cache")

INDEX = {
    "timestamp": "float",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
CAMERAS = ("top", "wrist")
SMALL = Limits(files_per_chunk=2, data_mb=1, video_mb=1)
FIGURES = {"min", "max", "mean", "std", "count", "q01", "q10", "q50", "q90", "q99"}


@pytest.fixture
def tiny_files(monkeypatch: pytest.MonkeyPatch) -> int:
    """Make a megabyte a few bytes, so that few frames fill several files."""
    monkeypatch.setattr(write, "_MB", 15_000)
    return 15_000


@pytest.fixture
def tinier_files(monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(write, "_MB", 3_000)
    return 3_000


def meta(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "meta/info.json").read_text())


def episode_rows(folder: Path) -> list[dict[str, Any]]:
    return parquet.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()


# --- rules ---------------------------------------------------------------------------------------


def check_data(folder: Path, limit: int) -> None:
    """Rows are numbered without gaps, and each episode's rows are in one row group of its file."""
    info, listed, start = meta(folder), episode_rows(folder), 0
    files = {path: parquet.ParquetFile(path) for path in data_files(folder)}
    table = pa.concat_tables([file.read() for file in files.values()]).to_pydict()
    assert table["index"] == list(range(info["total_frames"]))
    for number, row in enumerate(listed):
        span = slice(row["dataset_from_index"], row["dataset_to_index"])
        assert (row["episode_index"], span.start, span.stop - span.start) == (
            number,
            start,
            row["length"],
        )
        assert table["episode_index"][span] == [number] * row["length"]
        assert table["frame_index"][span] == list(range(row["length"]))
        np.testing.assert_array_equal(
            np.float32(table["timestamp"][span]), np.float32(np.arange(row["length"]) / info["fps"])
        )
        path = folder / info["data_path"].format(
            chunk_index=row["data/chunk_index"], file_index=row["data/file_index"]
        )
        assert number in files[path].read(columns=["episode_index"]).column(0).to_pylist()
        start = span.stop
    assert (start, len(listed)) == (info["total_frames"], info["total_episodes"])
    assert info["splits"] == {"train": f"0:{len(listed)}"}
    for path, file in files.items():
        assert file.metadata.num_row_groups == len(
            set(file.read(columns=["episode_index"]).column(0).to_pylist())
        )
        groups = [file.metadata.row_group(i) for i in range(file.metadata.num_row_groups)]
        written = sum(
            group.column(i).total_compressed_size
            for group in groups
            for i in range(group.num_columns)
        )
        assert written < limit * 1.5 or len(groups) == 1, (
            path
        )  # a row's size is estimated by the mean


def check_places(places: list[tuple[int, int]], per_chunk: int) -> None:
    """Files are numbered within their chunk, without gaps."""
    numbers = [chunk * per_chunk + file for chunk, file in places]
    assert numbers == sorted(numbers) and set(numbers) == set(range(numbers[-1] + 1))
    assert all(file < per_chunk for _, file in places)


def check_videos(folder: Path, camera: str) -> None:
    """Each file holds exactly its episodes, one after the other from 0 s."""
    info, key, ends = meta(folder), f"videos/observation.images.{camera}", {}
    for row in episode_rows(folder):
        place = row[f"{key}/chunk_index"], row[f"{key}/file_index"]
        assert row[f"{key}/from_timestamp"] == pytest.approx(ends.get(place, 0.0))
        assert row[f"{key}/to_timestamp"] - row[f"{key}/from_timestamp"] == pytest.approx(
            row["length"] / info["fps"]
        )
        ends[place] = row[f"{key}/to_timestamp"]
    check_places(list(ends), info["chunks_size"])
    for (chunk, file), end in ends.items():
        path = info["video_path"].format(
            video_key=f"observation.images.{camera}", chunk_index=chunk, file_index=file
        )
        with av.open(str(folder / path)) as container:
            times = [float(f.pts * f.time_base) for f in container.decode(video=0)]
        assert times == pytest.approx(np.arange(round(end * info["fps"])) / info["fps"])
    assert len(ends) == len(list((folder / f"videos/observation.images.{camera}").glob("*/*.mp4")))


def test_one_file_with_every_feature(tmp_path: Path) -> None:
    made = episodes()
    folder = save(tmp_path / "d", made)
    info = meta(folder)
    check_data(folder, 10**9)
    assert (info["codebase_version"], info["fps"], info["robot_type"], info["video_path"]) == (
        "v3.0",
        10,
        "arm",
        None,
    )
    assert (info["chunks_size"], info["data_files_size_in_mb"], info["video_files_size_in_mb"]) == (
        1000,
        100,
        200,
    )
    assert list(info["features"]) == [
        "observation.state",
        "action",
        "observation.images.top",
        *INDEX,
    ]
    assert info["features"]["observation.state"] == {
        "dtype": "float32",
        "shape": [3],
        "names": list(STATE),
    }
    assert info["features"]["observation.images.top"] == {
        "dtype": "image",
        "shape": [16, 24, 3],
        "names": ["height", "width", "channels"],
    }
    schema = parquet.read_schema(data_files(folder)[0])
    assert {name: str(schema.field(name).type) for name in INDEX} == INDEX
    assert (
        str(schema.field("action").type).startswith("fixed_size_list<")
        and schema.field("action").type.list_size == 2
    )
    assert schema.field("observation.images.top").type == pa.struct(
        [("bytes", pa.binary()), ("path", pa.string())]
    )
    assert json.loads(schema.metadata[b"huggingface"])["info"]["features"][
        "observation.images.top"
    ] == {"_type": "Image"}


def test_tasks_are_the_index_of_a_pandas_table(tmp_path: Path) -> None:
    made = episodes(4)
    folder = save(tmp_path / "d", made)
    table = parquet.read_table(folder / "meta/tasks.parquet")
    assert table.to_pydict() == {"task_index": [0, 1, 2], "task": list(TEXTS)}
    assert json.loads(table.schema.metadata[b"pandas"])["index_columns"] == ["task"]
    assert [row["tasks"] for row in episode_rows(folder)] == [[e.instruction] for e in made]
    assert meta(folder)["total_tasks"] == 3


def test_statistics_of_every_feature_for_all_and_each_episode(tmp_path: Path) -> None:
    made = episodes(cameras=CAMERAS)
    folder = save(tmp_path / "d", made)
    stats, listed = json.loads((folder / "meta/stats.json").read_text()), episode_rows(folder)
    assert stats.keys() == meta(folder)["features"].keys()
    shapes = {
        "observation.state": (3,),
        "action": (2,),
        **{f"observation.images.{c}": (3, 1, 1) for c in CAMERAS},
    }
    for name, figures in stats.items():
        assert figures.keys() == FIGURES
        for figure, value in figures.items():
            expected = (1,) if figure == "count" else shapes.get(name, (1,))
            assert np.shape(value) == expected
            assert all(np.shape(row[f"stats/{name}/{figure}"]) == expected for row in listed)
    actions = joined(made)[1].astype(np.float64)
    np.testing.assert_allclose(stats["action"]["mean"], actions.mean(0), atol=1e-9)
    np.testing.assert_allclose(stats["action"]["std"], actions.std(0), atol=1e-9)
    assert stats["action"]["count"] == [len(actions)]
    np.testing.assert_allclose(listed[2]["stats/action/max"], made[2].actions.max(0))


@pytest.mark.parametrize("seed", range(2))
def test_several_files_and_chunks_of_images(seed: int, tmp_path: Path, tiny_files: int) -> None:
    made = episodes(14, CAMERAS, seed=seed)
    folder = save(tmp_path / "d", made, SMALL)
    check_data(folder, tiny_files)
    check_places(
        [(row["data/chunk_index"], row["data/file_index"]) for row in episode_rows(folder)], 2
    )
    assert len({path.parent for path in data_files(folder)}) >= 2
    assert not (folder / "videos").exists()
    for camera in CAMERAS:
        assert_same(folder, made, camera)


def test_several_files_and_chunks_of_videos(tmp_path: Path, tinier_files: int) -> None:
    made = episodes(50, CAMERAS, (32, 48), smooth=True)
    folder = save(tmp_path / "d", made, SMALL, as_video=True)
    check_data(folder, tinier_files)
    for camera in CAMERAS:
        check_videos(folder, camera)
        assert len(list((folder / f"videos/observation.images.{camera}").glob("*"))) >= 2
        found = read(folder, camera)
        np.testing.assert_allclose(found.mean((1, 2)), frames(made, camera).mean((1, 2)), atol=12)
    assert meta(folder)["features"]["observation.images.top"]["info"]["video.codec"] == "h264"


# --- round trips ---------------------------------------------------------------------------------


def assert_same(folder: Path, made: list[write.NewEpisode], camera: str | None = None) -> None:
    found = dataset.load(folder)
    chosen, (state, actions, texts) = source.find(found), joined(made)
    index = rows.read_index(chosen)
    assert [episode.length for episode in found.episodes] == [len(e.actions) for e in made]
    assert [found.tasks[i] for i in index.task] == texts
    np.testing.assert_array_equal(rows.read_vectors(chosen, layout.STATE), state)
    np.testing.assert_array_equal(rows.read_vectors(chosen, layout.ACTION), actions)
    np.testing.assert_array_equal(read(folder, camera), frames(made, camera or "top"))


@pytest.mark.parametrize("seed", range(3))
def test_a_round_trip_loses_nothing(seed: int, tmp_path: Path) -> None:
    made = episodes(6, seed=seed)
    assert_same(save(tmp_path / "d", made), made)


def test_more_episodes_than_are_written_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(write, "_BUFFERED", 2)
    made = episodes(5)
    assert_same(save(tmp_path / "d", made), made)


def test_one_state_and_one_action(tmp_path: Path) -> None:
    """LeRobot keeps vectors of one number as plain numbers."""
    made = [
        write.NewEpisode(e.frames, e.state[:, :1], e.actions[:, :1], e.instruction)
        for e in episodes()
    ]
    folder = save(tmp_path / "d", made, state_names=("x",), action_names=("dx",))
    assert str(parquet.read_schema(data_files(folder)[0]).field("action").type) == "float"
    assert_same(folder, made)


def test_equal_episodes_give_equal_bytes(tmp_path: Path) -> None:
    for as_video in (False, True):
        made = episodes(3, CAMERAS, (32, 32), smooth=True)
        one, other = (
            save(tmp_path / f"{name}{as_video}", made, as_video=as_video) for name in "ab"
        )
        contents = [
            {p.relative_to(f): p.read_bytes() for p in f.rglob("*") if p.is_file()}
            for f in (one, other)
        ]
        assert contents[0] == contents[1] and len(contents[0]) > 3


def test_what_other_writers_do_differently(tmp_path: Path) -> None:
    """The layouts of other writers are read too.

    They have lists of variable length, float64, large row groups, an unnamed pandas index, several
    episode files, or no statistics.
    """
    made = episodes(6)
    folder = save(tmp_path / "d", made)
    path = data_files(folder)[0]
    table = parquet.read_table(path)
    loose = pa.array(table.column("action").to_pylist(), pa.list_(pa.float64()))
    parquet.write_table(table.set_column(1, "action", loose), path, row_group_size=7)
    tasks = parquet.read_table(folder / version_3.TASKS).rename_columns(
        ["task_index", "__index_level_0__"]
    )
    parquet.write_table(tasks, folder / version_3.TASKS)
    first = folder / "meta/episodes/chunk-000/file-000.parquet"
    listed = parquet.read_table(first)
    parquet.write_table(listed.slice(4), first.with_name("file-001.parquet"))
    parquet.write_table(listed.slice(0, 4), first)
    (folder / layout.STATS).unlink()
    edit_info(folder, lambda info: info.pop("robot_type"))
    assert_same(folder, made)
    assert dataset.load(folder).stats is None and dataset.load(folder).info.task is None


# --- whole or absent -----------------------------------------------------------------------------


def test_a_recording_that_fails_leaves_nothing(tmp_path: Path) -> None:
    def failing() -> Any:
        yield episodes()[0]
        raise KeyboardInterrupt

    for as_video in (False, True):
        with pytest.raises(KeyboardInterrupt):
            save(tmp_path / "d", failing(), as_video=as_video)
        assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("there", [True, False])
def test_a_linked_folder_is_followed_and_the_link_stays(there: bool, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to("disk")
    if there:
        (tmp_path / "disk").mkdir()
    save(tmp_path / "link", episodes(2))
    assert (tmp_path / "link").readlink() == Path("disk")
    assert (tmp_path / "disk" / "meta" / "info.json").is_file()
    assert len(list(tmp_path.iterdir())) == 2


def test_a_folder_that_another_process_has_written_meanwhile_stays(tmp_path: Path) -> None:
    def slow() -> Any:
        yield from episodes(2)
        save(tmp_path / "d", episodes(1))

    with pytest.raises(AegisError, match="another process wrote in the meantime"):
        save(tmp_path / "d", slow())
    assert list(tmp_path.iterdir()) == [tmp_path / "d"]
    assert len(dataset.load(tmp_path / "d").episodes) == 1


def test_what_a_killed_recording_left_is_removed_by_the_next(tmp_path: Path) -> None:
    (tmp_path / ".d.12345.tmp" / "data").mkdir(parents=True)
    save(tmp_path / "d", episodes(2))
    assert list(tmp_path.iterdir()) == [tmp_path / "d"]


def test_a_name_as_long_as_a_file_system_takes(tmp_path: Path) -> None:
    assert save(tmp_path / ("x" * 255)) == next(tmp_path.iterdir())


def test_the_folder_that_one_is_in_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(AegisError, match="names no folder"):
        write.check_new(Path("."))


def test_an_empty_folder_is_filled_and_another_left_alone(tmp_path: Path) -> None:
    (tmp_path / "d").mkdir()
    save(tmp_path / "d")
    with pytest.raises(AegisError, match="exists"):
        save(tmp_path / "d")
    assert [p.name for p in tmp_path.iterdir()] == ["d"]


@pytest.mark.parametrize(
    ("names", "components"),
    [
        (["dx", "dy"], ("dx", "dy")),
        ({"motors": ["dx", "dy"]}, ("dx", "dy")),
        ({"dy": 1, "dx": 0}, ("dx", "dy")),  # as in LeRobot's teleoperators that move the hand
        ({"dx": 0, "dy": 2}, ("", "")),
        ({"dx": 0, "dy": 1, "dz": 2}, ("", "")),
        ({"dx": 0, "dy": 0}, ("", "")),
        (["state"], ("", "")),
        (None, ("", "")),
    ],
)
def test_a_features_names_are_a_list_or_places(names: Any, components: tuple[str, ...]) -> None:
    assert layout.Feature("float32", (2,), names, False).components == components
