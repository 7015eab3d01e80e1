"""Determine what a path is: an artifact file, a run, a dataset or a model.

Modules that load torch are imported only when needed, so reading a header stays fast.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from aegis_cli.common import commands, hub
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, ignore
from aegis_cli.inspection import file
from aegis_cli.inspection.report import (
    BINS,
    ENERGIES,
    Bin,
    InspectReport,
    LayerEnergy,
    LayerMoments,
    SiteSpectrum,
    StreamInspection,
    TensorInfo,
    UnfinishedStream,
    UnknownFolder,
    steps_taken,
)
from aegis_cli.models import shipped

if TYPE_CHECKING:
    from aegis_cli.data.vqa.summary import QuestionsReport

__all__ = [
    "BINS",
    "ENERGIES",
    "Bin",
    "InspectReport",
    "LayerEnergy",
    "LayerMoments",
    "SiteSpectrum",
    "StreamInspection",
    "TensorInfo",
    "UnfinishedStream",
    "UnknownFolder",
    "is_questions",
    "run",
    "steps_taken",
    "verify",
]


def run(
    path: Path, on_event: OnEvent = ignore, images: bool = False
) -> InspectReport | StreamInspection | UnfinishedStream | QuestionsReport:
    """Recognise `path`: an embedded model's name, an artifact file, a run, a dataset or questions.

    Data on the hub is named by its id. Of a LeRobot dataset only the meta folder is downloaded; of
    questions only one split, which may be named after a #.

    Only an artifact's header is read, unless figures need the tensors. This is fast, so `on_event`
    is only called for questions.

    Args:
        images: whether to decode every image that questions are about.

    Raises:
        AegisError: nothing is there, it is unknown or damaged, it is a run without a ledger yet, or
            a stream of images that is not finished.
    """
    path = _located(path)
    if is_questions(path):
        from aegis_cli.data.vqa import summary

        return summary.of_set(str(path), images, on_event)
    # A local path takes precedence over a hub id of the same name.
    if not path.exists() and not hub.is_local(str(path)):
        from aegis_cli.data.lerobot import download
        from aegis_cli.inspection import folders

        return dataclasses.replace(folders.inspect(download.meta(str(path))), path=str(path))
    if not path.is_dir():
        return file.inspect(path)
    from aegis_cli.inspection import folders

    return folders.inspect(path)


def is_questions(path: Path) -> bool:
    """Whether a path is a file or folder of questions, easy-VQA's name, or a set on the hub.

    Raises:
        AegisError: the path has the form of a hub id, but the hub has nothing of that name.
    """
    if path.is_dir():
        from aegis_cli.inspection import folders

        return folders.is_questions(path)
    if not path.exists() and not hub.is_local(str(path)):
        from aegis_cli.data.lerobot import download

        # Anything but a LeRobot dataset is read as questions, or refused as such.
        return not download.is_dataset(str(path))
    if path.exists() and path.suffix not in file.OF_QUESTIONS:  # decided without torch
        return False
    from aegis_cli.data.vqa import summary

    return summary.is_set(str(path))


def verify(path: Path) -> dict[Path, bool]:
    """Read all artifacts at a path completely; models of other programs are skipped.

    Returns:
        The files, and whether each has a digest, which was then verified.

    Raises:
        AegisError: a file is damaged, or there is no artifact.
    """
    from aegis_cli.common import artifacts

    path = _located(path)
    if path.suffix == ".safetensors" and path.is_file() and not artifacts.is_artifact(path):
        raise AegisError(
            f"'{path}', which another program wrote, without a digest",
            "a file or folder that Aegis wrote",
            f"leave out --verify: {commands.aegis('inspect', path)}",
        )
    if not path.is_dir():
        return {path: artifacts.load(path).header.digest is not None}
    # A file reached through several links, such as the last checkpoint's, counts once.
    listed = {os.path.realpath(each): each for each in _artifacts_below(path)}
    found = {}
    for each in listed.values():
        if artifacts.is_artifact(each):  # it may be a Hugging Face model's
            found[each] = artifacts.load(each).header.digest is not None
    if not found:
        raise AegisError(
            f"no artifact of Aegis in '{path}'", "a file or folder that it wrote", "check the path"
        )
    return found


def _artifacts_below(folder: Path) -> Iterator[Path]:
    """The safetensors files below a folder, including linked folders, in order."""
    seen = set()
    for place, inner, names in os.walk(folder, followlinks=True):
        inner.sort()
        real = os.path.realpath(place)
        if real in seen:  # a link to a parent folder would loop forever
            inner.clear()
            continue
        seen.add(real)
        yield from (Path(place, name) for name in sorted(names) if name.endswith(".safetensors"))


def _located(path: Path) -> Path:
    return shipped.locate(str(path)) if str(path) in shipped.FILES else Path(path)
