"""A stand-in for what huggingface_hub downloads from the hub, for one dataset."""

from __future__ import annotations

import shutil
from pathlib import Path

from huggingface_hub.errors import IncompleteSnapshotError
from huggingface_hub.utils import filter_repo_objects


class DatasetHub:
    """A hub with one dataset, whose files are those of a local folder.

    Attributes:
        repository: that folder; local: where its files are downloaded to.
        asked: the patterns of each download, in order.
        lacks: the exception for any other name.
        fails: the exception for a request for the list of files; None: the request succeeds.
    """

    def __init__(self, name: str, repository: Path, local: Path) -> None:
        self.name, self.repository, self.local = name, repository, local
        self.asked: list[list[str]] = []
        self.lacks: Exception = FileNotFoundError("no repository of that name")
        self.fails: Exception | None = None

    def files(self, name: str, repo_type: str) -> list[str]:
        """Replaces `list_repo_files`."""
        assert repo_type == "dataset"
        if self.fails is not None:
            raise self.fails
        if name != self.name:
            raise self.lacks
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
        """Replaces `snapshot_download`, which remembers which files exist."""
        assert repo_type == "dataset"
        self.asked.append(allow_patterns)
        if name != self.name:
            raise self.lacks
        there = [str(p.relative_to(self.repository)) for p in self.repository.rglob("*.*")]
        for found in filter_repo_objects(
            there, allow_patterns=allow_patterns, ignore_patterns=ignore_patterns
        ):
            if local_files_only and not (self.local / found).exists():
                raise IncompleteSnapshotError(f"{found} is missing", str(self.local))
            (self.local / found).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(self.repository / found, self.local / found)
        self.local.mkdir(exist_ok=True)
        return str(self.local)

    @property
    def downloaded(self) -> set[str]:
        """Names of the files that have been downloaded."""
        return {path.name for path in self.local.rglob("*.*")}
