"""A dataset of the hub, downloaded into the hub's own cache."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from aegis_cli.common import hub
from aegis_cli.common.errors import AegisError, in_short
from aegis_cli.data.lerobot import layout


@cache
def fetch(name: str) -> Path:
    """The local folder of a dataset on the hub; the same one as long as the process lives.

    The meta folder comes first, so that nothing large is downloaded of what cannot be read.

    Raises:
        AegisError: neither in the cache nor to be had, or no LeRobot dataset that Aegis reads.
    """
    if not hub.is_installed():
        raise AegisError(
            f"no file or folder '{name}', and no package 'huggingface_hub' to ask the hub for it",
            "a local dataset, or the package that downloads one",
            "check the path, or pip install 'aegis-vla[hub]'",
        )
    folder = _snapshot(name, "meta/*")
    if not layout.is_dataset(folder):
        raise AegisError(
            f"the dataset '{name}' of the hub has no {layout.INFO}",
            f"a LeRobot dataset of {layout.READ} at the top of its repository",
            f"where it lies in a folder of it: hf download --repo-type dataset {name} "
            "--include 'FOLDER/*' --local-dir DATASET; then give DATASET/FOLDER",
        )
    layout.read_info(folder)
    return _snapshot(name, "meta/*", "data/*", "videos/*")


def _snapshot(name: str, *wanted: str) -> Path:
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
