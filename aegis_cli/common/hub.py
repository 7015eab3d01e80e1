"""Names on the Hugging Face hub: what has the form of one, and its files on this disk."""

from __future__ import annotations

import contextlib
import importlib.util
import re
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Literal

Kind = Literal["model", "dataset"]

_FILES = (".json", ".jsonl", ".parquet", ".safetensors", ".yaml", ".yml")
_ID = re.compile(r"[\w-][\w.-]*/[\w.-]+")


def is_id(name: str) -> bool:
    """Whether a name has the form of one on the hub, which a path may have too."""
    return bool(_ID.fullmatch(name))


def is_local(name: str) -> bool:
    """Whether a name can only be a path: the hub is never asked for a typo in one."""
    is_file = Path(name).suffix in _FILES
    # `runs/x` is a run that is not there, since that is where the documentation puts runs.
    return not is_id(name) or is_file or _first(name) == "runs" or Path(_first(name)).is_dir()


def not_asked(name: str) -> str:
    """What to add to the advice for a missing path which a folder alone keeps from being an id."""
    if not is_id(name) or not Path(_first(name)).is_dir():
        return ""
    return (
        f"; '{name}' was not looked up on the hub, because a folder '{_first(name)}' is here: "
        "to look it up, run the command in another folder"
    )


def _first(name: str) -> str:
    return name.partition("/")[0]


def is_installed() -> bool:
    """Whether the package that asks the hub is there."""
    return importlib.util.find_spec("huggingface_hub") is not None


def list_files(name: str, kind: Kind) -> list[str]:
    """The paths of a repository's files.

    Raises:
        OSError, ValueError: the hub has none of that name, or cannot be asked.
    """
    import huggingface_hub

    with _as_os_error():
        return huggingface_hub.list_repo_files(name, repo_type=kind)


def snapshot(
    name: str,
    kind: Kind,
    wanted: Sequence[str],
    unwanted: Sequence[str] = (),
    cached: bool = False,
) -> Path:
    """The local folder of a repository's newest files, downloaded if they are not there.

    Args:
        wanted, unwanted: patterns of the files' paths.
        cached: whether only the hub's cache is looked at.

    Raises:
        OSError, ValueError: neither in the cache nor to be had.
    """
    import huggingface_hub

    with _as_os_error():
        found = huggingface_hub.snapshot_download(
            name,
            repo_type=kind,
            allow_patterns=list(wanted),
            ignore_patterns=list(unwanted),
            local_files_only=cached,
        )
    return Path(found)


@contextlib.contextmanager
def _as_os_error() -> Generator[None]:
    """Raise OSError for what goes wrong with the connection, which is any error of httpx's."""
    from huggingface_hub.errors import HTTPError

    try:
        yield
    except HTTPError as error:
        if isinstance(error, OSError):
            raise
        raise OSError(f"{type(error).__name__}: {error}") from error
