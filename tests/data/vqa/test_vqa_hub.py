"""A question set of the hub goes by its id, and a split of it after a number sign."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import datasets
import pytest
from huggingface_hub.errors import HTTPError, IncompleteSnapshotError, OfflineModeIsEnabled
from huggingface_hub.utils import filter_repo_objects
from samples.vqa_files import hub_rows

from aegis_cli.common import hub
from aegis_cli.common.errors import AegisError
from aegis_cli.data.vqa import download, sets

Bad = Callable[..., str]
NAME = "someone/questions"
SPLITS = {"train": 2, "validation": 3}


class Hub:
    """A hub of one data set.

    Attributes:
        fails: what is raised where it is asked; None: it answers.
    """

    def __init__(self, repository: Path, local: Path) -> None:
        self.repository, self.local = repository, local
        self.fails: Exception | None = None

    def files(self, name: str, repo_type: str) -> list[str]:
        assert repo_type == "dataset"
        if self.fails is not None:
            raise self.fails
        if name != NAME:
            raise FileNotFoundError(f"no repository {name}")
        found = (path for path in self.repository.rglob("*") if path.is_file())
        return [str(path.relative_to(self.repository)) for path in found]

    def snapshot(
        self,
        name: str,
        repo_type: str,
        allow_patterns: list[str],
        ignore_patterns: list[str],
        local_files_only: bool,
    ) -> str:
        """As the hub's own, which knows all files of a repository once it has seen them."""
        assert repo_type == "dataset"
        if name != NAME:
            raise FileNotFoundError(f"no repository {name}")
        there = [str(p.relative_to(self.repository)) for p in self.repository.rglob("*.parquet")]
        for found in filter_repo_objects(
            there, allow_patterns=allow_patterns, ignore_patterns=ignore_patterns
        ):
            if local_files_only and not (self.local / found).exists():
                raise IncompleteSnapshotError(f"{found} is missing", str(self.local))
            (self.local / found).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(self.repository / found, self.local / found)
        return str(self.local)

    @property
    def downloaded(self) -> set[str]:
        return {path.name for path in self.local.rglob("*.parquet")}


@pytest.fixture
def hosted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Hub:
    monkeypatch.setattr(datasets.config, "HF_DATASETS_CACHE", str(tmp_path / "cache"))
    data = tmp_path / "repository" / "data"
    data.mkdir(parents=True)
    for split, images in SPLITS.items():
        rows = datasets.Dataset.from_dict(hub_rows(images))
        rows.to_parquet(str(data / f"{split}-00000-of-00001.parquet"))
    found = Hub(data.parent, tmp_path / "snapshot")
    monkeypatch.setattr("huggingface_hub.snapshot_download", found.snapshot)
    monkeypatch.setattr("huggingface_hub.list_repo_files", found.files)
    download.fetch.cache_clear()
    return found


def reread(name: str) -> sets.Listed:
    """Read as a new process would."""
    download.fetch.cache_clear()
    found = sets.read(name)
    assert isinstance(found, sets.Listed)
    return found


@pytest.mark.parametrize("split", SPLITS)
def test_a_split_is_read_and_nothing_else_is_downloaded(split: str, hosted: Hub) -> None:
    found = reread(f"{NAME}#{split}")
    assert len(found.entries) == 2 * SPLITS[split] and found.name == f"questions-{split}"
    assert hosted.downloaded == {f"{split}-00000-of-00001.parquet"}
    here = sets.read(f"{hosted.repository}#{split}")
    assert isinstance(here, sets.Listed) and here.sha256 == found.sha256


@pytest.mark.parametrize("kind", [HTTPError, OfflineModeIsEnabled, FileNotFoundError])
def test_what_is_in_the_cache_needs_no_network(kind: type[Exception], hosted: Hub) -> None:
    """And nothing else is downloaded where the hub fails to say what it has."""
    before = reread(f"{NAME}#train")
    hosted.fails = kind("no connection")
    assert reread(f"{NAME}#train").state == before.state
    for other in (f"{NAME}#validation", NAME):
        with pytest.raises(AegisError, match="no connection"):
            reread(other)
    assert hosted.downloaded == {"train-00000-of-00001.parquet"}


def test_a_probe_takes_its_id(aegis: Any, hosted: Hub, place: Path) -> None:
    name = f"{NAME}#validation"
    code, out, err = aegis("probe", "embedded", "--vqa", name, "--questions", 4, "--json")
    assert code == 0, err
    assert json.loads(out)["questions"] == 4


def test_several_splits_are_refused_before_any_is_downloaded(hosted: Hub, bad: Bad) -> None:
    says = (f"2 splits in '{NAME}': train, validation", f"--vqa '{NAME}#validation'")
    bad("anchor", "--vqa", NAME, "--out", "a.safetensors", says=says)
    bad("anchor", "--vqa", f"{NAME}#test", "--out", "a.safetensors", says=("no split 'test'", NAME))
    assert hosted.downloaded == set()


def test_a_repository_of_another_form(hosted: Hub, bad: Bad) -> None:
    (hosted.repository / "data").rename(hosted.repository / "default")
    says = (f"no parquet file at the top of '{NAME}'", "in default", "--include 'default/*'")
    bad("anchor", "--vqa", f"{NAME}#train", "--out", "a.safetensors", says=says)
    shutil.rmtree(hosted.repository / "default")
    says = (f"no parquet file at the top of '{NAME}'", "then give FOLDER")
    bad("anchor", "--vqa", f"{NAME}#train", "--out", "a.safetensors", says=says)


def test_a_set_that_the_hub_lacks(hosted: Hub, bad: Bad) -> None:
    says = ("someone/else", "Hugging Face hub", "hf download --repo-type dataset someone/else")
    bad("anchor", "--vqa", "someone/else#train", "--out", "a.safetensors", says=says)


def test_the_package_that_asks_the_hub_is_missing(
    hosted: Hub, bad: Bad, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hub, "is_installed", lambda: False)
    bad("anchor", "--vqa", NAME, "--out", "a.safetensors", says=(NAME, "aegis-vla[hf]"))


@pytest.mark.parametrize("name", ["none", "./x/y", "/no/x", "a/b/c", "runs/x", "data/x"])
def test_what_can_only_be_a_path_is_never_asked_of_the_hub(
    name: str, hosted: Hub, bad: Bad, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []
    monkeypatch.setattr(download, "fetch", asked.append)
    (place / "data").mkdir()
    says = (f"question set '{name}', which does not exist", "its id on the hub")
    bad("anchor", "--vqa", name, "--out", "a.safetensors", says=says)
    assert asked == []
