"""A dataset of the hub, downloaded into the hub's own cache."""

from __future__ import annotations

import glob
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from aegis_cli.common import hub
from aegis_cli.common.errors import AegisError, in_short
from aegis_cli.data.lerobot import layout

_META = "meta/*"


@cache
def meta(name: str) -> Path:
    """The local folder of a dataset on the hub, of which the meta folder is there.

    The folder is the same one as long as the process lives.

    Raises:
        AegisError: neither in the cache nor to be had, or no LeRobot dataset that Aegis reads.
    """
    if not hub.is_installed():
        raise AegisError(
            f"no file or folder '{name}', and no package 'huggingface_hub' to ask the hub for it",
            "a local dataset, or the package that downloads one",
            "check the path, or pip install 'aegis-vla[hub,lerobot]'",
        )
    layout.require_pyarrow()
    folder = _snapshot(name, [_META])
    if not layout.is_dataset(folder):
        raise AegisError(
            f"the dataset '{name}' of the hub has no {layout.INFO}",
            f"a LeRobot dataset of {layout.READ} at the top of its repository",
            f"where it lies in a folder of it: hf download --repo-type dataset {name} "
            "--include 'FOLDER/*' --local-dir DATASET; then give DATASET/FOLDER",
        )
    return folder


@cache
def fetch(name: str, cameras: Sequence[str]) -> Path:
    """The same folder, with all rows and the videos of these cameras.

    Args:
        cameras: names of their features.

    Raises:
        AegisError: what is not in the cache cannot be had.
    """
    videos = [f"videos/{glob.escape(camera)}/*" for camera in cameras]  # version 3.0
    videos += [f"videos/*/{glob.escape(camera)}/*" for camera in cameras]
    return _snapshot(name, [_META, "data/*", *videos])


def _snapshot(name: str, wanted: Sequence[str]) -> Path:
    try:
        return hub.snapshot(name, "dataset", wanted)
    except (OSError, ValueError) as error:
        raise AegisError(
            f"no file or folder '{name}', and no dataset of that name from the Hugging Face hub: "
            f"{in_short(error)}",
            "a file of aegis demos, a LeRobot dataset, or a hub id with a network (and, for a "
            "private dataset, a token)",
            f"check the path; or where there is a network: hf download --repo-type dataset {name} "
            "--local-dir FOLDER; then give FOLDER",
        ) from error
