"""Questions of a data set on the hub, downloaded into the hub's own cache."""

from __future__ import annotations

from functools import cache
from pathlib import Path, PurePosixPath

from aegis_cli.common import hub
from aegis_cli.common.errors import AegisError, in_short
from aegis_cli.data.vqa import saved


@cache
def fetch(name: str, split: str | None) -> Path:
    """The local folder of a data set on the hub; the same one as long as the process lives.

    Only the parquet files of one split are downloaded.

    Raises:
        AegisError: neither in the cache nor to be had, several splits to choose among, or no
            parquet file.
    """
    if not hub.is_installed():
        raise AegisError(
            f"no question set '{name}', and no package 'huggingface_hub' to ask the hub for it",
            "a local set, or the package that downloads one",
            "check the path, or pip install 'aegis-vla[hf]'",
        )
    try:
        return hub.snapshot(name, "dataset", _wanted(name, split))
    except (OSError, ValueError) as error:
        raise AegisError(
            f"no question set '{name}', and no data set of that name from the Hugging Face hub: "
            f"{in_short(error)}",
            "a local set, or a hub id with a network (and, for a gated data set, a token)",
            "check the path; or where there is a network: hf download --repo-type dataset "
            f"{name} --local-dir FOLDER; then give FOLDER",
        ) from error


def _wanted(name: str, split: str | None) -> list[str]:
    """The parquet files of a split, or of the only one; all of them where the hub cannot be asked.

    Then they are in the cache already, or `snapshot` says that they are not.
    """
    try:
        there = hub.list_files(name, "dataset")
    except (OSError, ValueError):
        return ["*.parquet"]
    parquet = [PurePosixPath(path) for path in there if path.endswith(".parquet")]
    for folder in (PurePosixPath("."), PurePosixPath("data")):
        if files := [path for path in parquet if path.parent == folder]:
            return [str(path) for path in saved.of_split(name, files, split)]
    elsewhere = sorted({str(path.parent) for path in parquet})
    raise AegisError(
        f"no parquet file at the top of '{name}' on the hub, nor in its data/"
        + (f", but in {', '.join(elsewhere[:5])}" if elsewhere else ""),
        "a data set of images, questions and answers as parquet",
        f"hf download --repo-type dataset {name} --include 'PATH/*' --local-dir FOLDER; then give "
        "FOLDER/PATH",
    )
