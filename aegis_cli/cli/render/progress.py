"""Progress on stderr: live bars on a terminal, occasional plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import TextIO

from rich.progress import BarColumn, TaskID, TextColumn
from rich.progress import Progress as Bars
from rich.table import Column
from rich.text import Text

from aegis_cli.cli.render.output import Terminal, visible
from aegis_cli.common.events import Event, OnEvent, Progress, Warned

EVERY_S = 10.0  # a line at least this often,
EVERY_SHARE = 0.1  # or after this share of the work,
LEAST_S = 1.0  # but no more than one a second
_RATED_S = 1.0  # no rate is shown for a stage that finishes sooner
_WINDOW_S = 30.0  # the rate covers only the last seconds, to forget warm-up and compilation

Clock = Callable[[], float]


@contextmanager
def progress(clock: Clock = time.monotonic) -> Generator[OnEvent]:
    """A listener that shows each stage's share, rate, remaining time and metrics on stderr."""
    console = Terminal(stderr=True, highlight=False)
    if not sys.stderr.isatty() or console.is_dumb_terminal:
        yield Lines(sys.stderr, clock)
        return
    # `markup=False`, because brackets in a figure or a stage's name are not styles.
    figures = TextColumn(
        "{task.fields[figures]}",
        markup=False,
        table_column=Column(no_wrap=True, overflow="ellipsis"),
    )
    names = Column(no_wrap=True)
    stage = TextColumn("{task.description}", markup=False, table_column=names)
    with Bars(stage, BarColumn(), figures, console=console) as bars:
        live = Live(bars, names, clock)
        try:
            yield live
        finally:
            live.end()


class Pace:
    """Units per second over the last `_WINDOW_S` seconds, and the remaining time."""

    def __init__(self, clock: Clock) -> None:
        self.clock, self.start_s = clock, clock()
        self.points: deque[tuple[float, int]] = deque()
        self.first = 0  # units done before the first of these points

    def update(self, done: int) -> None:
        """Record how many units are done now."""
        now_s = self.clock()
        if not self.points:
            self.first = done  # above 0 if a stage resumes
        self.points.append((now_s, done))
        # By the second point, so that at least two points are left and they span the window.
        while len(self.points) > 2 and now_s - self.points[1][0] >= _WINDOW_S:
            self.points.popleft()

    @property
    def rate(self) -> float | None:
        """Units per second; None with fewer than two points in time."""
        (t0, n0), (t1, n1) = self.points[0], self.points[-1]
        return (n1 - n0) / (t1 - t0) if t1 > t0 and n1 > n0 else None

    def figures(self, event: Progress) -> str:
        """`250/1,500 steps (17 %), 3.2 steps/s, 6m31s left, loss 0.41`.

        For a finished stage, it is the rate of the whole stage, if that took long enough and has
        more than one unit.
        """
        parts = [f"{event.done:,}/{event.total:,} {event.unit} ({100 * _share(event):.0f} %)"]
        elapsed_s = self.clock() - self.start_s
        if event.done >= event.total:
            if elapsed_s >= _RATED_S and event.done > self.first and event.total > 1:
                parts.append(f"{_rate((event.done - self.first) / elapsed_s)} {event.unit}/s")
            parts.append(f"took {_duration(elapsed_s)}")
        elif self.rate:
            parts.append(f"{_rate(self.rate)} {event.unit}/s")
            parts.append(f"{_duration((event.total - event.done) / self.rate)} left")
        parts += [f"{name} {value:.4g}" for name, value in event.metrics.items()]
        return ", ".join(parts)


class Lines:
    """Plain lines: at a stage's start and end, and in between by the constants above."""

    def __init__(self, file: TextIO, clock: Clock) -> None:
        self.file, self.clock = file, clock
        self.pace: dict[str, Pace] = {}
        self.shown: dict[str, tuple[float, Progress]] = {}

    def __call__(self, event: Event) -> None:
        if isinstance(event, Warned):
            print(_warning(event), file=self.file, flush=True)
            return
        shown_s, last = self.shown.get(event.stage, (0.0, None))
        begins = last is None or _restarts(last, event)
        if begins:
            self.pace[event.stage] = Pace(self.clock)
        pace = self.pace[event.stage]
        pace.update(event.done)  # with every event, including those without a line
        waited_s = self.clock() - shown_s
        share = _share(event) - (_share(last) if last else 0.0)  # since the last line
        if (
            begins
            or event.done >= event.total
            or waited_s >= EVERY_S
            or (share >= EVERY_SHARE and waited_s >= LEAST_S)
        ):
            self.shown[event.stage] = (self.clock(), event)
            # Flushed at once for readers who follow a log.
            print(f"{event.stage}: {pace.figures(event)}", file=self.file, flush=True)


class Live:
    """One rich progress bar per running stage.

    A finished stage becomes a line above, since a terminal has room for few bars. While no stage is
    running, as when a model is loaded or a file is written, an indeterminate bar is shown.

    Args:
        names: the column of the stages' names, which keeps them whole on a narrow terminal.
    """

    def __init__(self, bars: Bars, names: Column, clock: Clock) -> None:
        self.bars, self.names, self.clock = bars, names, clock
        self.current: dict[str, tuple[TaskID, Pace, Progress]] = {}
        self.between: TaskID | None = None
        self._fill()

    def __call__(self, event: Event) -> None:
        if isinstance(event, Warned):
            self.bars.console.print(Text(_warning(event)), soft_wrap=True)
            return
        if event.stage in self.current and _restarts(self.current[event.stage][2], event):
            self.bars.remove_task(self.current.pop(event.stage)[0])
        if event.stage in self.current:
            task, pace, _ = self.current[event.stage]
        else:
            self.names.min_width = max(map(len, (*self.current, event.stage)))
            task = self.bars.add_task(event.stage, total=event.total, figures="")
            pace = Pace(self.clock)
        self.current[event.stage] = (task, pace, event)
        pace.update(event.done)
        self.bars.update(task, completed=event.done, total=event.total, figures=pace.figures(event))
        if event.done >= event.total:
            self.bars.remove_task(self.current.pop(event.stage)[0])
            self.bars.console.print(Text(f"{event.stage}: {pace.figures(event)}"), soft_wrap=True)
        self._fill()

    def end(self) -> None:
        """Leave no bar on the terminal that looks like something is still running."""
        if self.between is not None:
            self.bars.remove_task(self.between)
            self.between = None

    def _fill(self) -> None:
        """Show the indeterminate bar if there is no other bar, and only then."""
        if self.current:
            self.end()
        elif self.between is None:
            self.between = self.bars.add_task("working", total=None, figures="")


def _warning(event: Warned) -> str:
    return visible(f"warning: {event.stage}: {event.text}")


def _restarts(last: Progress, event: Progress) -> bool:
    """Whether a stage of this name starts again, as with each method of a job."""
    return event.done < last.done or last.done >= last.total


def _share(event: Progress) -> float:
    return event.done / event.total if event.total else 1.0


def _rate(rate: float) -> str:
    return f"{rate:,.0f}" if rate >= 100 else f"{rate:.3g}"


def _duration(seconds: float) -> str:
    minutes, s = divmod(round(seconds), 60)
    hours, m = divmod(minutes, 60)
    return f"{hours}h{m:02d}m" if hours else f"{m}m{s:02d}s" if m else f"{s}s"
