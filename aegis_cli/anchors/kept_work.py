"""Save the progress of an anchor's measurement, so that an interrupted `aegis anchor` can resume.

A piece is a part of the anchor, or one group of maps if a part is measured in groups. The first
process saves the result of each finished piece. For the piece in progress, each process saves its
own sums and how far they have come, at most once a minute and for at most a fiftieth of the time.
Each of several processes also saves them once it has passed its share, and then waits for the
others: they may have resumed from different positions.

Resuming does not change the result: sums continue from exactly the same bits. Everything is removed
when the anchor is written.
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

_EVERY_S = 60.0  # at least, between two saves
_TIMES = 50  # the work between two saves takes at least this many times as long as a save
_BYTES_PER_S = 2e8  # assumed speed of the disk until the first save
_OF_FREE = 0.25  # one save by all processes takes at most this share of the free disk
_STAGE = "anchor"


class Work:
    """The saved state of an anchor that is being measured.

    Attributes:
        before_s: seconds that earlier processes spent on the state that was found.
    """

    def __init__(
        self, about: Mapping[str, Any] | None, ranks: Ranks = ALONE, on_event: OnEvent = ignore
    ) -> None:
        """Prepare, without reading anything yet.

        Args:
            about: everything that the anchor depends on, as JSON; only the state of an equal one is
                found. None: nothing is saved.
        """
        self.before_s = 0.0
        self._ranks, self._on_event = ranks, on_event
        self._name = None if about is None else files.sha256_value(about)[:32]
        self._can_keep = about is not None
        self._told_of_room = False
        if about is not None:
            cache.sweep(self._folder)
            files.sweep_all(self._folder)

    def piece(self, stage: str) -> Piece:
        """One piece of the work, named after its stage in progress events."""
        return Piece(self, stage)

    def remove(self) -> None:
        """Remove all saved state of this anchor, once the anchor is written."""
        if self._name is None:
            return
        with contextlib.suppress(OSError):  # the folder cannot be read
            for path in self._folder.glob(f"{self._name}-*"):
                with contextlib.suppress(OSError):  # already removed, or not ours to remove
                    path.unlink()

    # --- for its pieces ---------------------------------------------------------------------------

    def read(self, name: str) -> Kept | None:
        """What is saved under this name."""
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

    def write(self, name: str, kept: Kept, writers: int = 1) -> bool:
        """Save something if the disk has room for it.

        Args:
            writers: number of processes on this machine that save as much at the same time.

        Returns:
            Whether it was saved.
        """
        if not self._can_keep:
            return False
        path = self._path(name)
        try:
            files.make_folder(path.parent)
            free = shutil.disk_usage(path.parent).free
            if kept.size * writers > _OF_FREE * free:
                self._tell_of_room(path.parent, kept.size * writers, free)
                return False
            kept_tensors.write(path, kept)
        except (OSError, AegisError) as error:
            self._can_keep = False
            why = error.found if isinstance(error, AegisError) else error.strerror or str(error)
            text = f"what is measured is not kept, so that an interruption loses it ({why})"
            fix = "set AEGIS_CACHE to a folder that can be written"
            self._on_event(Warned(_STAGE, f"{text}: {fix}"))
        return self._can_keep

    def _tell_of_room(self, folder: Path, needed: int, free: int) -> None:
        """Warn once that something is too large to be saved; smaller pieces still are."""
        if self._told_of_room:
            return
        self._told_of_room = True
        text = (
            "what is measured is not kept, so that an interruption loses it: it takes "
            f"{needed / 1e9:.3g} GB, more than a quarter of the {free / 1e9:.3g} GB that are free "
            f"in '{folder}'. Set AEGIS_CACHE to a folder on a larger disk, or lower anchor.memory"
        )
        self._on_event(Warned(_STAGE, text))

    def forget(self, name: str) -> None:
        """Remove what is saved under this name."""
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
    """A part of an anchor, or one group of maps if a part is measured in groups."""

    work: Work
    stage: str
    _before_s: float = 0.0  # spent by earlier processes on the sums that this one continues
    _began_s: float = field(default_factory=time.monotonic)
    _is_kept: bool = True  # whether the last save of the sums succeeded

    def finished(self) -> Kept | None:
        """The piece, if it is finished.

        Processes other than the first get only its figures.
        """
        ranks = self.work._ranks
        if self.work._name is None or not ranks.several:
            return self.work.read(self._named("whole"))
        own = self.work.read(self._named("whole")) if ranks.first else None
        figures = ranks.agree(None if own is None else own.figures)
        return own if own is not None or figures is None else Kept(figures)

    def begun(self) -> Kept | None:
        """This process's sums of an unfinished piece; `figures["done"]` says how far they are."""
        found = self.work.read(self._own)
        self._before_s = 0.0 if found is None else found.figures["seconds"]
        return found

    @contextlib.contextmanager
    def going(self, sums: Callable[[], Kept]) -> Generator[Callable[[int], None]]:
        """Save the sums regularly while the block runs, and when a signal ends it.

        After the block, each of several processes waits here for the others.

        Args:
            sums: returns the current sums.

        Yields:
            A function to call, with how much is done, whenever the sums are consistent.
        """
        if self.work._can_keep:
            with self._saving(sums) as keep:
                yield keep
        else:
            yield lambda done: None
        # One that resumed near its end may be hours ahead, and sums are added with a time limit. A
        # signal that comes meanwhile is raised when the wait ends, also if another process ends it.
        self.work._ranks.wait()

    @contextlib.contextmanager
    def _saving(self, sums: Callable[[], Kept]) -> Generator[Callable[[int], None]]:
        last, cost_s = time.monotonic(), 0.0
        unsaved: int | None = None  # how much is done if it is more than what was last saved

        def keep(done: int, at_once: bool = False) -> None:
            nonlocal last, cost_s, unsaved
            unsaved = done
            begun = time.monotonic()
            if not at_once and held.number is None and begun - last < _EVERY_S:
                return
            found = sums()
            least_s = _TIMES * (cost_s or found.size / _BYTES_PER_S)
            if at_once or held.number is not None or begun - last >= least_s:
                timed = self._timed(found, done=done)
                self._is_kept = self.work.write(self._own, timed, launch.local_world_size())
                last = time.monotonic()
                cost_s = last - begun
                unsaved = None
            if held.number is not None:
                held.leave()

        with interrupts.deferred(self._tell_of_signal) as held:
            yield keep
            # A process that waits for the others cannot save when a signal comes.
            if unsaved is not None and (self.work._ranks.several or held.number is not None):
                keep(unsaved, at_once=True)

    def _tell_of_signal(self) -> None:
        if self._is_kept:
            text = (
                "a signal came: the batch under way is finished, and what is measured so far is "
                "kept. Another one ends this at once, without what came after it was last kept"
            )
        else:
            text = (
                "a signal came: the batch under way is finished, but what is measured of this part "
                "is not kept. Another one ends this at once"
            )
        self.work._on_event(Warned(_STAGE, text))

    def finish(self, kept: Kept) -> None:
        """Save the result in place of the sums; all processes call this together."""
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
