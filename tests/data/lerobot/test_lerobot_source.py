"""Which files are read for which episodes, whatever the meta folder says about their rows."""

from __future__ import annotations

import itertools
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import torch
from pyarrow import parquet
from samples.lerobot import data_files, edit_info, edit_table, episodes, frames, replaced, save

from aegis_cli.common.errors import AegisError
from aegis_cli.data import demonstrations
from aegis_cli.data.demonstrations import Demonstrations
from aegis_cli.data.lerobot import dataset, source, write
from aegis_cli.data.lerobot import frames as camera_frames
from aegis_cli.data.lerobot.write import Limits, NewEpisode
from aegis_cli.data.mixture import check_rename
from aegis_cli.data.selection import Selection

pytestmark = pytest.mark.usefixtures("frame_cache")

COUNT = 12
EPISODES = "meta/episodes/chunk-000/file-000.parquet"


@pytest.fixture(autouse=True)
def _small_files(monkeypatch: pytest.MonkeyPatch) -> None:
    """Several files of a few episodes each, and parts of a few frames."""
    monkeypatch.setattr(write, "_MB", 8_000)
    monkeypatch.setattr(camera_frames, "_PART", 4)


def made(smooth: bool = False) -> list[NewEpisode]:
    size = (64, 64) if smooth else (16, 24)
    return episodes(COUNT, size=size, seed=4, smooth=smooth)


@pytest.fixture(params=[False, True], ids=["images", "video"])
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    limits = Limits(data_mb=1, video_mb=1)
    found = save(tmp_path / "d", made(request.param), limits, as_video=request.param)
    if not request.param:
        assert len(data_files(found)) > 2
    return found


def loaded(folder: Path, **options: Any) -> Demonstrations:
    return demonstrations.load(folder, None, 0, **options)


def assert_equal(one: Demonstrations, other: Demonstrations, at: torch.Tensor) -> None:
    """The two have read the same data at these frames."""
    assert torch.equal(one.frames[0][at], other.frames[0][at])
    for name in ("proprio", "actions"):
        assert torch.equal(one.tensors[name][at], other.tensors[name][at])
    assert torch.equal(one.instruction_of[at], other.instruction_of[at])


def frames_of(found: Demonstrations, numbers: set[int]) -> torch.Tensor:
    return torch.isin(found.episode_of, torch.tensor(sorted(numbers))).nonzero().squeeze(1)


def lay_out(folder: Path, cuts: list[int]) -> None:
    """Divide the rows again: one file with the episodes up to each cut."""
    table = pa.concat_tables([parquet.read_table(path) for path in data_files(folder)])
    for path in data_files(folder):
        path.unlink()
    number = table.column("episode_index").to_numpy()
    for file, (first, end) in enumerate(itertools.pairwise([0, *cuts, COUNT])):
        path = folder / f"data/chunk-000/file-{file:03d}.parquet"
        parquet.write_table(table.filter(pa.array((number >= first) & (number < end))), path)


def name_as_the_older_converter(folder: Path, cuts: list[int]) -> None:
    """Make the meta folder say that each later file's first episode is in the file before it.

    LeRobot's converter from v2.1 did this until 0.5.0.
    """
    files = np.searchsorted(cuts, np.arange(COUNT), side="right")
    files[cuts] -= 1
    edit_table(folder / EPISODES, lambda table: replaced(table, "data/file_index", pa.array(files)))


# --- what the rows say ----------------------------------------------------------------------------


@pytest.mark.parametrize("cuts", [[5], [3, 4, 9], list(range(1, COUNT))])
def test_datasets_of_the_older_converter_are_read(cuts: list[int], folder: Path) -> None:
    before = loaded(folder)
    lay_out(folder, cuts)
    name_as_the_older_converter(folder, cuts)
    found = loaded(folder)
    assert_equal(before, found, torch.arange(len(found.episode_of)))
    files = source.find(dataset.load(folder)).data
    assert [file.episodes[0] for file in files] == [0, *cuts]


def test_files_in_another_order_are_read(folder: Path) -> None:
    before = loaded(folder)
    lay_out(folder, [7])
    first, second = data_files(folder)
    shutil.move(first, first.with_name("file-007.parquet"))
    found = loaded(folder)
    assert_equal(before, found, torch.arange(len(found.episode_of)))
    assert source.find(dataset.load(folder)).data[0].path.name == "file-007.parquet"
    assert second.exists()


def test_a_sound_datasets_digest_is_of_the_files_that_its_meta_folder_names(folder: Path) -> None:
    """Runs from before the rows were checked can resume."""
    found = dataset.load(folder)
    camera = found.info.cameras[0]
    named = {episode.data for episode in found.episodes}
    assert {file.path.relative_to(folder) for file in source.find(found).data} == named
    (one,) = source.digests(source.find(found), [camera])
    assert loaded(folder).sha256 == one


def test_a_file_is_read_once_for_its_digest_until_it_changes(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = demonstrations.digest(folder)
    with monkeypatch.context() as patch:
        patch.setattr(source.files, "sha256_file", lambda path, *_: pytest.fail(f"reads {path}"))
        assert demonstrations.digest(folder) == first
    path = data_files(folder)[0]
    edit_table(path, lambda table: replaced(table, "timestamp", table["timestamp"]))
    assert demonstrations.digest(folder) != first


def test_an_episode_in_two_files(folder: Path) -> None:
    lay_out(folder, [6])
    second = data_files(folder)[1]
    shutil.copy(second, second.with_name("file-002.parquet"))
    with pytest.raises(AegisError, match="episode 6 in .*file-002.* and in .*file-001") as caught:
        loaded(folder)
    assert "in one file" in caught.value.expected


def test_an_episode_in_two_parts(folder: Path) -> None:
    lay_out(folder, [6])
    rows = dataset.load(folder).episodes[0].length
    order = [*range(1, rows + 1), 0]
    edit_table(data_files(folder)[0], lambda t: t.take([*order, *range(rows + 1, len(t))]))
    with pytest.raises(AegisError, match=f"{rows - 1} rows of episode 0"):
        loaded(folder)


def test_rows_of_an_episode_that_is_not_there(folder: Path) -> None:
    path = data_files(folder)[-1]

    def renumber(table: pa.Table) -> pa.Table:
        numbers = table.column("episode_index").to_numpy().copy()
        numbers[numbers == COUNT - 1] = COUNT
        return replaced(table, "episode_index", pa.array(numbers))

    edit_table(path, renumber)
    with pytest.raises(AegisError, match=f"is of episode {COUNT}"):
        loaded(folder)


# --- a part of the episodes -----------------------------------------------------------------------


def choices(seed: int) -> set[int]:
    rng = np.random.default_rng(seed)
    return (
        {0, COUNT - 1} if seed == 0 else set(rng.permutation(COUNT)[: rng.integers(1, 9)].tolist())
    )


def only(numbers: set[int]) -> Selection:
    return Selection(only=",".join(map(str, numbers)))


@pytest.mark.parametrize("cache", [True, False])
@pytest.mark.parametrize("seed", range(5))
def test_what_is_read_of_some_episodes_is_what_is_read_of_all(
    seed: int, cache: bool, folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    numbers, whole = choices(seed), loaded(folder)
    monkeypatch.setenv("AEGIS_CACHE", str(tmp_path / "another"))
    found = loaded(folder, selection=only(numbers), cache=cache)
    at = frames_of(whole, numbers)
    assert torch.equal(found.read, at) and found.frames[0].shape == whole.frames[0].shape
    assert_equal(whole, found, at)
    batches = [each.batch(at, 3) for each in (whole, found)]
    assert torch.equal(batches[0].actions, batches[1].actions)
    assert batches[0].instructions == batches[1].instructions


@pytest.mark.parametrize("seed", range(3))
def test_rows_are_found_in_row_groups_of_any_size(
    seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, numbers = save(tmp_path / "d", made()), choices(seed)
    lay_out(folder, [4, 5])
    for path in data_files(folder):
        parquet.write_table(parquet.read_table(path), path, row_group_size=seed + 2)
    found = loaded(folder, selection=only(numbers))
    at = frames_of(found, numbers)
    np.testing.assert_array_equal(found.frames[0][at], frames(made())[at])


def test_files_of_other_episodes_need_not_be_there(folder: Path) -> None:
    """As after a partial download by LeRobot or by the hub's client."""
    whole = loaded(folder)
    lay_out(folder, [3, 8])
    digest = loaded(folder, selection=only({3, 4, 7})).sha256
    for path in (data_files(folder)[0], data_files(folder)[2]):
        path.unlink()
    for video in {
        clip.file for e in dataset.load(folder).episodes[8:] for clip in e.clips.values()
    }:
        if all(
            clip.file != video
            for e in dataset.load(folder).episodes[:8]
            for clip in e.clips.values()
        ):
            (folder / video).unlink()
    found = loaded(folder, selection=only({3, 4, 7}))
    assert_equal(whole, found, frames_of(whole, {3, 4, 7}))
    assert found.sha256 == digest == demonstrations.digest(folder, only({3, 4, 7}))
    with pytest.raises(AegisError, match="no file .*file-000.parquet") as caught:
        loaded(folder)
    assert "demos.only" in caught.value.fix


def test_numbers_of_other_episodes_need_not_be_finite(folder: Path) -> None:
    def spoil(table: pa.Table) -> pa.Table:
        rows = table.column("action").to_pylist()
        rows[0][1] = float("nan")
        return replaced(table, "action", pa.array(rows, table.schema.field("action").type))

    edit_table(data_files(folder)[0], spoil)
    assert loaded(folder, selection=only({1, 2})).tensors["actions"].isfinite().all()
    with pytest.raises(AegisError, match="of episodes 0, the first in row 0 ") as caught:
        loaded(folder, selection=only({0, 2}))
    assert "demos.only" in caught.value.fix


def test_some_episodes_frames_are_no_other_episodes(folder: Path, frame_cache: Path) -> None:
    """If one file holds all of them, their digest is the same, but each has its own cached file."""
    lay_out(folder, [])
    one, other = (loaded(folder, selection=only(chosen)) for chosen in ({1, 5}, {2, 5}))
    whole = loaded(folder)
    for found, numbers in ((one, {1, 5}), (other, {2, 5})):
        assert_equal(whole, found, frames_of(whole, numbers))
    assert len(list((frame_cache / "frames").iterdir())) == 3
    again = loaded(folder, selection=only({2, 3}))
    assert_equal(whole, again, frames_of(whole, {2, 3}))
    assert len(list((frame_cache / "frames").iterdir())) == 3


# --- features of other names ----------------------------------------------------------------------


def rename(folder: Path, names: dict[str, str]) -> None:
    for path in data_files(folder):
        edit_table(path, lambda t: t.rename_columns([names.get(n, n) for n in t.column_names]))
    edit_info(
        folder,
        lambda info: info.update(
            features={names.get(name, name): said for name, said in info["features"].items()}
        ),
    )


def test_features_of_other_names_are_read(folder: Path) -> None:
    before = loaded(folder)
    rename(folder, {"observation.state": "observation.joints", "action": "actions.delta"})
    found = loaded(folder, selection=Selection(state="observation.joints", action="actions.delta"))
    assert_equal(before, found, before.read)
    assert (found.proprio_names, found.action_names) == (before.proprio_names, before.action_names)
    with pytest.raises(AegisError, match="no feature 'observation.state'") as caught:
        loaded(folder)
    assert "demos.state=NAME" in caught.value.fix


def test_several_features_are_joined_in_their_order(folder: Path) -> None:
    found = loaded(folder, selection=Selection(state=("action", "observation.state")))
    parts = [found.tensors["actions"], loaded(folder).tensors["proprio"]]
    assert torch.equal(found.tensors["proprio"], torch.cat(parts, dim=1))
    assert found.proprio_names == ("dx", "dy", "x", "y", "z")


def arms(folder: Path, names: dict[str, str]) -> None:
    """State and action twice, once for each arm, with the same joint names."""
    for path in data_files(folder):

        def doubled(table: pa.Table) -> pa.Table:
            for old, new in names.items():
                table = table.append_column(new, table[old])
            return table

        edit_table(path, doubled)
    edit_info(
        folder,
        lambda info: info["features"].update(
            {new: info["features"][old] for old, new in names.items()}
        ),
    )


def test_joints_of_one_name_in_several_features_are_told_apart(folder: Path) -> None:
    """Each arm's actions are relative to that arm's positions."""
    edit_info(folder, lambda info: info["features"]["action"].update(names=["x", "y"]))
    arms(folder, {"observation.state": "observation.left", "action": "action.left"})
    arms(folder, {"observation.state": "observation.right", "action": "action.right"})
    state, action = ("observation.left", "observation.right"), ("action.left", "action.right")
    found = loaded(folder, selection=Selection(state=state, action=action))
    assert found.proprio_names == ("left.x", "left.y", "left.z", "right.x", "right.y", "right.z")
    assert found.action_names == ("left.x", "left.y", "right.x", "right.y")
    assert found.relative_places(()) == (0, 1, 3, 4)
    # LeRobot's own features keep their names: what is beside them is another value of the joints.
    found = loaded(folder, selection=Selection(state=("observation.left", "observation.state")))
    assert found.proprio_names == ("left.x", "left.y", "left.z", "x", "y", "z")
    assert found.relative_places(()) == (3, 4)
    rename = (("left.x", "near.x"),)
    found = loaded(folder, selection=Selection(state=state, action=action, rename=rename))
    assert found.action_names == ("near.x", "left.y", "right.x", "right.y")


@pytest.mark.parametrize("listed", [False, True])
def test_a_gripper_that_is_open_or_not_is_a_number(folder: Path, listed: bool) -> None:
    for path in data_files(folder):

        def gripper(table: pa.Table) -> pa.Table:
            own = [row % 3 == 0 for row in range(len(table))]
            cells = pa.array([[x] for x in own] if listed else own)
            return table.append_column("observation.gripper", cells)

        edit_table(path, gripper)
    said = {"dtype": "bool", "shape": [1], "names": ["gripper"]}
    edit_info(folder, lambda info: info["features"].update({"observation.gripper": said}))
    state = ("observation.state", "observation.gripper")
    found = loaded(folder, selection=Selection(state=state))
    assert found.proprio_names == ("x", "y", "z", "gripper")
    assert set(found.tensors["proprio"][:, 3].tolist()) == {0.0, 1.0}


def nameless(folder: Path, feature: str) -> None:
    edit_info(folder, lambda info: info["features"][feature].update(names=None))


def test_names_and_rate_are_kept_as_far_as_the_data_says_them(folder: Path) -> None:
    """A feature without names has none."""
    found = loaded(folder)
    names = {"action_names": ["dx", "dy"], "proprio_names": ["x", "y", "z"]}
    assert found.recorded == names | {"fps": 10.0}
    nameless(folder, "observation.state")
    found = loaded(folder)
    assert found.proprio_names == () and found.action_names == ("dx", "dy")
    assert found.recorded == {"action_names": ["dx", "dy"], "fps": 10.0}


def test_a_nameless_feature_beside_one_with_names_is_numbered(folder: Path) -> None:
    """The others keep their names, so that actions can be relative to positions by them."""
    nameless(folder, "observation.state")
    state = ("action", "observation.state")
    found = loaded(folder, selection=Selection(state=state))
    assert found.proprio_names == ("dx", "dy", "state.0", "state.1", "state.2")
    assert found.relative_places(()) == (0, 1)
    renamed = loaded(folder, selection=Selection(state=state, rename=(("state.1", "elbow"),)))
    assert renamed.proprio_names == ("dx", "dy", "state.0", "elbow", "state.2")
    check_rename([folder], (("state.1", "elbow"),))
    arms(folder, {"action": "action.left"})
    arms(folder, {"action": "action.right", "observation.state": "joints"})
    state = ("action.left", "action.right", "joints")
    found = loaded(folder, selection=Selection(state=state, action="action.left"))
    arm_names = ("left.dx", "left.dy", "right.dx", "right.dy")
    assert found.proprio_names == (*arm_names, "joints.0", "joints.1", "joints.2")


def test_nameless_actions_are_relative_to_positions_by_their_order(folder: Path) -> None:
    for feature in ("observation.state", "action"):
        nameless(folder, feature)
    found = loaded(folder, selection=Selection(state="action"))
    assert found.relative_places(()) == (0, 1)


def test_a_file_has_no_features_to_choose(demos_file: Path) -> None:
    with pytest.raises(AegisError, match="demos.state: joints with the file"):
        loaded(demos_file, selection=Selection(state="joints"))
