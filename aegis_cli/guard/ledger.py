"""The guard's ledger: training's, with a file of its own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from aegis_cli.core.ledger import Ledger
from aegis_cli.methods import ledger_file


class GuardLedger(Ledger):
    """Rows as in training, one an optimizer step."""

    def __init__(
        self, groups: Sequence[str], layers: Sequence[str], method: str, anchor: str
    ) -> None:
        super().__init__(groups, layers)
        self._method, self._anchor = method, anchor

    def save(self, path: str | Path) -> None:
        """Write what `aegis inspect` reads.

        Raises:
            AegisError: it cannot be written.
        """
        ledger_file.save(Path(path), self, {"method": self._method}, {"anchor": self._anchor}, None)
