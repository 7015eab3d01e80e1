"""JSON files and digests: canonical, atomic, and clear about what cannot be read."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import pytest

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError


def test_json_round_trip_is_canonical(tmp_path: Path) -> None:
    files.save_json(tmp_path / "a.json", {"b": [1, None], "a": {"y": 0.1, "x": "é"}})
    files.save_json(tmp_path / "b.json", {"a": {"x": "é", "y": 0.1}, "b": (1, None)})
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()
    assert files.load_json(tmp_path / "a.json") == {"a": {"x": "é", "y": 0.1}, "b": [1, None]}


def test_nan_never_reaches_a_file(tmp_path: Path) -> None:
    files.save_json(tmp_path / "a.json", 1)
    with pytest.raises(ValueError, match="not JSON compliant"):
        files.save_json(tmp_path / "a.json", {"loss": float("nan")})
    assert files.load_json(tmp_path / "a.json") == 1 and os.listdir(tmp_path) == ["a.json"]


@pytest.mark.parametrize("content", [b"", b'{"a": ', b"\xff\xfe\x00", b"[" * 100_000])
def test_half_a_json_file_is_named(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(AegisError, match="a.json' is not JSON"):
        files.load_json(tmp_path / "a.json")
    with pytest.raises(AegisError, match="no file .*b.json"):
        files.load_json(tmp_path / "b.json")


def test_sha256_is_of_the_bytes(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"aegis")
    assert files.sha256_file(tmp_path / "a") == hashlib.sha256(b"aegis").hexdigest()
