"""A ledger as a file, with one row per optimizer step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from aegis_cli.common import artifacts
from aegis_cli.core.ledger import Ledger

_UNITS = {"w2": "activation^2", "step": "steps"}


def save(
    path: Path, ledger: Ledger, meta: Mapping[str, Any], inputs: Mapping[str, str], seed: int | None
) -> None:
    """Write the ledger's rows with the names of its groups and layers.

    Args:
        inputs: sha256 of each input of the run, by name.

    Raises:
        AegisError: it cannot be written.
    """
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


class LedgerOutsideRuns(Ledger):
    """A ledger of a user's own loop, where no run folder describes the run."""

    def __init__(
        self, groups: Sequence[str], layers: Sequence[str], method: str, anchor: str
    ) -> None:
        """Create a ledger without rows.

        Args:
            method: name of the method.
            anchor: sha256 of the anchor's file.
        """
        super().__init__(groups, layers)
        self._method, self._anchor = method, anchor

    def save(self, path: str | Path) -> None:
        """Write the file that `aegis inspect` reads.

        Raises:
            AegisError: it cannot be written.
        """
        save(Path(path), self, {"method": self._method}, {"anchor": self._anchor}, None)
