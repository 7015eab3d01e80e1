"""Datasets that cannot be learned from: exit 2, one error, and nothing half-written."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet
from samples.lerobot import (
    READABLE,
    data_files,
    edit_info,
    edit_table,
    episodes,
    replaced,
    save,
)
from samples.user_folder import LFS_POINTER, TRAIN, training

from aegis_cli.data import demonstrations
from aegis_cli.data.lerobot import layout, write
from aegis_cli.data.lerobot.write import Limits
from aegis_cli.data.selection import Selection

pytestmark = pytest.mark.usefixtures("frame_cache")

FROM_FOLDER = training(demos="d")
IMAGE, VIDEO = (
    "data/chunk-000/file-000.parquet",
    "videos/observation.images.top/chunk-000/file-000.mp4",
)
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
Bad = Callable[..., str]


@pytest.fixture(scope="session")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save(tmp_path_factory.mktemp("images") / "d", episodes(texts=READABLE))


@pytest.fixture(scope="session")
def videos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save(
        tmp_path_factory.mktemp("videos") / "d",
        episodes(size=(64, 64), smooth=True, texts=READABLE),
        as_video=True,
    )


@pytest.fixture
def folder(place: Path, images: Path) -> Path:
    return shutil.copytree(images, place / "d")


@pytest.fixture
def filmed(place: Path, videos: Path) -> Path:
    return shutil.copytree(videos, place / "d")


# --- no dataset, or another version --------------------------------------------------------------


@pytest.mark.parametrize(
    "command", [FROM_FOLDER, ("inspect", "d"), ("inspect", "d", "--plot", "sheet.png")]
)
@pytest.mark.parametrize(
    ("version", "says"),
    [
        ("v1.6", "to version 2.0 with a release"),
        ("v4.0", "upgrade aegis"),
    ],
)
def test_another_version(
    version: str, says: str, command: tuple[str, ...], bad: Bad, folder: Path
) -> None:
    edit_info(folder, lambda info: info.update(codebase_version=version))
    bad(*command, says=(version, "version 2.0, 2.1 or 3.0", says))


def test_a_folder_that_is_no_dataset(bad: Bad, place: Path) -> None:
    (place / "d").mkdir()
    bad(*FROM_FOLDER, says=("'d' is no dataset folder", "meta/info.json"))
    bad("run", "small.yaml", "--set", "demos.path=d", says=("'d' is no dataset folder",))
    bad("run", "small.yaml", "--set", "demos.path=nothing", says=("nothing",))
    bad("inspect", "d", says=("LeRobot",))


@pytest.mark.parametrize("name", ["meta/info.json", IMAGE])
def test_a_file_of_a_dataset_in_place_of_its_folder(name: str, bad: Bad, folder: Path) -> None:
    commands = (
        training(demos=f"d/{name}"),
        ("run", "small.yaml", "--set", f"demos.path=d/{name}"),
        ("anchor", "--demos", f"d/{name}", "--out", "a.safetensors"),
    )
    for command in commands:
        bad(*command, says=(f"'d/{name}', a file of a LeRobot dataset", f"give '{folder}'"))


def test_a_path_that_is_no_text_is_not_called_damage(bad: Bad, folder: Path) -> None:
    moved = folder.rename(folder.with_name(os.fsdecode(b"caf\xe9")))
    for command in (training(demos=str(moved)), ("inspect", moved)):
        assert "damaged" not in bad(*command, says=("caf\\udce9", "not UTF-8", "rename"))


@pytest.mark.parametrize("command", [FROM_FOLDER, ("inspect", "d")])
@pytest.mark.parametrize("missing", ["meta/info.json", "meta/tasks.parquet", EPISODES])
def test_a_missing_meta_file(
    missing: str, command: tuple[str, ...], bad: Bad, folder: Path
) -> None:
    (folder / missing).unlink()
    bad(*command, says=("d/" + missing.split("/chunk")[0] if missing == EPISODES else missing,))


@pytest.mark.parametrize("command", [FROM_FOLDER, ("inspect", "d")])
def test_a_recording_that_was_broken_off(command: tuple[str, ...], bad: Bad, folder: Path) -> None:
    """LeRobot writes the rows of episodes last: a recording that was killed has none."""
    (folder / EPISODES).unlink()
    bad(*command, says=("which LeRobot writes when a recording ends", "record it again"))
    (folder / "meta/tasks.parquet").unlink()
    edit_info(folder, lambda info: info.update(total_episodes=0, total_frames=0))
    bad(*command, says=("no episode in 'd'", "ended before one was saved", "record it again"))


def rename_camera(name: str) -> Callable[[dict[str, Any]], None]:
    """Rename the camera to a video of that name, whose file's path contains the name."""

    def change(info: dict[str, Any]) -> None:
        features = info["features"]
        features[name] = features.pop("observation.images.top") | {"dtype": "video"}
        info["video_path"] = "{video_key}/{chunk_index:03d}.mp4"

    return change


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda info: info.pop("fps"), "no 'fps'"),
        (lambda info: info.update(fps=0), "fps is 0"),
        (lambda info: info.update(fps=float("inf")), "fps is inf"),
        (lambda info: info.update(total_episodes=float("inf")), "info.json' is damaged"),
        (
            lambda info: info["features"]["action"].update(shape=[float("inf")]),
            "info.json' is damaged",
        ),
        (lambda info: info.update(robot_type=5), "robot_type is 5"),
        (lambda info: info.update(features=5), "info.json"),
        (lambda info: info["features"]["action"].pop("shape"), "no 'shape'"),
        (lambda info: info.update(codebase_version="three"), "three"),
        (lambda info: info.update(data_path="data/{file}"), "no 'file'"),
        (lambda info: info.update(data_path="../{chunk_index}/{file_index}"), "leaves the folder"),
        (lambda info: info.update(data_path="data/{chunk_index.real}"), "no 'chunk_index.real'"),
        (lambda info: info.update(data_path="data/{}"), "no ''"),
        (lambda info: info.update(data_path="data/{chunk_index:0999999999d}"), "format of its own"),
        (lambda info: info.update(data_path="data/{chunk_index!r}"), "format of its own"),
        (lambda info: info.update(data_path="data/{chunk_index:{file_index}}"), "format of its"),
        (lambda info: info.update(data_path="data/{chunk_index"), "info.json' is damaged"),
        (lambda info: info.update(data_path="/data/{chunk_index}"), "leaves the folder"),
        (lambda info: info.update(data_path="a\0b"), "leaves the folder"),
        (rename_camera("../../../outside"), "leaves the folder"),
        (rename_camera("/outside"), "leaves the folder"),
        (lambda info: info.update(total_episodes=6), "episode 5 is missing"),
        (lambda info: info.update(total_episodes=2**63), "episode 5 is missing"),
        (lambda info: info.update(total_frames=1), "1, as meta/info.json says"),
    ],
)
def test_an_info_file_that_is_not_sound(
    change: Callable, says: str, bad: Bad, folder: Path
) -> None:
    edit_info(folder, change)
    bad(*FROM_FOLDER, says=("'d", says))


def test_files_that_are_no_json(bad: Bad, folder: Path) -> None:
    for name, command in (("stats", ("inspect", "d")), ("info", FROM_FOLDER)):
        path = folder / f"meta/{name}.json"
        path.write_text(path.read_text()[:-20])
        bad(*command, says=(f"{name}.json", "not JSON"))
    (folder / "meta/info.json").write_text("[]")
    bad(*FROM_FOLDER, says=("info.json' is damaged",))


# --- features ------------------------------------------------------------------------------------


def test_a_camera_has_to_be_chosen(bad: Bad, place: Path) -> None:
    save(place / "d", episodes(cameras=("top", "wrist")))
    both = ("observation.images.top", "observation.images.wrist")
    bad(*FROM_FOLDER, says=("2 cameras", *both, "--set demos.camera="))
    bad(*FROM_FOLDER, "--set", "demos.camera=front", says=("no camera 'front'", *both))
    bad(
        *TRAIN, "--set", "demos.camera=top", says=("demos.safetensors", "leave demos.camera", "out")
    )
    of_anchor = ("anchor", "--demos", "d", "--out", "a.safetensors")
    bad(*of_anchor, says=("2 cameras", "aegis anchor: --camera observation.images.top,"))
    bad(*of_anchor, "--camera", "front", says=("no camera 'front'", "aegis anchor: --camera"))
    bad(*of_anchor, "--camera", "top", "--camera", "top", says=("twice", "--camera of aegis"))
    file = ("anchor", "--demos", "demos.safetensors", "--out", "a.safetensors")
    bad(*file, "--camera", "top", says=("demos.safetensors", "(of aegis anchor: --camera) out"))
    several = (
        "top, wrist with a backbone that reads one image",
        "Hugging Face",
        "--set demos.camera=top",
    )
    bad(*FROM_FOLDER, "--set", "demos.camera=[top, wrist]", says=several)


def test_a_dataset_without_a_camera(bad: Bad, folder: Path) -> None:
    edit_info(folder, lambda info: info["features"].pop("observation.images.top"))
    bad(*FROM_FOLDER, says=("0 cameras", "pictures"))
    bad("inspect", "d", "--plot", "s.png", says=("no camera",))


@pytest.mark.parametrize("feature", ["observation.state", "action"])
def test_a_missing_feature(feature: str, bad: Bad, folder: Path) -> None:
    edit_info(folder, lambda info: info["features"].pop(feature))
    bad(*FROM_FOLDER, says=(f"no feature '{feature}'", "observation.images.top"))


@pytest.mark.parametrize(
    "feature", ["observation.state", "action", "observation.images.top", "task_index"]
)
def test_a_missing_column(feature: str, bad: Bad, folder: Path) -> None:
    edit_table(folder / IMAGE, lambda table: table.drop_columns([feature]))
    bad(*FROM_FOLDER, says=(f"no column '{feature}'", IMAGE))


@pytest.mark.parametrize("loose", [False, True])
def test_an_action_size_that_changes_between_files(
    loose: bool, bad: Bad, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(write, "_MB", 10_000)
        last = data_files(save(place / "d", limits=Limits(data_mb=1)))[-1]
    assert last.name != "file-000.parquet"

    def widen(table: pa.Table) -> pa.Table:
        values = [[*action, 0.0] for action in table.column("action").to_pylist()]
        return replaced(
            table, "action", pa.array(values, pa.list_(pa.float32(), -1 if loose else 3))
        )

    edit_table(last, widen)
    bad(*FROM_FOLDER, says=("'action'", last.name, "3 numbers per row", "2, as meta/info.json"))


def test_a_task_without_a_text(bad: Bad, folder: Path) -> None:
    edit_table(folder / "meta/tasks.parquet", lambda table: table.slice(0, 0))
    bad(*FROM_FOLDER, says=("task_index", "tasks.parquet"))


def test_a_text_that_the_backbone_cannot_read_is_found_before_anything_is_decoded(
    bad: Bad, place: Path
) -> None:
    folder = save(place / "d", episodes(size=(64, 64), smooth=True), as_video=True)
    (folder / VIDEO).write_bytes(b"no video")
    bad(*FROM_FOLDER, says=("'grüße'", "embedded model knows", "a Hugging Face model"))


def test_a_text_of_other_episodes_than_those_that_are_learned_from_does_not_matter(
    place: Path, aegis: Any
) -> None:
    save(place / "d", episodes(3))
    command = (*FROM_FOLDER, "--set", "demos.only=0-1", "--set", "train.steps=1")
    code, _, err = aegis(*command)
    assert code == 0, err


def test_an_anchor_that_is_missing_is_told_before_anything_is_decoded(
    bad: Bad, filmed: Path
) -> None:
    (filmed / VIDEO).write_bytes(b"no video")
    without = list(training(demos="d", method="nullspace"))
    at = without.index("--anchor")
    del without[at : at + 2]
    bad(*without, says=("no anchor for method 'nullspace'",))


# --- rows ----------------------------------------------------------------------------------------


def test_missing_episode_rows(bad: Bad, folder: Path) -> None:
    edit_table(
        folder / EPISODES, lambda table: pa.concat_tables([table.slice(0, 2), table.slice(3)])
    )
    bad(*FROM_FOLDER, says=("episode 2 is missing", "each of 5 episodes"))


def test_missing_frames(bad: Bad, folder: Path) -> None:
    edit_table(folder / IMAGE, lambda table: table.slice(1))
    bad(*FROM_FOLDER, says=("4 rows of episode 0", IMAGE, "5 rows one after the other"))


def test_frames_out_of_place(bad: Bad, folder: Path) -> None:
    edit_table(folder / IMAGE, lambda table: table.take([1, 0, *range(2, len(table))]))
    bad(*FROM_FOLDER, says=("row 0", IMAGE, "frame 1 of episode 0"))


def test_episodes_that_do_not_follow_each_other(bad: Bad, folder: Path) -> None:
    def shift(table: pa.Table) -> pa.Table:
        for name in ("dataset_from_index", "dataset_to_index"):
            values = table.column(name).to_numpy() + np.array([0, 0, 1, 0, 0])
            table = replaced(table, name, pa.array(values))
        return table

    edit_table(folder / EPISODES, shift)
    bad(*FROM_FOLDER, says=("episode 2 begins at",))


@pytest.mark.parametrize("feature", ["action", "observation.state"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_numbers_that_are_none(value: float, feature: str, bad: Bad, folder: Path) -> None:
    def spoil(table: pa.Table) -> pa.Table:
        rows = table.column(feature).to_pylist()
        rows[3][1] = value
        return replaced(table, feature, pa.array(rows, table.schema.field(feature).type))

    edit_table(folder / IMAGE, spoil)
    bad(*FROM_FOLDER, says=(f"'{feature}'", IMAGE, "1 rows of episodes 0,", "row 3", "finite"))


def test_all_episodes_with_numbers_that_are_none_are_named_and_the_others_can_be_taken(
    bad: Bad, place: Path
) -> None:
    folder = save(place / "d", episodes(7), Limits(data_mb=0))
    for number in (2, 5):

        def spoil(table: pa.Table, number: int = number) -> pa.Table:
            rows = table.column("action").to_pylist()
            rows[table.column("episode_index").to_pylist().index(number)][0] = float("nan")
            kind = table.schema.field("action").type
            return replaced(table, "action", pa.array(rows, kind))

        edit_table(data_files(folder)[number], spoil)
    said = bad(*FROM_FOLDER, says=("2 rows of episodes 2,5,", "take only episodes 0-1,3-4,6"))
    (alone,) = re.findall(r"take only episodes (\S+) \(", said)
    found = demonstrations.load(folder, 0.3, 0, selection=Selection(only=alone))
    assert set(found.episode_of[found.read].tolist()) == {0, 1, 3, 4, 6}
    bad(*FROM_FOLDER, "--set", "demos.only=2,5", says=("of episodes 2,5", "take other episodes"))


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("column", ["timestamp", "episode_index", "frame_index", "task_index"])
def test_a_place_or_time_that_is_no_number(
    column: str, value: float, bad: Bad, folder: Path
) -> None:
    def spoil(table: pa.Table) -> pa.Table:
        numbers = table.column(column).to_numpy().astype(np.float64)
        numbers[3] = value
        return replaced(table, column, pa.array(numbers))

    edit_table(folder / IMAGE, spoil)
    bad(*FROM_FOLDER, says=(IMAGE, f"NaN or infinite values in '{column}'"))


@pytest.mark.parametrize(("fps", "step"), [(5, "200 ms"), (15, "66.67 ms"), (1e4, "0.1 ms")])
def test_another_rate_than_that_of_the_timestamps(
    fps: float, step: str, bad: Bad, folder: Path
) -> None:
    edit_info(folder, lambda info: info.update(fps=fps))
    bad(*FROM_FOLDER, says=("100 ms apart", step, f"fps {fps:g}", "here 10,"))


def test_times_that_stand_still(bad: Bad, folder: Path) -> None:
    edit_table(
        folder / IMAGE, lambda t: replaced(t, "timestamp", pa.array(np.zeros(len(t), np.float32)))
    )
    bad(*FROM_FOLDER, says=("0 ms apart", "fps 10", "correct the timestamps"))


@pytest.mark.parametrize(
    "column", ["length", "episode_index", "dataset_from_index", "data/chunk_index"]
)
def test_an_infinite_place_of_an_episode(column: str, bad: Bad, folder: Path) -> None:
    edit_table(
        folder / EPISODES,
        lambda table: replaced(table, column, pa.array([float("inf")] * len(table))),
    )
    bad(*FROM_FOLDER, says=("meta/episodes' is damaged",))


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_video_that_begins_at_no_time(value: float, bad: Bad, filmed: Path) -> None:
    name = "videos/observation.images.top/from_timestamp"
    edit_table(
        filmed / EPISODES, lambda table: replaced(table, name, pa.array([value] * len(table)))
    )
    bad(*FROM_FOLDER, says=("meta/episodes' is damaged", f"begins at {value} s"))


def test_one_episode(bad: Bad, place: Path) -> None:
    save(place / "d", episodes(1))
    bad(*FROM_FOLDER, says=("1 episode in 'd'", "record more episodes"))


# --- damage --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        (name, damage)
        for name in (IMAGE, EPISODES, "meta/tasks.parquet")
        for damage in ("truncated", "flipped", "foreign")
    ],
)
def test_a_corrupt_parquet_file(name: str, damage: str, bad: Bad, folder: Path) -> None:
    path = folder / name
    data = bytearray(path.read_bytes())
    if damage == "flipped":
        data[_page(path)] ^= 1
    path.write_bytes({"truncated": data[:-30], "flipped": data, "foreign": b"hello"}[damage])
    bad(*FROM_FOLDER, says=(name, "is damaged"))


@pytest.mark.parametrize("name", [IMAGE, EPISODES, "meta/tasks.parquet", "meta/info.json", VIDEO])
def test_a_pointer_of_git_lfs_is_not_called_damage(
    name: str, bad: Bad, place: Path, images: Path, videos: Path
) -> None:
    folder = shutil.copytree(videos if name == VIDEO else images, place / "d")
    (folder / name).write_text(LFS_POINTER)
    says = bad(*FROM_FOLDER, says=(name, "Git LFS pointer", "git lfs pull"))
    assert "damaged" not in says


def _page(path: Path) -> int:
    """A place in the middle of a column's data."""
    column = parquet.ParquetFile(path).metadata.row_group(0).column(0)
    return column.data_page_offset + column.total_compressed_size - 2


@pytest.mark.parametrize("damage", ["truncated", "empty", "foreign", "missing"])
def test_a_corrupt_video(damage: str, bad: Bad, filmed: Path) -> None:
    path = filmed / VIDEO
    content = path.read_bytes()
    path.write_bytes(
        {"truncated": content[: len(content) // 2], "foreign": b"hello" * 100}.get(damage, b"")
    )
    if damage == "missing":
        path.unlink()
        bad(*FROM_FOLDER, says=(VIDEO, "leave those episodes out (demos.only"))
    else:
        bad(*FROM_FOLDER, says=(VIDEO, "leave out episodes 0-", "(demos.only"))


def test_a_video_that_was_not_downloaded(bad: Bad, filmed: Path) -> None:
    """The error is the same whether frames are decoded before the training or on demand."""
    (filmed / VIDEO).unlink()
    for cache in ("true", "false"):
        bad(*FROM_FOLDER, "--set", f"demos.cache={cache}", says=(VIDEO, "get the dataset again"))


def test_a_video_that_ends_too_early(bad: Bad, filmed: Path, place: Path) -> None:
    shorter = save(place / "short", episodes(2, size=(64, 64), smooth=True), as_video=True)
    shutil.copy(shorter / VIDEO, filmed / VIDEO)
    bad(*FROM_FOLDER, says=("no frame at", VIDEO))


@pytest.mark.parametrize("name", [IMAGE, EPISODES, "meta/tasks.parquet"])
def test_a_pipe_in_place_of_a_parquet_file(name: str, bad: Bad, folder: Path) -> None:
    """Opening it would wait forever."""
    (folder / name).unlink()
    os.mkfifo(folder / name)
    bad(*FROM_FOLDER, says=(name, "is a pipe"))


def test_a_pipe_in_place_of_a_video(bad: Bad, filmed: Path) -> None:
    (filmed / VIDEO).unlink()
    os.mkfifo(filmed / VIDEO)
    bad(*FROM_FOLDER, says=(VIDEO, "is a pipe"))


def test_a_missing_data_file(bad: Bad, folder: Path) -> None:
    (folder / IMAGE).unlink()
    bad(*FROM_FOLDER, says=("no file", IMAGE))


@pytest.mark.parametrize("content", [b"hello", None])
def test_a_picture_that_is_none(content: bytes | None, bad: Bad, folder: Path) -> None:
    def spoil(table: pa.Table) -> pa.Table:
        pictures = table.column("observation.images.top").to_pylist()
        pictures[4]["bytes"] = pictures[4]["bytes"][:200] if content else None
        return replaced(
            table,
            "observation.images.top",
            pa.array(pictures, table.schema.field("observation.images.top").type),
        )

    edit_table(folder / IMAGE, spoil)
    bad(*FROM_FOLDER, says=("the picture of frame 4", IMAGE))


# --- writing -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (("--format", "lerobot", "--out", "d"), "new or empty folder"),
        (("--format", "lerobot", "--out", "file"), "new or empty folder"),
        (("--format", "lerobot", "--out", "none/d"), "mkdir -p none"),
        (("--video", "--out", "x.safetensors"), "--format lerobot"),
    ],
)
def test_recordings_that_cannot_be_written(
    args: tuple[str, ...], says: str, bad: Bad, folder: Path
) -> None:
    bad("demos", "reach", "--episodes", "1", *args, says=(says,))


def test_missing_packages(bad: Bad, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(layout, "find_spec", lambda _: None)
    for command in (
        FROM_FOLDER,
        ("inspect", "d"),
        ("demos", "reach", "--format", "lerobot", "--out", "new"),
    ):
        bad(*command, says=("pip install 'aegis-vla[lerobot]'",))


def test_a_sheet_is_a_png(bad: Bad, folder: Path) -> None:
    bad("inspect", "d", "--plot", "sheet.svg", says=("ending in .png",))
    bad("inspect", "d", "--plot", "none/sheet.png", says=("mkdir",))
