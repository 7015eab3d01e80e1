"""`aegis demos`: demonstrations of the scripted expert as one artifact."""

from __future__ import annotations

import math
import multiprocessing
import os
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch

from aegis_cli import artifacts, files, gl, interrupts, tasks
from aegis_cli.errors import AegisError
from aegis_cli.events import OnEvent, Progress, ignore
from aegis_cli.palette import COLORS, SEEN
from aegis_cli.tasks.contract import TaskSpec
from aegis_cli.tasks.recording import Episode, record_numbered

_PER_WORKER = 400  # episodes that repay a worker's start of about two seconds
_TILE, _CAPTION = 192, 20  # pixels of the contact sheet
_SHOWN = 8  # episodes on it


@dataclass(frozen=True)
class DemosReport:
    """What was recorded: `episodes` successes out of `attempts`, whose share is `success`."""

    task: str
    episodes: int
    attempts: int
    success: float
    frames: int
    seconds: float
    frames_per_s: float
    workers: int
    out: str
    sha256: str
    preview: str | None

    def to_json(self) -> dict[str, Any]:
        """The report as JSON-ready values."""
        return asdict(self)


def run(
    task: str,
    episodes: int,
    seed: int,
    out: Path,
    noise: float = 0.3,
    colors: Sequence[str] = SEEN,
    workers: int | None = None,
    preview: Path | None = None,
    on_event: OnEvent = ignore,
) -> DemosReport:
    """Record `episodes` successful episodes of `task` to `out`; equal arguments give equal bytes.

    Episodes in which the expert fails are dropped and the next number takes their place.

    Args:
        noise: standard deviation of the pushes on the executed actions, 1 = full speed; labels stay clean.
        colors: the targets' colours; distractors have any colour.
        workers: processes; the result does not depend on it. Default: one a core, fewer for few episodes.
        preview: also write a contact sheet (PNG) of the first episodes.

    Raises:
        AegisError: a bad argument, a path that cannot be written, or an expert that keeps failing.
    """
    _check(task, episodes, noise, workers)
    gl.check()
    for path in filter(None, (out, preview)):
        files.check_writable(Path(path))
    if preview is not None:
        _need_pillow()
    workers = workers or max(1, min(os.cpu_count() or 1, episodes // _PER_WORKER))
    spec = tasks.make(task).spec
    started = time.perf_counter()
    kept, attempts = _collect(partial(record_numbered, task, seed, noise, tuple(colors)), episodes, workers, on_event)
    seconds = time.perf_counter() - started
    frames, shown = sum(len(e.actions) for e in kept), kept[:_SHOWN]
    _save(Path(out), spec, kept, seed, {"noise": noise, "attempts": attempts})
    if preview is not None:
        _save_sheet(Path(preview), shown)
    return DemosReport(
        task=task,
        episodes=episodes,
        attempts=attempts,
        success=episodes / attempts,
        frames=frames,
        seconds=seconds,
        frames_per_s=frames / seconds,
        workers=workers,
        out=str(out),
        sha256=artifacts.sha256_file(Path(out)),
        preview=None if preview is None else str(preview),
    )


def _check(task: str, episodes: int, noise: float, workers: int | None) -> None:
    tasks.check(task)
    if episodes < 1:
        raise AegisError(f"{episodes} episodes", "at least 1 episode", "use --episodes 300")
    if not (math.isfinite(noise) and noise >= 0):
        raise AegisError(f"noise {noise}", "a finite number >= 0", "use --noise 0.3")
    if workers is not None and workers < 1:
        raise AegisError(f"{workers} workers", "at least 1 worker", "leave `workers` out to use every core")


def _need_pillow() -> None:
    if find_spec("PIL") is None:
        raise AegisError("no pillow", "pillow, to draw the preview", "pip install 'aegis-vla[media]'")


def _collect(
    record: partial[Episode], episodes: int, workers: int, on_event: OnEvent
) -> tuple[list[Episode], int]:
    """The first `episodes` successes in the order of their numbers, and how many numbers that took."""
    kept: list[Episode] = []
    limit = 2 * episodes + 20
    with _mapped(record, limit, workers) as results:
        for attempts, episode in enumerate(results, 1):
            if episode.success:
                kept.append(episode)
                on_event(Progress("demos", len(kept), episodes, "episodes", {"success": len(kept) / attempts}))
            if len(kept) == episodes:
                return kept, attempts
    raise AegisError(
        f"the expert succeeded in {len(kept)} of {limit} episodes", f"{episodes} successes", "lower --noise"
    )


@contextmanager
def _mapped(record: partial[Episode], limit: int, workers: int) -> Iterator[Iterator[Episode]]:
    """`map(record, range(limit))`, over `workers` processes if more than one; stops early when left."""
    if workers == 1:
        yield map(record, range(limit))
        return
    # spawn: a forked child would inherit this process's OpenGL context and torch's threads
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"))
    try:
        with interrupts.held():  # the first calls start the workers
            results = pool.map(record, range(limit), chunksize=4)
        yield results
    except BrokenProcessPool:
        raise AegisError(
            "a recording process died", f"{workers} processes that live", "free some memory, or ask for fewer episodes"
        ) from None
    finally:
        pool.shutdown(cancel_futures=True)


def _save(path: Path, spec: TaskSpec, kept: list[Episode], seed: int, meta: dict[str, Any]) -> None:
    instructions = sorted({e.instruction for e in kept})
    starts = np.cumsum([0, *(len(e.actions) for e in kept)])
    tensors = {
        "proprio": np.concatenate([e.proprio for e in kept]),
        "actions": np.concatenate([e.actions for e in kept]),
        "episode_starts": starts.astype(np.int64),
        "instruction": np.array([instructions.index(e.instruction) for e in kept], np.int64),
        "target_color": np.array([COLORS.index(e.target_color) for e in kept], np.int64),
    }
    tensors["frames"] = _join_frames(kept, int(starts[-1]))
    artifacts.save(
        path,
        "demos",
        {name: torch.from_numpy(array) for name, array in tensors.items()},
        seed=seed,
        units={"proprio": "proprio_names", "actions": "share of a full action"},
        meta={
            "task": spec.name,
            "instructions": instructions,
            "colors": list(COLORS),
            "control_hz": spec.control_hz,
            "action_names": list(spec.action_names),
            "proprio_names": list(spec.proprio_names),
            **meta,
        },
    )


def _join_frames(kept: list[Episode], total: int) -> np.ndarray:
    """All frames [N, 64, 64, 3]; empties `kept` on the way, so that the pictures are not held twice."""
    frames = np.empty((total, *kept[0].frames.shape[1:]), np.uint8)
    kept.reverse()
    start = 0
    while kept:
        part = kept.pop().frames
        frames[start : start + len(part)] = part
        start += len(part)
    return frames


def _save_sheet(path: Path, shown: list[Episode]) -> None:
    """Contact sheet: first and last frame of each episode under its instruction, two episodes a row."""
    from PIL import Image, ImageDraw

    cell, line = 2 * _TILE + 24, _TILE + _CAPTION + 8
    sheet = Image.new("RGB", (2 * cell, line * math.ceil(len(shown) / 2)), "white")
    draw = ImageDraw.Draw(sheet)
    for i, episode in enumerate(shown):
        x, y = i % 2 * cell, i // 2 * line
        draw.text((x + 4, y + 4), f"{episode.instruction}  ({len(episode.actions)} steps)", fill="black")
        for k, frame in enumerate((episode.frames[0], episode.frames[-1])):
            tile = Image.fromarray(frame).resize((_TILE, _TILE), Image.Resampling.NEAREST)
            sheet.paste(tile, (x + 4 + k * (_TILE + 4), y + _CAPTION))
    files.write_atomically(path, lambda file: sheet.save(file, format="PNG"))
