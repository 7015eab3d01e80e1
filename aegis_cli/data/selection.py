"""Which part of the demonstrations is used for training."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from aegis_cli.common.errors import AegisError
from aegis_cli.data.lerobot.layout import ACTION, STATE
from aegis_cli.data.renaming import Renaming

# One set of demonstrations, or several in the order in which their frames are numbered.
Paths = Path | tuple[Path, ...]


def listed(features: str | tuple[str, ...]) -> tuple[str, ...]:
    """The features that one name or several stand for."""
    return (features,) if isinstance(features, str) else features


@dataclass(frozen=True)
class Selection:
    """Which episodes of demonstrations are read, and which features of a LeRobot folder.

    Attributes:
        camera: one or several of the folder's cameras; None: its only one.
        only: the episodes, as `demos.only` names them; None: all.
        state, action: the features that are proprioception and actions; several are concatenated,
            and () reads none.
        rename: the policy's names of cameras, features and joints; the names above are the
            policy's.
    """

    camera: str | tuple[str, ...] | None = None
    only: str | None = None
    state: str | tuple[str, ...] = STATE
    action: str | tuple[str, ...] = ACTION
    rename: Renaming = ()

    @property
    def vectors(self) -> tuple[str, ...]:
        """All features that are proprioception or actions."""
        return (*listed(self.state), *listed(self.action))

    def check_file(self, path: Path) -> None:
        """Raise AegisError if something is selected that a file of `aegis demos` does not have."""
        of_anchor = {"camera": " (of aegis anchor: --camera)"}
        for name, what in (("camera", "a camera"), ("state", "features"), ("action", "features")):
            chosen = getattr(self, name)
            if chosen in (getattr(ALL, name), ()):  # the default, or nothing
                continue
            named = chosen if isinstance(chosen, str) else ", ".join(chosen)
            raise AegisError(
                f"demos.{name}: {named} with the file '{path}'",
                f"a LeRobot folder, to choose {what} from",
                f"leave demos.{name}{of_anchor.get(name, '')} out",
            )


ALL = Selection()
