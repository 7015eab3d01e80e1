"""Copy what lies in a policy's folder beside its weights."""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from safetensors import SafetensorError, safe_open

from aegis_cli.common.errors import AegisError
from aegis_cli.common.files import make_folder

_NEVER = (".git", ".cache")  # from a clone of a repository, and from a download
# The state of an optimiser belongs to the weights that it was saved with, and may be larger.
STALE = ("optimizer.pt", "training_state")
# The same as patterns of paths.
STALE_ON_HUB = ("optimizer.pt", "*/optimizer.pt", "training_state/*", "*/training_state/*")


class Contents(NamedTuple):
    """What lies in a folder, as paths inside of it.

    Attributes:
        folders: each before what lies in it.
        stale: entries named in STALE, with nothing of their contents.
    """

    folders: Sequence[Path]
    files: Sequence[Path]
    stale: Sequence[Path]


def contents(folder: Path, without: Collection[Path]) -> Contents:
    """What is to be copied from a folder.

    Args:
        without: files that are left out, which may be links to anywhere.

    Raises:
        AegisError: an entry that is neither file nor folder, that cannot be read, or a link that
            leads out of the folder, to nothing or in a circle.
    """
    folders, files, stale = [], [], []
    for path in _below(folder, without, _homes(folder), (os.path.realpath(folder),)):
        inside = path.relative_to(folder)
        if path.name in STALE:
            stale.append(inside)
        elif path.is_dir():
            folders.append(inside)
        else:
            files.append(inside)
    return Contents(folders, files, stale)


def copy(found: Contents, source: Path, target: Path) -> None:
    """Copy a folder's contents. The new folders can be written to, even if the old ones cannot."""
    for inside in found.folders:
        make_folder(target / inside)
    for inside in found.files:
        shutil.copy2(source / inside, target / inside)


def other_weights(found: Contents, folder: Path, names: Collection[str]) -> list[Path]:
    """The files of safetensors among a folder's contents that have tensors of these names."""
    others = []
    for inside in found.files:
        if inside.suffix != ".safetensors":
            continue
        try:
            with safe_open(folder / inside, framework="np") as file:
                if not set(names).isdisjoint(file.keys()):
                    others.append(inside)
        except (OSError, SafetensorError):  # it is copied, and nobody here needs to read it
            continue
    return others


def _below(
    folder: Path, without: Collection[Path], homes: tuple[Path, ...], above: tuple[str, ...]
) -> Iterator[Path]:
    """Everything to copy from a folder and the folders in it.

    Args:
        homes: the folders in which the targets of links may lie.
        above: this folder and those around it, with links resolved.
    """
    for path in sorted(folder.iterdir()):
        if path.name in _NEVER or path in without:
            continue
        if path.name in STALE:
            yield path
            continue
        real = os.path.realpath(path)
        if path.is_symlink():
            _check_link(path, Path(real), homes)
        if not (path.is_dir() or path.is_file()):
            raise _refused(path, "neither a file nor a folder", "remove it")
        if not os.access(path, os.R_OK | (os.X_OK if path.is_dir() else 0)):
            raise _refused(path, "which cannot be read", "make it readable (chmod u+rX)")
        if real in above:
            raise _refused(path, "a link to a folder that it lies in", "remove the link")
        yield path
        if path.is_dir():
            yield from _below(path, without, homes, (*above, real))


def _homes(folder: Path) -> tuple[Path, ...]:
    """Where the targets of a folder's links may lie: in itself or, from the hub, with its blobs."""
    real = folder.resolve()
    blobs = (at.parent / "blobs" for at in (real, *real.parents) if at.name == "snapshots")
    return (real, *(at for at in blobs if at.is_dir()))


def _check_link(path: Path, target: Path, homes: tuple[Path, ...]) -> None:
    if not target.exists():
        raise _refused(path, f"a broken link to '{os.readlink(path)}'", "remove the link")
    if not any(target.is_relative_to(home) for home in homes):
        raise _refused(
            path,
            f"a link that leads out of the policy's folder, to '{os.readlink(path)}'",
            "replace the link by what belongs to the policy, or remove it",
        )


def _refused(path: Path, found: str, fix: str) -> AegisError:
    return AegisError(f"'{path}', {found}", "a policy's folder, of files and folders", fix)
