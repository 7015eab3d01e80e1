"""`aegis export`: a trained policy in the layout of another program."""

from __future__ import annotations

import os
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from aegis_cli import recipes
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, ignore
from aegis_cli.common.files import make_folder, write_text
from aegis_cli.models import lerobot_folder
from aegis_cli.publishing import card
from aegis_cli.training import checkpoint


@dataclass(frozen=True)
class ExportReport:
    """What was written, and how the other program names what the policy takes."""

    out: str
    format: str
    task: str | None
    method: str
    pictures: tuple[str, ...]
    chunk: int
    replan: int
    parameters: int

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def run(
    run: Path,
    out: Path,
    form: str = "lerobot",
    camera: str | None = None,
    repo: str | None = None,
    on_event: OnEvent = ignore,
) -> ExportReport:
    """Write a run's policy, or that of a checkpoint, as a folder in LeRobot's layout.

    Its model card is written too, except for a checkpoint that has been taken out of its run.

    Args:
        out: a new folder; nothing is left of it where the export fails.
        form: the layout, of which there is one.
        camera: what LeRobot calls the picture of a policy with a single camera.
        repo: where others will find the policy, for the card.

    Raises:
        AegisError: no policy, the run of a stream, a folder that is there already, or a camera's
            name for a policy that has several.
    """
    refuse_stream(run)
    if out.exists():
        raise AegisError(f"'{out}' is there already", "a new folder", "choose another --out")
    policy, meta = checkpoint.load_policy(run)
    several = meta.get("cameras")
    if several and camera is not None:
        raise AegisError(
            f"--camera {camera} for a policy of {', '.join(several)}",
            "a policy of one camera",
            "leave --camera out",
        )
    camera = camera or lerobot_folder.CAMERA
    make_folder(out.parent)
    aside = out.with_name(f".{out.name}.tmp")
    shutil.rmtree(aside, ignore_errors=True)
    try:
        with checkpoint.writing(out):
            aside.mkdir()
            lerobot_folder.write(aside, policy, meta, camera)
            _write_card(aside, run, repo or f"ORG/{out.name}")
            os.rename(aside, out)
    finally:
        shutil.rmtree(aside, ignore_errors=True)  # after the rename there is nothing to remove
    return ExportReport(
        str(out),
        form,
        meta["task"],
        meta["method"],
        tuple(
            f"{lerobot_folder.IMAGES}{name.removeprefix(lerobot_folder.IMAGES)}"
            for name in several or [camera]
        ),
        policy.expert.shape.chunk,
        meta["replan"],
        sum(p.numel() for p in policy.parameters()),
    )


def refuse_stream(run: Path) -> None:
    """Raise AegisError for the run of a stream of robot tasks."""
    if recipes.is_robot_stream_run(run):
        raise AegisError(
            f"the run of a stream in '{run}', whose policies share experts",
            "the run of one policy",
            "act with aegis_cli.load_policy(run, task=...), or train the task by itself",
        )


def _write_card(folder: Path, run: Path, repo: str) -> None:
    """Write the model card of a run's policy; a policy without a run has nothing to say."""
    if lerobot_folder.is_policy(run):
        return
    at = checkpoint.chosen(run)
    home = checkpoint.run_of(at)
    if home is not None:
        write_text(folder / card.NAME, card.text(home, at, card.LEROBOT, repo))
