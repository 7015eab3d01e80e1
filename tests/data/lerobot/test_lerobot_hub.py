"""A dataset of the hub can be given by its id wherever a path can."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
import torch
import yaml
from huggingface_hub.errors import HTTPError
from samples.dataset_hub import DatasetHub
from samples.lerobot import as_version_2, edit_info, edit_table, episodes, replaced, save
from samples.user_folder import training

from aegis_cli.common import hub
from aegis_cli.data import demonstrations
from aegis_cli.data.lerobot import download, layout, write
from aegis_cli.data.selection import Selection
from aegis_cli.publishing import card
from aegis_cli.training import checkpoint

pytestmark = pytest.mark.usefixtures("frame_cache")

Bad = Callable[..., str]
NAME = "someone/arm"


def ask_anew() -> None:
    """As in a new process that has not asked the hub yet."""
    download._snapshot.cache_clear()


@pytest.fixture
def hosted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> DatasetHub:
    made = [replace(e, instruction="go to the red pad") for e in episodes(8)]
    repository = save(tmp_path / "repository", made)
    (repository / "README.md").write_text("a card")
    (repository / "weights.bin").write_text("what nobody asked for")
    found = DatasetHub(NAME, repository, tmp_path / "cache" / "snapshot")
    monkeypatch.setattr("huggingface_hub.snapshot_download", found.snapshot)
    ask_anew()
    return found


def test_it_is_read_as_the_folder_is(hosted: DatasetHub) -> None:
    one, other = (demonstrations.load(Path(p), 0.3, 0) for p in (NAME, hosted.repository))
    assert one.sha256 == other.sha256 and torch.equal(one.frames[0], other.frames[0])
    assert demonstrations.digest(Path(NAME)) == one.sha256
    assert demonstrations.count_episodes(Path(NAME)) == 8
    # The meta folder comes first, and the hub is asked once per process.
    top = [f"videos/{chunk}observation.images.top/*" for chunk in ("", "*/")]
    assert hosted.asked == [["meta/*"], ["meta/*", "data/*", *top]]
    assert not (hosted.local / "weights.bin").exists()


def test_a_training_and_an_evaluation_take_its_id(
    aegis: Any, hosted: DatasetHub, place: Path
) -> None:
    code, _, err = aegis(*training(demos=NAME, out="runs/x"))
    assert code == 0, err
    code, out, _ = aegis("evaluate", "runs/x", "--demos", NAME, "--json")
    report = json.loads(out)
    assert code == 0 and report["data"] == NAME
    # They are recognised as those on which the run was trained.
    assert report["split"] == "validation" and 0 < len(report["episodes"]) < 8
    code, out, _ = aegis("inspect", "runs/x", "--json")
    assert code == 0 and json.loads(out)["facts"]["dataset"] == NAME
    run = Path("runs/x")
    stored = card.Stored("float32", rounded=False)
    said = card.text(run, checkpoint.last(run), card.LEROBOT, "lab/arm", stored)
    _, front, _ = said.split("---\n", 2)
    assert yaml.safe_load(front)["datasets"] == [NAME]


def test_a_folder_of_that_name_comes_first(hosted: DatasetHub, place: Path) -> None:
    (place / NAME).parent.mkdir()
    save(place / NAME, episodes(3))
    assert demonstrations.count_episodes(Path(NAME)) == 3 and hosted.asked == []


@pytest.mark.parametrize(
    "name", ["none", "./x/y", "../x/y", "/no/x", "a/b/c", "runs/x", "data/x", "a/b.safetensors"]
)
def test_what_can_only_be_a_path_is_never_asked_of_the_hub(
    name: str, hosted: DatasetHub, bad: Bad, place: Path
) -> None:
    (place / "data").mkdir()
    says = [f"no file or folder '{name}'", "id on the hub", "check the path"]
    if name == "data/x":
        says.append("'data/x' was not looked up on the hub, because a folder 'data' is here")
    bad(*training(demos=name), says=tuple(says))
    given = ("--set", "methods=[naive]", "--set", f"demos.path={name}")
    bad("run", "small.yaml", *given, says=tuple(says))
    assert hosted.asked == []


@pytest.mark.parametrize(
    "command",
    [
        training(demos="someone/else"),
        ("run", "small.yaml", "--set", "methods=[naive]", "--set", "demos.path=someone/else"),
        ("anchor", "--demos", "someone/else", "--out", "a.safetensors"),
    ],
)
def test_a_dataset_that_the_hub_lacks(
    command: tuple[str, ...], hosted: DatasetHub, bad: Bad
) -> None:
    says = ("someone/else", "Hugging Face hub", "hf download --repo-type dataset someone/else")
    bad(*command, says=says)


def test_nothing_large_is_downloaded_of_what_cannot_be_read(hosted: DatasetHub, bad: Bad) -> None:
    edit_info(hosted.repository, lambda info: info.update(codebase_version="v1.6"))
    bad(*training(demos=NAME), says=("v1.6", "version 2.0"))
    (hosted.repository / "meta/info.json").rename(hosted.repository / "meta/other.json")
    shutil.rmtree(hosted.local)
    ask_anew()
    bad(*training(demos=NAME), says=(f"'{NAME}' of the hub has no meta/info.json", "--include"))
    assert hosted.asked == [["meta/*"]] * 2 and not (hosted.local / "data").exists()


def test_a_connection_that_breaks_is_one_error(hosted: DatasetHub, bad: Bad) -> None:
    """httpx's own errors are neither OSErrors nor ValueErrors."""
    for kind in (HTTPError, type("ReadTimeout", (HTTPError,), {})):
        hosted.lacks = kind("timed out")
        ask_anew()
        bad(*training(demos="someone/else"), says=(kind.__name__, "timed out", "hf download"))


def test_what_the_meta_folder_refuses_is_not_downloaded(hosted: DatasetHub, bad: Bad) -> None:
    for key, says in (
        ("camera=side", "no camera 'side'"),
        ("state=joints", "no feature 'joints'"),
        ("action=joints", "no feature 'joints'"),
    ):
        bad(*training(demos=NAME), "--set", f"demos.{key}", says=(says,))
    assert hosted.asked == [["meta/*"]]


def test_videos_of_other_cameras_stay_where_they_are(
    hosted: DatasetHub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(write, "_MB", 0)
    for older in (False, True):
        made = episodes(4, ("top", "wrist"), (64, 64), smooth=True)
        hosted.repository = save(tmp_path / f"film {older}", made, as_video=True)
        if older:
            as_version_2(hosted.repository, "v2.1")
        hosted.local = tmp_path / f"snapshot {older}"
        ask_anew()
        found = demonstrations.load(Path(NAME), None, 0, Selection("wrist"))
        assert len(found.frames) == 1
        videos = {str(path.relative_to(hosted.local)) for path in hosted.local.rglob("*.mp4")}
        assert len(videos) == 4 and all("observation.images.wrist" in path for path in videos)


@pytest.fixture(params=["v3.0", "v2.1"])
def films(
    request: pytest.FixtureRequest,
    hosted: DatasetHub,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> DatasetHub:
    """A dataset of five episodes with two cameras, in files of one episode each."""
    monkeypatch.setattr(write, "_MB", 0)
    made = episodes(5, ("top", "wrist"), (64, 64), smooth=True)
    hosted.repository = save(tmp_path / "films", made, as_video=True)
    if request.param != "v3.0":
        as_version_2(hosted.repository, request.param)
    return hosted


def test_files_of_other_episodes_stay_where_they_are(films: DatasetHub) -> None:
    some = Selection("wrist", "1,3")
    found = demonstrations.load(Path(NAME), None, 0, some)
    here = demonstrations.load(films.repository, None, 0, some)
    assert found.sha256 == here.sha256 and torch.equal(found.read, here.read)
    assert torch.equal(found.frames[0][found.read], here.frames[0][here.read])
    kinds = [len(list(films.local.rglob(name))) for name in ("data/**/*.parquet", "*.mp4")]
    assert kinds == [2, 2]
    # Others are downloaded when they are requested.
    assert len(demonstrations.load(Path(NAME), None, 0, Selection("top")).read) > len(found.read)
    assert len(list(films.local.rglob("*.mp4"))) == 2 + 5


def test_of_very_many_files_all_are_downloaded(
    films: DatasetHub, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(download, "_MOST_NAMED", 3)
    demonstrations.load(Path(NAME), None, 0, Selection("wrist", "1,3"))
    assert len(list(films.local.rglob("*.mp4"))) == 5


def test_rows_that_are_in_another_file_than_the_meta_folder_says_are_found(
    hosted: DatasetHub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """LeRobot's converter from v2.1 did this until 0.5.0."""
    monkeypatch.setattr(write, "_MB", 0)
    made = episodes(5, size=(64, 64), smooth=True)
    hosted.repository = save(tmp_path / "films", made, as_video=True)
    wrong = pa.array([0, 0, 2, 2, 4])
    edit_table(
        hosted.repository / layout.EPISODES.format(chunk_index=0, file_index=0),
        lambda table: replaced(table, "data/file_index", wrong),
    )
    found = demonstrations.load(Path(NAME), None, 0, Selection(only="2,3"))
    assert len(found.read) == sum(len(made[number].actions) for number in (2, 3))
    kinds = [len(list(hosted.local.rglob(name))) for name in ("data/**/*.parquet", "*.mp4")]
    assert kinds == [5, 2]


def test_an_episode_that_is_not_there_is_said_before_anything_large(
    hosted: DatasetHub, bad: Bad
) -> None:
    bad(*training(demos=NAME), "--set", "demos.only=3,8", says=("episode 8", "which has 8"))
    assert hosted.asked == [["meta/*"]]


def test_inspect_needs_the_meta_folder_alone(
    aegis: Any, hosted: DatasetHub, tmp_path: Path
) -> None:
    code, out, err = aegis("inspect", NAME, "--json")
    assert code == 0, err
    report = json.loads(out)
    here = json.loads(aegis("inspect", hosted.repository, "--json")[1])
    assert report == {**here, "path": NAME} and hosted.asked == [["meta/*"]]
    code, _, err = aegis("inspect", NAME, "--plot", tmp_path / "sheet.png")
    assert code == 0, err
    assert (tmp_path / "sheet.png").is_file()


def test_the_package_that_asks_the_hub_is_missing(
    hosted: DatasetHub, bad: Bad, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hub, "is_installed", lambda: False)
    bad(*training(demos=NAME), says=(NAME, "huggingface_hub", "aegis-vla[hub,lerobot]"))
