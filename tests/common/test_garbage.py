"""Imported objects take no part in garbage collections."""

from __future__ import annotations

import gc
import importlib

import pytest

from aegis_cli.cli import render
from aegis_cli.cli.stages import Stage
from aegis_cli.common.garbage import left_out


def is_looked_through(thing: object) -> bool:
    return any(one is thing for one in gc.get_objects())


@pytest.mark.parametrize("fails", [False, True])
def test_what_is_there_at_the_end_is_left_out_and_what_comes_later_is_not(fails: bool) -> None:
    made: list[list[object]] = []
    try:
        with left_out():
            made.append([made])
            assert not gc.isenabled()
            if fails:
                raise ImportError
    except ImportError:
        assert fails
    later = [made]
    assert gc.isenabled()
    assert not is_looked_through(made[0]) and is_looked_through(later)
    made.clear()


def test_who_collects_no_garbage_does_not_begin_to() -> None:
    gc.disable()
    try:
        with left_out():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_a_stage_is_imported_so_once(monkeypatch: pytest.MonkeyPatch) -> None:
    found: list[tuple[str, bool]] = []
    monkeypatch.setattr(
        importlib, "import_module", lambda name: found.append((name, gc.isenabled()))
    )
    assert Stage("no_stage", render.facts).module is None
    assert Stage("cli.stages", render.facts).module.Stage is Stage  # it is already imported
    assert found == [("aegis_cli.no_stage", False)]
