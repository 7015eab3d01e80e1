"""What has been measured of an anchor so far, so that an interrupted `aegis anchor` goes on.

A piece is a part of the anchor, or of a part that is measured in groups of maps one group. Of a
piece that is finished its result is kept, by the first process alone. Of the one under way each
process keeps its own sums with how far they have come; it does so at most every minute, and so
seldom that this takes a fiftieth of the time. Nothing shows in what is measured: sums go on
from the very bits that they had. All of it is removed when the anchor is written.
"""

from __future__ import annotations

import contextlib
import shutil
import time
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from aegis_cli.common import cache, files, interrupts, kept_tensors, launch
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Warned, ignore
from aegis_cli.common.kept_tensors import Kept
from aegis_cli.common.ranks import ALONE, Ranks

_EVERY_S = 60.0  # at least between two times that sums are kept
_TIMES = 50  # as long as it takes to keep them, the work before that takes at least
_BYTES_PER_S = 2e8  # at which a disk is thought to write, until it has
_OF_FREE = 0.25  # what is kept at once takes at most so much of the free disk
_STAGE = "anchor"


class Work:
    """An anchor that is being measured, and what is kept of it.

    Attributes:
        before_s: seconds that what was found here took, before this process began.
    """

    def __init__(
        self, about: Mapping[str, Any] | None, ranks: Ranks = ALONE, on_event: OnEvent = ignore
    ) -> None:
        """Look for nothing yet.

        Args:
            about: all that the anchor depends on, as JSON: of another one nothing is found. None
                keeps nothing.
        """
        self.before_s = 0.0
        self._ranks, self._on_event = ranks, on_event
        self._name = None if about is None else files.sha256_value(about)[:32]
        self._can_keep = about is not None
        if about is not None:
            cache.sweep(self._folder)
            files.sweep_all(self._folder)

    def piece(self, stage: str) -> Piece:
        """One piece of the work, which is named as its progress is."""
        return Piece(self, stage)

    def remove(self) -> None:
        """Remove all that is kept of this anchor, which is written by now."""
        if self._name is not None:
            with contextlib.suppress(OSError):  # another process has removed it, or it is another's
                for path in self._folder.glob(f"{self._name}-*"):
                    path.unlink()

    # --- for its pieces ---------------------------------------------------------------------------

    def read(self, name: str) -> Kept | None:
        """What is kept under this name."""
        if self._name is None:
            return None
        path = self._path(name)
        try:
            found = kept_tensors.read(path)
        except kept_tensors.Damaged as error:
            text = f"'{path}', which an interrupted measurement has left, is damaged ({error}): "
            self._on_event(Warned(_STAGE, f"{text}what it held is measured again"))
            return None
        if found is not None:
            cache.touch(path)
            self.before_s += found.figures["seconds"]
        return found

    def write(self, name: str, kept: Kept) -> bool:
        """Keep something, where the disk has room for it.

        Returns:
            Whether it is kept.
        """
        if not self._can_keep:
            return False
        path = self._path(name)
        try:
            files.make_folder(path.parent)
            free = shutil.disk_usage(path.parent).free
            if kept.size * launch.local_world_size() > _OF_FREE * free:
                return False
            kept_tensors.write(path, kept)
        except (OSError, AegisError) as error:
            self._can_keep = False
            why = error.found if isinstance(error, AegisError) else error.strerror or str(error)
            text = f"what is measured is not kept, so that an interruption loses it ({why})"
            fix = "set AEGIS_CACHE to a folder that can be written"
            self._on_event(Warned(_STAGE, f"{text}: {fix}"))
        return self._can_keep

    def forget(self, name: str) -> None:
        """Remove what is kept under this name."""
        if self._name is not None:
            with contextlib.suppress(OSError):
                self._path(name).unlink()

    @property
    def _folder(self) -> Path:
        return cache.folder("anchors")

    def _path(self, name: str) -> Path:
        return self._folder / f"{self._name}-{name}"


@dataclass
class Piece:
    """A part of an anchor, or of one that is measured in groups of maps a group."""

    work: Work
    stage: str
    _before_s: float = 0.0  # of an earlier process, on the sums that this one goes on with
    _began_s: float = field(default_factory=time.monotonic)

    def finished(self) -> Kept | None:
        """The piece, if it is finished.

        Processes other than the first, which write nothing, get its figures alone.
        """
        ranks = self.work._ranks
        if self.work._name is None or not ranks.several:
            return self.work.read(self._named("whole"))
        own = self.work.read(self._named("whole")) if ranks.first else None
        figures = ranks.agree(None if own is None else own.figures)
        return own if own is not None or figures is None else Kept(figures)

    def begun(self) -> Kept | None:
        """This process's sums of a piece that is not finished; `figures["done"]` says how far."""
        found = self.work.read(self._own)
        self._before_s = 0.0 if found is None else found.figures["seconds"]
        return found

    @contextlib.contextmanager
    def going(self, sums: Callable[[], Kept]) -> Generator[Callable[[int], None]]:
        """Keep the sums while the work of the block goes on, and when a signal ends it.

        Args:
            sums: what they are at the moment.

        Yields:
            What is to be called wherever the sums are whole, with how far the work has come.
        """
        if not self.work._can_keep:
            yield lambda done: None
            return
        last, cost_s = time.monotonic(), 0.0

        def keep(done: int) -> None:
            nonlocal last, cost_s
            begun = time.monotonic()
            if held.number is None and begun - last < _EVERY_S:
                return
            found = sums()
            least_s = _TIMES * (cost_s or found.size / _BYTES_PER_S)
            if held.number is not None or begun - last >= least_s:
                self.work.write(self._own, self._timed(found, done=done))
                last = time.monotonic()
                cost_s = last - begun
            if held.number is not None:
                held.leave()

        with interrupts.deferred(self._tell_of_signal) as held:
            yield keep

    def _tell_of_signal(self) -> None:
        text = (
            "a signal came: the batch under way is finished, and what is measured so far is kept. "
            "Another one ends this at once, without what came after it was last kept"
        )
        self.work._on_event(Warned(_STAGE, text))

    def finish(self, kept: Kept) -> None:
        """Keep the result in place of the sums; all processes call this together."""
        if self.work._name is None:
            return
        whole = self._named("whole")
        if self.work._ranks.by_first(lambda: self.work.write(whole, self._timed(kept))):
            self.work.forget(self._own)

    def _timed(self, kept: Kept, **figures: Any) -> Kept:
        seconds = self._before_s + time.monotonic() - self._began_s
        return replace(kept, figures={**kept.figures, "seconds": seconds, **figures})

    @property
    def _own(self) -> str:
        return self._named(f"process-{self.work._ranks.rank}")

    def _named(self, what: str) -> str:
        return f"{self.stage.replace(' ', '-')}-{what}"


NOTHING = Work(None)
