"""Download a dataset from the hub into the hub's own cache."""

from __future__ import annotations

import glob
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

from aegis_cli.common import hub
from aegis_cli.common.errors import AegisError, in_short
from aegis_cli.data.lerobot import layout, source
from aegis_cli.data.lerobot.dataset import Dataset

_META, _ROWS = "meta/*", "data/*"
_MOST_NAMED = 1000  # the most files requested by name; the hub's client compares each with all


def is_dataset(name: str) -> bool:
    """Whether a repository on the hub is a LeRobot dataset; downloads its meta folder.

    Raises:
        AegisError: it is neither in the cache nor can be downloaded.
    """
    _require_hub(name)
    return layout.is_dataset(_snapshot(name, (_META,)))


def _require_hub(name: str) -> None:
    """Raise AegisError if the hub's package is not installed."""
    if not hub.is_installed():
        raise AegisError(
            f"no file or folder '{name}', and no package 'huggingface_hub' to ask the hub for it",
            "a local dataset, or the package that downloads one",
            "check the path, or pip install 'aegis-vla[hub,lerobot]'",
        )


def meta(name: str) -> Path:
    """The local folder of a dataset on the hub, with at least its meta folder.

    The folder stays the same for the lifetime of the process.

    Raises:
        AegisError: it is neither in the cache nor can be downloaded, or is no LeRobot dataset that
            Aegis reads.
    """
    _require_hub(name)
    layout.require_pyarrow()
    folder = _snapshot(name, (_META,))
    if not layout.is_dataset(folder):
        raise AegisError(
            f"the dataset '{name}' of the hub has no {layout.INFO}",
            f"a LeRobot dataset of {layout.READ} at the top of its repository",
            f"if it is in a folder of that repository: hf download --repo-type dataset {name} "
            "--include 'FOLDER/*' --local-dir DATASET; then give DATASET/FOLDER",
        )
    return folder


def fetch(
    name: str, found: Dataset, cameras: Sequence[str], episodes: Sequence[int] | None = None
) -> Path:
    """The folder of `meta`, with the rows of these episodes and their videos of these cameras.

    Args:
        found: what the meta folder says.
        cameras: names of their features.
        episodes: their numbers; None: all.

    Raises:
        AegisError: what is not in the cache cannot be downloaded.
    """
    if episodes is not None:
        named = _named(found, cameras, episodes)
        if len(named) <= _MOST_NAMED:
            folder = _snapshot(name, (_META, *named))
            if _has_rows(replace(found, folder=folder), episodes):
                return folder
            # The meta folder may name the file before the right one (see `source`).
            return _snapshot(name, (_META, _ROWS, *named))
    videos = [f"videos/{glob.escape(camera)}/*" for camera in cameras]  # version 3.0
    videos += [f"videos/*/{glob.escape(camera)}/*" for camera in cameras]
    return _snapshot(name, (_META, _ROWS, *videos))


def _named(found: Dataset, cameras: Sequence[str], episodes: Sequence[int]) -> list[str]:
    """Patterns of the files that hold these episodes, according to the meta folder."""
    wanted = set[Path]()
    for number in episodes:
        episode = found.episodes[number]
        wanted.add(episode.data)
        wanted |= {clip.file for camera, clip in episode.clips.items() if camera in cameras}
    return sorted(glob.escape(path.as_posix()) for path in wanted)


def _has_rows(found: Dataset, episodes: Sequence[int]) -> bool:
    """Whether the downloaded files hold all rows of these episodes."""
    try:
        source.find(found, episodes)
    except AegisError:  # the reader raises it again once all row files are downloaded
        return False
    return True


@cache
def _snapshot(name: str, wanted: tuple[str, ...]) -> Path:
    try:
        return hub.snapshot(name, "dataset", wanted)
    except (OSError, ValueError) as error:
        raise AegisError(
            f"no file or folder '{name}', and no dataset of that name from the Hugging Face hub: "
            f"{in_short(error)}",
            "a file of aegis demos, a LeRobot dataset, or a hub id with a network (and, for a "
            "private dataset, a token)",
            f"check the path; or, on a machine with a network: hf download --repo-type dataset "
            f"{name} --local-dir FOLDER; then give FOLDER",
        ) from error
