"""Say what a path is: an artifact file, a run, a dataset or a model.

What needs torch is imported when it is needed, for a header's bytes are read in no time.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from aegis_cli.common import hub
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
    "UnknownFolder",
    "is_questions",
    "run",
    "steps_taken",
    "verify",
]


def run(
    path: Path, on_event: OnEvent = ignore, images: bool = False
) -> InspectReport | StreamInspection | QuestionsReport:
    """Recognise `path`: an embedded model's name, an artifact file, a run, a dataset or questions.

    What is on the hub goes by its id. Of a LeRobot dataset only the meta folder is downloaded, of
    questions the split that is read, which may follow a #.

    Only an artifact's header is read, unless figures need the tensors. It is done at once, so
    `on_event` is called for images alone.

    Args:
        images: whether to decode every image that questions are about.

    Raises:
        AegisError: nothing there, nothing we know, damaged, a run without a ledger yet, or a stream
            that is not learned to its end.
    """
    path = _located(path)
    if is_questions(path):
        from aegis_cli.data.vqa import summary

        return summary.of_set(str(path), images, on_event)
    # What is here goes before what the hub may have of the same name.
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
        AegisError: what has the form of an id on the hub, and is not there.
    """
    if path.is_dir():
        from aegis_cli.inspection import folders

        return folders.is_questions(path)
    if not path.exists() and not hub.is_local(str(path)):
        from aegis_cli.data.lerobot import download

        # Whatever is no LeRobot dataset is read as questions, or refused as such.
        return not download.is_dataset(str(path))
    if path.exists() and path.suffix not in file.OF_QUESTIONS:  # told without torch
        return False
    from aegis_cli.data.vqa import summary

    return summary.is_set(str(path))


def verify(path: Path) -> dict[Path, bool]:
    """Read every artifact at a path or in a folder whole; models of other programs are left out.

    Returns:
        The files, and whether each has a digest, with which it then agrees.

    Raises:
        AegisError: a damaged file, or no artifact at all.
    """
    from aegis_cli.common import artifacts

    path = _located(path)
    if not path.is_dir():
        return {path: artifacts.load(path).header.digest is not None}
    # Links to one file, such as those of the last checkpoint, count once.
    listed = {os.path.realpath(each): each for each in _artifacts_below(path)}
    found = {}
    for each in listed.values():
        if artifacts.is_artifact(each):  # else it may be a Hugging Face model's
            found[each] = artifacts.load(each).header.digest is not None
    if not found:
        raise AegisError(
            f"no artifact of Aegis in '{path}'", "a file or folder that it wrote", "check the path"
        )
    return found


def _artifacts_below(folder: Path) -> Iterator[Path]:
    """The safetensors files below a folder and the folders that links in it lead to, in order."""
    seen = set()
    for place, inner, names in os.walk(folder, followlinks=True):
        inner.sort()
        real = os.path.realpath(place)
        if real in seen:  # a link to a folder above would go round for ever
            inner.clear()
            continue
        seen.add(real)
        yield from (Path(place, name) for name in sorted(names) if name.endswith(".safetensors"))


def _located(path: Path) -> Path:
    return shipped.locate(str(path)) if str(path) in shipped.FILES else Path(path)
