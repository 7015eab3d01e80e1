"""Damaged records of stages: one error that says what to remove."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import ignore
from aegis_cli.training.up_to_date import StageRecords


@pytest.mark.parametrize(
    "records",
    [
        [],
        3,
        {"demos": 1},
        {"demos": {"key": "x"}},
        {"demos": {"key": 1, "outputs": {}}},
        {"demos": {"key": "x", "outputs": []}},
        {"demos": {"key": "x", "outputs": {"a": 1}}},
        {"demos": {"key": "x", "outputs": None}},
    ],
)
def test_records_of_another_form_are_refused(records: Any, tmp_path: Path) -> None:
    (tmp_path / "stages.json").write_text(json.dumps(records))
    with pytest.raises(AegisError, match=r"stages.json' is damaged") as caught:
        StageRecords(tmp_path, ignore).key_of("demos")
    assert "rm " in caught.value.fix


def test_what_is_kept_is_read_again(tmp_path: Path) -> None:
    (tmp_path / "demos").write_text("frames")
    StageRecords(tmp_path, ignore).keep("demos", {"seed": 1}, [tmp_path / "demos"])
    StageRecords(tmp_path, ignore).keep("naive/train", {"steps": 1}, [])
    again = StageRecords(tmp_path, ignore)
    assert again.key_of("demos") and again.key_of("naive/train") and not again.key_of("other")
