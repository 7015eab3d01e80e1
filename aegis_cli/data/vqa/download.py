"""Download the questions of a data set from the hub into the hub's own cache."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path, PurePosixPath

from aegis_cli.common import hub
from aegis_cli.common.errors import AegisError, in_short
from aegis_cli.data.vqa import saved


@cache
def fetch(name: str, split: str | None) -> Path:
    """The local folder of a data set on the hub; it stays the same for the lifetime of the process.

    Only the parquet files of one split are downloaded.

    Raises:
        AegisError: it is neither in the cache nor can be downloaded, there are several splits to
            choose from, or it has no parquet file.
    """
    if not hub.is_installed():
        raise AegisError(
            f"no question set '{name}', and no package 'huggingface_hub' to ask the hub for it",
            "a local set, or the package that downloads one",
            "check the path, or pip install 'aegis-vla[hf]'",
        )
    # The files have to be listed first: their names show which belong to the split.
    try:
        there = hub.list_files(name, "dataset")
    except (OSError, ValueError) as error:
        return _cached(name, split, error)
    wanted = [str(path) for path in _of_split(name, there, split)]
    try:
        return hub.snapshot(name, "dataset", wanted)
    except (OSError, ValueError) as error:
        raise _missing(name, error) from error


def _cached(name: str, split: str | None, why: Exception) -> Path:
    """The folder of a split that was downloaded before, if the hub cannot be reached."""
    names = ["*.parquet"]  # the hub's client matches in any folder
    if split is not None:
        # The names that `saved.of_split` assigns to the split.
        names = [f"{split}.parquet", f"{split}-[0-9]*.parquet", f"{split}_[0-9]*.parquet"]
        names += [f"data/{own}" for own in names]
    try:
        return hub.snapshot(name, "dataset", names, cached=True)
    except (OSError, ValueError):
        raise _missing(name, why) from why


def _missing(name: str, error: Exception) -> AegisError:
    return AegisError(
        f"no question set '{name}', and no data set of that name from the Hugging Face hub: "
        f"{in_short(error)}",
        "a local set, or a hub id with a network (and, for a gated data set, a token)",
        "check the path; or, on a machine with a network: hf download --repo-type dataset "
        f"{name} --local-dir FOLDER; then give FOLDER",
    )


def _of_split(name: str, there: Sequence[str], split: str | None) -> list[PurePosixPath]:
    """The parquet files of a split, or of the only one."""
    parquet = [PurePosixPath(path) for path in there if path.endswith(".parquet")]
    # The folders in which the reader looks; downloading others would be useless.
    for folder in (PurePosixPath("."), PurePosixPath("data")):
        files = [path for path in parquet if path.parent == folder]
        if files:
            return saved.of_split(name, files, split)
    found = f"no parquet file at the top of '{name}' on the hub, nor in its data/"
    expected = "a data set of images, questions and answers as parquet"
    get = f"hf download --repo-type dataset {name} --local-dir FOLDER"
    elsewhere = sorted({str(path.parent) for path in parquet})
    if not elsewhere:
        raise AegisError(found, expected, f"{get}; then give FOLDER")
    folder = elsewhere[0]
    raise AegisError(
        f"{found}, but in {', '.join(elsewhere[:5])}",
        expected,
        f"{get} --include '{folder}/*'; then give FOLDER/{folder}",
    )
