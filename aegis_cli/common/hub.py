"""Names on the Hugging Face hub: what has the form of one, and its files on this disk."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

Kind = Literal["model", "dataset"]

_ID = re.compile(r"[\w-][\w.-]*/[\w.-]+")


def is_id(name: str) -> bool:
    """Whether a name has the form of one on the hub, which a path may have too."""
    return bool(_ID.fullmatch(name))


def is_local(name: str) -> bool:
    """Whether a name can only be a path: the hub is never asked for a typo in one."""
    first = name.partition("/")[0]
    return not is_id(name) or first == "runs" or Path(first).is_dir()


def is_installed() -> bool:
    """Whether the package that asks the hub is there."""
    return importlib.util.find_spec("huggingface_hub") is not None


def list_files(name: str, kind: Kind) -> list[str]:
    """The paths of a repository's files.

    Raises:
        OSError, ValueError: the hub has none of that name, or cannot be asked.
    """
    import huggingface_hub

    return huggingface_hub.list_repo_files(name, repo_type=kind)


def snapshot(
    name: str,
    kind: Kind,
    wanted: Sequence[str],
    unwanted: Sequence[str] = (),
) -> Path:
    """The local folder of a repository's newest files, downloaded if they are not there.

    Args:
        wanted, unwanted: patterns of the files' paths.

    Raises:
        OSError, ValueError: neither in the hub's cache nor to be had.
    """
    import huggingface_hub

    found = huggingface_hub.snapshot_download(
        name, repo_type=kind, allow_patterns=list(wanted), ignore_patterns=list(unwanted)
    )
    return Path(found)
