"""Reads the table of `aegis run`, finished or not, back from its folder."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import get_args

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError
from aegis_cli.studies.comparison import (
    RobotStreamStudyReport,
    StreamStudyReport,
    StudyReport,
)
from aegis_cli.studies.decoding import Misfit, decode
from aegis_cli.studies.pipeline import PipelineReport
from aegis_cli.training import folder

NAME = "table.json"
Report = PipelineReport | StudyReport | StreamStudyReport | RobotStreamStudyReport


def load(at: Path) -> Report:
    """The report as `aegis run` would return it now.

    Its `out` is the folder where it is now, even if it was written elsewhere.

    Raises:
        AegisError: a study has measured nothing yet, or the table is of another version.
    """
    path = at / NAME
    if not path.is_file():
        raise AegisError(
            f"no {NAME} in '{at}': the study has measured nothing yet",
            "a study with its first cell",
            "look again later, or call its aegis run again",
        )
    raw = files.load_json(path)
    try:
        return dataclasses.replace(decode(_kind(raw), raw), out=str(at))
    except Misfit as misfit:
        raise AegisError(
            f"'{path}' is no table of this version: {misfit}",
            "what this version's aegis run writes",
            "call its aegis run again: what is finished is not measured again",
        ) from None


def runs(report: PipelineReport) -> list[Path]:
    """The run of each row, whose weights were measured."""
    found = []
    for row in report.rows:
        trained = Path(report.out) / row.method
        # Tables of earlier versions do not say that the trained policy was merged.
        merged = report.merge is not None or folder.measured_in(trained) is None
        found.append(trained / folder.MERGED if merged else trained)
    return found


def _kind(raw: object) -> type[Report]:
    """The kind of report with the table's keys; older tables may lack keys with a default."""
    # No two kinds require the same keys, so the first one that fits is right.
    for kind in get_args(Report):
        fields = dataclasses.fields(kind)
        known = {field.name for field in fields}
        needed = {field.name for field in fields if field.default is dataclasses.MISSING}
        if isinstance(raw, dict) and needed <= raw.keys() <= known:
            return kind
    raise Misfit("other keys")
