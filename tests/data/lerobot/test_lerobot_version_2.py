"""Datasets of versions 2.0 and 2.1 are read like the same dataset of version 3.0."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from samples.lerobot import READABLE, as_version_2, edit_info, episodes, save
from samples.user_folder import training

from aegis_cli.data import demonstrations
from aegis_cli.data.demonstrations import Demonstrations
from aegis_cli.data.lerobot import dataset, layout, source, write
from aegis_cli.data.selection import Selection

pytestmark = pytest.mark.usefixtures("frame_cache")

Bad = Callable[..., str]

COUNT = 5
CAMERAS = ("top", "wrist")
TASKS, EPISODES, STATS = "meta/tasks.jsonl", "meta/episodes.jsonl", "meta/episodes_stats.jsonl"
DATA = "data/chunk-001/episode_000003.parquet"
VIDEO = "videos/chunk-001/observation.images.top/episode_000003.mp4"
FIGURES = {"min", "max", "mean", "std", "count"}


@pytest.fixture(params=[False, True], ids=["images", "video"])
def newer(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A dataset of version 3.0, each of whose videos holds one episode."""
    monkeypatch.setattr(write, "_MB", 0)
    size = (64, 64) if request.param else (16, 24)
    made = episodes(COUNT, CAMERAS, size, seed=2, smooth=request.param)
    return save(tmp_path / "newer", made, as_video=request.param)


@pytest.fixture(params=["v2.0", "v2.1"])
def older(request: pytest.FixtureRequest, newer: Path) -> Path:
    """The same dataset in an older version."""
    return as_version_2(shutil.copytree(newer, newer.with_name("older")), request.param)


def loaded(folder: Path, cache: bool = True, only: str | None = None) -> Demonstrations:
    selection = Selection(camera=CAMERAS, only=only)
    return demonstrations.load(folder, None, 0, selection, cache=cache)


def frames_at(found: Demonstrations, at: torch.Tensor) -> list[torch.Tensor]:
    return [frames[at] for frames in found.frames]


@pytest.mark.parametrize("cache", [True, False])
def test_all_is_read_as_from_version_3(cache: bool, newer: Path, older: Path) -> None:
    one, other = loaded(newer), loaded(older, cache)
    everywhere = torch.arange(len(one.episode_of))
    for a, b in zip(frames_at(one, everywhere), frames_at(other, everywhere), strict=True):
        assert torch.equal(a, b)
    assert one.tensors.keys() == other.tensors.keys()
    for name in one.tensors:
        assert torch.equal(one.tensors[name], other.tensors[name])
    assert torch.equal(one.instruction_of, other.instruction_of)
    assert torch.equal(one.episode_of, other.episode_of)
    assert (one.instructions, one.fps) == (other.instructions, other.fps)
    assert (one.action_names, one.proprio_names) == (other.action_names, other.proprio_names)
    assert one.sha256 != other.sha256


def test_nothing_is_read_of_other_episodes(older: Path) -> None:
    whole = loaded(older)
    kept = frames_at(whole, (whole.episode_of == 3).nonzero().squeeze(1))
    other = [path for part in ("data", "videos") for path in (older / part).rglob("episode_*")]
    for path in other:
        if path.stem != "episode_000003":
            path.unlink()
    found = loaded(older, only="3")
    assert found.read.tolist() == (whole.episode_of == 3).nonzero().squeeze(1).tolist()
    for a, b in zip(kept, frames_at(found, found.read), strict=True):
        assert torch.equal(a, b)


def test_inspect_says_the_same(aegis: Any, newer: Path, older: Path, tmp_path: Path) -> None:
    said = [json.loads(aegis("inspect", folder, "--json")[1]) for folder in (newer, older)]
    facts, older_facts = (report["facts"] for report in said)
    version = json.loads((older / "meta/info.json").read_text())["codebase_version"]
    assert older_facts == {**facts, "version": version}
    for one, other in zip(said[0]["features"], said[1]["features"], strict=True):
        ones, others = one.pop("statistics"), other.pop("statistics")
        assert one == other
        # Version 2.1 has statistics of episodes, and no quantiles.
        assert others.keys() == (ones.keys() if version == "v2.0" else FIGURES)
        for name, figures in others.items():
            np.testing.assert_allclose(figures, ones[name], rtol=1e-12)
    sheets = [tmp_path / f"{folder.name}.png" for folder in (newer, older)]
    for folder, sheet in zip((newer, older), sheets, strict=True):
        assert aegis("inspect", folder, "--plot", sheet)[0] == 0
    assert sheets[0].read_bytes() == sheets[1].read_bytes()


def test_the_digest_is_of_all_that_training_reads(older: Path) -> None:
    found = dataset.load(older)

    def digest() -> list[str]:
        return source.digests(source.find(found), found.cameras(CAMERAS))

    before = digest()
    (older / TASKS).write_text((older / TASKS).read_text().replace("red", "green"))
    changed = digest()
    assert all(a != b for a, b in zip(before, changed, strict=True))
    for name in ("meta/stats.json", STATS):
        (older / name).unlink(missing_ok=True)
    assert digest() == changed


def test_a_training_and_an_evaluation_take_it(aegis: Any, place: Path) -> None:
    made = episodes(8)
    save(place / "d", [replace(e, instruction="go to the red pad") for e in made])
    as_version_2(place / "d", "v2.1")
    code, _, err = aegis(*training(demos="d", out="runs/older"))
    assert code == 0, err
    code, out, _ = aegis("evaluate", "runs/older", "--demos", "d", "--json")
    assert code == 0 and json.loads(out)["episodes"]


def test_names_of_another_count_name_no_number(aegis: Any, place: Path) -> None:
    """openpi's LIBERO data has a single name, `state`, for eight positions."""
    save(place / "d", episodes(COUNT))
    as_version_2(place / "d", "v2.0")

    def rename(info: dict[str, Any]) -> None:
        for feature in ("observation.state", "action"):
            info["features"][feature]["names"] = [feature]

    edit_info(place / "d", rename)
    found = demonstrations.load(place / "d", None, 0)
    assert (found.action_names, found.proprio_names) == ((), ())
    report = json.loads(aegis("inspect", place / "d", "--json")[1])
    named = {feature["name"]: feature["components"] for feature in report["features"]}
    assert (named["action"], named["observation.state"]) == (["", ""], ["", "", ""])


# --- bad input ------------------------------------------------------------------------------------


def lines(change: Callable[[list[dict[str, Any]]], object]) -> Callable[[Path], object]:
    def spoil(path: Path) -> None:
        rows = [json.loads(line) for line in path.read_text("utf-8").splitlines()]
        change(rows)
        path.write_text("\n".join(map(json.dumps, rows)), "utf-8")

    return spoil


def counted(row: int, count: object) -> Callable[[Path], object]:
    return lines(lambda rows: rows[row]["stats"]["action"].update(count=count))


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-5])


BAD: list[tuple[str, Callable[[Path], object], str]] = [
    (TASKS, Path.unlink, "no file"),
    (TASKS, pipe, "is a pipe"),
    (TASKS, cut, "is damaged"),
    (TASKS, lambda path: path.write_bytes(b"\xff\xfe"), "is damaged"),
    (TASKS, lambda path: path.write_text("[1, 2]"), "is damaged"),
    (TASKS, lines(lambda rows: rows.pop(0)), "not numbered from 0"),
    (TASKS, lines(lambda rows: rows[0].update(task=7)), "a task is no text"),
    (EPISODES, Path.unlink, "no file"),
    (EPISODES, cut, "is damaged"),
    (EPISODES, lines(lambda rows: rows.pop(2)), "episode 2 is missing"),
    (EPISODES, lines(lambda rows: rows.append(rows[0])), "number 0 is there twice"),
    (EPISODES, lines(lambda rows: rows[1].update(length=0)), "episode 1 has 0 frames"),
    (EPISODES, lines(lambda rows: rows[1].update(length=99)), "frames"),
    (EPISODES, lines(lambda rows: rows[1].pop("length")), "no 'length'"),
    (DATA, Path.unlink, "no file"),
    (DATA, cut, "is damaged"),
]


@pytest.mark.parametrize(("name", "spoil", "says"), BAD)
def test_a_bad_file_is_one_error(
    name: str, spoil: Callable[[Path], object], says: str, bad: Bad, place: Path
) -> None:
    folder = as_version_2(save(place / "d", episodes(COUNT)), "v2.1")
    spoil(folder / name)
    bad(*training(demos="d"), says=(f"d/{name}", says))


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (cut, "is damaged"),
        (lines(lambda rows: rows[1]["stats"]["action"].pop("mean")), "no 'mean'"),
        *(
            (counted(row, count), f"the count of 'action' in episode {row} is {count}, not")
            for row in (0, 1)
            for count in ([0], [-3], None)
        ),
    ],
)
def test_statistics_are_read_by_those_who_show_them(
    spoil: Callable[[Path], object], says: str, bad: Bad, place: Path
) -> None:
    folder = as_version_2(save(place / "d", episodes(COUNT)), "v2.1")
    before = demonstrations.load(folder, None, 0)
    spoil(folder / STATS)
    bad("inspect", "d", says=(STATS, says))
    assert demonstrations.load(folder, None, 0).sha256 == before.sha256


@pytest.mark.parametrize("mark", ["\u2028", "\u2029", "\x85"])
def test_an_instruction_may_hold_what_ends_lines_elsewhere(mark: str, tmp_path: Path) -> None:
    folder = as_version_2(save(tmp_path / "d", episodes(COUNT)), "v2.1")
    text = (folder / TASKS).read_text("utf-8").replace("red pad", f"red{mark}pad")
    (folder / TASKS).write_text(text, "utf-8")
    assert f"go to the red{mark}pad" in dataset.load(folder).tasks


def test_only_the_files_of_chosen_episodes_are_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = as_version_2(save(tmp_path / "d", episodes(COUNT)), "v2.1")
    opened, open_parquet = list[str](), layout.open_parquet

    def watched(path: Path) -> Any:
        opened.append(path.stem)
        return open_parquet(path)

    monkeypatch.setattr(layout, "open_parquet", watched)
    demonstrations.load(folder, None, 0, Selection(only="1,3"))
    assert set(opened) == {"episode_000001", "episode_000003"}


def test_a_task_without_a_text(bad: Bad, place: Path) -> None:
    folder = as_version_2(save(place / "d", episodes(COUNT)), "v2.0")
    lines(lambda rows: rows.pop())(folder / TASKS)
    bad(*training(demos="d"), says=("task_index", TASKS, "0 to 1"))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"chunks_size": 0}, "chunks_size is 0"),
        ({"chunks_size": "many"}, "many"),
        ({"data_path": "../{episode_index}.parquet"}, "leaves the folder"),
        ({"data_path": "data/file-{file_index:03d}.parquet"}, "no 'file_index'"),
        ({"codebase_version": "v3.0"}, "no 'episode_chunk'"),
    ],
)
def test_an_info_that_is_not_sound(
    change: dict[str, Any], says: str, bad: Bad, place: Path
) -> None:
    folder = as_version_2(save(place / "d", episodes(COUNT)), "v2.1")
    edit_info(folder, lambda info: info.update(change))
    bad(*training(demos="d"), says=("meta/info.json", says))


def test_a_video_that_is_missing(bad: Bad, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(write, "_MB", 0)
    made = episodes(COUNT, size=(64, 64), smooth=True, texts=READABLE)
    save(place / "d", made, as_video=True)
    (as_version_2(place / "d", "v2.1") / VIDEO).unlink()
    bad(*training(demos="d"), says=("no file", VIDEO))


@pytest.mark.parametrize("with_data", [True, False])
def test_a_recording_that_ended_before_its_first_episode(
    with_data: bool, bad: Bad, tmp_path: Path
) -> None:
    folder = as_version_2(save(tmp_path / "d", episodes(COUNT, ("top",))), "v2.1")
    edit_info(folder, lambda info: info.update(total_episodes=0, total_frames=0))
    for name in (TASKS, EPISODES, STATS):
        (folder / name).write_text("")
    if not with_data:
        shutil.rmtree(folder / "data")
    anchor = ("anchor", "--demos", folder, "--out", tmp_path / "a.safetensors")
    bad(*anchor, "--parts", "moments", says=("0 episodes in", "at least one"))
    bad("inspect", folder, "--plot", tmp_path / "s.png", says=("no episode in",))
