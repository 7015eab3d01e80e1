"""Whether MetaWorld's tasks can be made here."""

from __future__ import annotations

from importlib import import_module

import pytest

from aegis_cli.common.errors import AegisError


def _missing() -> str:
    """Why they cannot be made; empty if they can be."""
    try:
        import_module("aegis_cli.sim.metaworld")
    except AegisError as error:
        return f"{error.found}; {error.fix}"
    return ""


MISSING = _missing()
needs_metaworld = pytest.mark.skipif(bool(MISSING), reason=MISSING)
