"""A question set of the hub is given by its id, and its split after a number sign."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import datasets
import pytest
from huggingface_hub.errors import HTTPError, OfflineModeIsEnabled
from samples.dataset_hub import DatasetHub
from samples.vqa_files import hub_rows

from aegis_cli.common import hub
from aegis_cli.common.errors import AegisError
from aegis_cli.data.lerobot import download as lerobot
from aegis_cli.data.vqa import download, sets

Bad = Callable[..., str]
NAME = "someone/questions"
SPLITS = {"train": 2, "validation": 3}


@pytest.fixture
def hosted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> DatasetHub:
    monkeypatch.setattr(datasets.config, "HF_DATASETS_CACHE", str(tmp_path / "cache"))
    data = tmp_path / "repository" / "data"
    data.mkdir(parents=True)
    for split, images in SPLITS.items():
        rows = datasets.Dataset.from_dict(hub_rows(images))
        rows.to_parquet(str(data / f"{split}-00000-of-00001.parquet"))
    found = DatasetHub(NAME, data.parent, tmp_path / "snapshot")
    monkeypatch.setattr("huggingface_hub.snapshot_download", found.snapshot)
    monkeypatch.setattr("huggingface_hub.list_repo_files", found.files)
    download.fetch.cache_clear()
    lerobot._snapshot.cache_clear()
    return found


def reread(name: str) -> sets.Listed:
    """Read as a new process would."""
    download.fetch.cache_clear()
    found = sets.read(name)
    assert isinstance(found, sets.Listed)
    return found


@pytest.mark.parametrize("split", SPLITS)
def test_a_split_is_read_and_nothing_else_is_downloaded(split: str, hosted: DatasetHub) -> None:
    found = reread(f"{NAME}#{split}")
    assert len(found.entries) == 2 * SPLITS[split] and found.name == f"questions-{split}"
    assert hosted.downloaded == {f"{split}-00000-of-00001.parquet"}
    here = sets.read(f"{hosted.repository}#{split}")
    assert isinstance(here, sets.Listed) and here.sha256 == found.sha256


@pytest.mark.parametrize("kind", [HTTPError, OfflineModeIsEnabled, FileNotFoundError])
def test_what_is_in_the_cache_needs_no_network(kind: type[Exception], hosted: DatasetHub) -> None:
    """And nothing else is downloaded if the hub does not answer what it has."""
    before = reread(f"{NAME}#train")
    hosted.fails = kind("no connection")
    assert reread(f"{NAME}#train").state == before.state
    for other in (f"{NAME}#validation", NAME):
        with pytest.raises(AegisError, match="no connection"):
            reread(other)
    assert hosted.downloaded == {"train-00000-of-00001.parquet"}


def test_a_probe_takes_its_id(aegis: Any, hosted: DatasetHub, place: Path) -> None:
    name = f"{NAME}#validation"
    code, out, err = aegis("probe", "embedded", "--vqa", name, "--questions", 4, "--json")
    assert code == 0, err
    assert json.loads(out)["questions"] == 4


def test_it_is_inspected_by_its_id(aegis: Any, hosted: DatasetHub, tmp_path: Path) -> None:
    """With a split, or its only split; one of LeRobot's is recognised by its meta folder."""
    code, out, err = aegis("inspect", f"{NAME}#validation", "--plot", tmp_path / "sheet.png")
    assert code == 0 and (tmp_path / "sheet.png").is_file(), err
    code, _, err = aegis("inspect", NAME)
    assert code == 2 and f"2 splits in '{NAME}'" in err
    next(hosted.repository.rglob("train-*")).unlink()
    download.fetch.cache_clear()
    code, out, err = aegis("inspect", NAME, "--verify", "--json")
    assert code == 0, err
    told = json.loads(out)
    assert (told["kind"], told["path"], told["questions"]) == ("questions", NAME, 6)


def test_what_is_neither_is_refused_by_inspect(hosted: DatasetHub, bad: Bad) -> None:
    shutil.rmtree(hosted.repository / "data")
    says = ("no parquet file at the top", "a repository with meta/info.json at its top")
    bad("inspect", NAME, says=says)


def test_several_splits_are_refused_before_any_is_downloaded(hosted: DatasetHub, bad: Bad) -> None:
    says = (f"2 splits in '{NAME}': train, validation", f"--vqa '{NAME}#validation'")
    bad("anchor", "--vqa", NAME, "--out", "a.safetensors", says=says)
    bad("anchor", "--vqa", f"{NAME}#test", "--out", "a.safetensors", says=("no split 'test'", NAME))
    assert hosted.downloaded == set()


def test_a_repository_of_another_form(hosted: DatasetHub, bad: Bad) -> None:
    (hosted.repository / "data").rename(hosted.repository / "default")
    says = (f"no parquet file at the top of '{NAME}'", "in default", "--include 'default/*'")
    bad("anchor", "--vqa", f"{NAME}#train", "--out", "a.safetensors", says=says)
    shutil.rmtree(hosted.repository / "default")
    says = (f"no parquet file at the top of '{NAME}'", "then give FOLDER")
    bad("anchor", "--vqa", f"{NAME}#train", "--out", "a.safetensors", says=says)


def test_a_set_that_the_hub_lacks(hosted: DatasetHub, bad: Bad) -> None:
    says = ("someone/else", "Hugging Face hub", "hf download --repo-type dataset someone/else")
    bad("anchor", "--vqa", "someone/else#train", "--out", "a.safetensors", says=says)


def test_the_package_that_asks_the_hub_is_missing(
    hosted: DatasetHub, bad: Bad, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hub, "is_installed", lambda: False)
    bad("anchor", "--vqa", NAME, "--out", "a.safetensors", says=(NAME, "aegis-vla[hf]"))


@pytest.mark.parametrize("name", ["none", "./x/y", "/no/x", "a/b/c", "runs/x", "data/x"])
def test_what_can_only_be_a_path_is_never_asked_of_the_hub(
    name: str, hosted: DatasetHub, bad: Bad, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []
    monkeypatch.setattr(download, "fetch", asked.append)
    (place / "data").mkdir()
    says = (f"question set '{name}', which does not exist", "its id on the hub")
    bad("anchor", "--vqa", name, "--out", "a.safetensors", says=says)
    assert asked == []
