"""Names on the Hugging Face hub: which names have the form of one, and downloading its files."""

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
    """Whether a name has the form of a hub id, which a path may have too."""
    return bool(_ID.fullmatch(name))


def is_local(name: str) -> bool:
    """Whether a name can only be a path: the hub is never asked for a typo in one."""
    is_file = Path(name).suffix in _FILES
    # `runs/x` is a missing run, because the documentation puts runs there.
    return not is_id(name) or is_file or _first(name) == "runs" or Path(_first(name)).is_dir()


def not_asked(name: str) -> str:
    """Extra advice for a missing path that only an existing folder keeps from being a hub id."""
    if not is_id(name) or not Path(_first(name)).is_dir():
        return ""
    return (
        f"; '{name}' was not looked up on the hub, because a folder '{_first(name)}' is here: "
        "to look it up, run the command in another folder"
    )


def _first(name: str) -> str:
    return name.partition("/")[0]


def is_installed() -> bool:
    """Whether the package for access to the hub is installed."""
    return importlib.util.find_spec("huggingface_hub") is not None


def list_files(name: str, kind: Kind) -> list[str]:
    """The paths of a repository's files.

    Raises:
        OSError, ValueError: the hub has no such repository, or cannot be reached.
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
    """The local folder with a repository's newest files, downloaded if necessary.

    Args:
        wanted, unwanted: patterns of file paths.
        cached: whether to look only in the hub's cache.

    Raises:
        OSError, ValueError: they are not in the cache and cannot be downloaded.
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
    """Raise OSError for connection problems, which may be any error of httpx."""
    from huggingface_hub.errors import HTTPError

    try:
        yield
    except HTTPError as error:
        if isinstance(error, OSError):
            raise
        raise OSError(f"{type(error).__name__}: {error}") from error
