"""A ledger as a file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from aegis_cli.common import artifacts
from aegis_cli.core.ledger import Ledger

_UNITS = {"w2": "activation^2", "step": "steps"}


def save(
    path: Path, ledger: Ledger, meta: Mapping[str, Any], inputs: Mapping[str, str], seed: int | None
) -> None:
    """Write the ledger's rows with the names of its groups and layers."""
    names = {"groups": list(ledger.groups), "layers": list(ledger.layers)}
    artifacts.save(
        path,
        "ledger",
        ledger.tensors(),
        seed=seed,
        inputs=inputs,
        units=_UNITS,
        meta={**meta, **names},
    )
