"""`aegis demos`: demonstrations of a task's expert as one artifact, or as a LeRobot dataset."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from aegis_cli import sim
from aegis_cli.common import artifacts, files, gl, media, processes
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, ignore
from aegis_cli.common.limits import MOST_MADE
from aegis_cli.common.palette import COLORS, SEEN
from aegis_cli.data import demonstrations, keeping
from aegis_cli.data.lerobot import layout, write
from aegis_cli.data.selection import Selection
from aegis_cli.sim.contract import TaskSpec
from aegis_cli.sim.recording import RecordedEpisode, record_numbered

# How many episodes are worth a worker's start of a few seconds: for our own tasks, and for
# MetaWorld's, whose robot takes far longer to simulate and render. With a planner, one is enough.
_PER_WORKER, _PER_WORKER_METAWORLD = 400, 20
FORMATS = ("safetensors", "lerobot")


@dataclass(frozen=True)
class TaskCount:
    """What was recorded of one task of a set: the numbers of kept and of failed episodes."""

    episodes: int
    failed: int


@dataclass(frozen=True)
class DemosReport:
    """What was recorded: `episodes` were kept out of `attempts`, and the others dropped.

    In a task measured by success, failed episodes are dropped, and `success` is the share of the
    others. `tasks` has both counts for each task of a set.

    In a task measured by its return, the episodes with the lowest are dropped: `returns` has the
    mean and quantiles over all attempts, `kept_returns` over the episodes that were kept. `seconds`
    includes the writing.
    """

    task: str
    episodes: int
    attempts: int
    dropped: int
    success: float | None
    tasks: dict[str, TaskCount] | None
    returns: dict[str, float] | None
    kept_returns: dict[str, float] | None
    frames: int
    seconds: float
    frames_per_s: float
    workers: int
    out: str
    sha256: str
    preview: str | None

    def to_json(self) -> dict[str, Any]:
        """The report as values that JSON can hold."""
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
    form: str = "safetensors",
    as_video: bool = False,
    drop_below: float | None = None,
    cameras: Sequence[str] = (),
) -> DemosReport:
    """Record `episodes` good episodes of `task` to `out`; equal arguments give equal bytes.

    Episodes in which the expert fails are dropped and replaced by the next numbers. In a task
    measured by its return, enough are recorded that `episodes` are left after dropping the worst, a
    share of `drop_below`.

    Args:
        noise: standard deviation of the noise on the executed actions, 1 = full speed; labels stay
            clean.
        colors: the targets' colours; distractors have any colour.
        workers: processes; the result does not depend on it. Default: one per core, fewer for few
            episodes.
        preview: also write a contact sheet (PNG) of the first episodes.
        form: one of FORMATS; `lerobot` writes a dataset folder, episode by episode.
        as_video: keep the dataset's frames as video, which is smaller but lossy.
        drop_below: the quantile of the returns below which episodes are dropped; None: a quarter,
            if there are returns.
        cameras: the task's cameras to record, for a LeRobot dataset; empty for its default camera.

    Raises:
        AegisError: an argument is invalid, a path cannot be written, or the expert keeps failing.
    """
    _check(task, episodes, noise, workers, drop_below)
    noise = abs(noise)  # NumPy takes -0.0 for a negative deviation
    # All errors in the arguments are found before hours of recording.
    _check_form(Path(out), form, as_video, cameras)
    sim.check_cameras(task, cameras)
    gl.check()
    if preview is not None:
        files.check_writable(Path(preview))
        files.check_apart("--preview", Path(preview), [Path(out)])
    spec = sim.make(task).spec
    started = time.perf_counter()
    # The generators below fill `seen` while they are consumed, so it is complete only afterwards.
    share = keeping.DROP_BELOW if drop_below is None else drop_below
    seen = keeping.Seen()
    workers = workers or _workers(spec, episodes, share)
    threads = processes.threads_per_worker(workers)
    record = partial(
        record_numbered,
        task,
        seed,
        noise,
        tuple(colors),
        threads=threads,
        seen_by=tuple(cameras),
    )
    if spec.measure == "return":
        total = keeping.attempts(episodes, share)
        good = keeping.best(record, episodes, total, workers, seen, on_event)
    else:
        good = keeping.successes(record, episodes, workers, seen, on_event, sim.members(task))
    with closing(good) as recorded:  # ends its processes in any case
        if form == "lerobot":  # written as they come: one episode is held at a time
            _save_folder(Path(out), spec, recorded, as_video, tuple(cameras) or (spec.camera,))
        else:
            kept = list(recorded)
            _save(Path(out), spec, kept, seed, {"noise": noise, **_passed(seen, share)})
    seconds = time.perf_counter() - started
    if preview is not None:
        shown = []
        for episode in seen.first:
            caption = f"{episode.instruction}  ({len(episode.actions)} steps)"
            shown.append((caption, (episode.frames[0], episode.frames[-1])))
        media.save_sheet(Path(preview), shown)
    return _report(spec, episodes, seen, seconds, workers, out, preview, cameras or None)


def _report(
    spec: TaskSpec,
    episodes: int,
    seen: keeping.Seen,
    seconds: float,
    workers: int,
    out: Path,
    preview: Path | None,
    cameras: Sequence[str] | None,
) -> DemosReport:
    selection = Selection(None if cameras is None else tuple(cameras))
    return DemosReport(
        task=spec.name,
        episodes=episodes,
        attempts=seen.attempts,
        dropped=seen.attempts - episodes,
        success=seen.success if spec.measure == "success" else None,
        tasks=_counts(spec.name, episodes, seen),
        returns=keeping.summary(seen.returns),
        kept_returns=keeping.summary(seen.kept_returns),
        frames=seen.frames,
        seconds=seconds,
        frames_per_s=seen.frames / seconds,
        workers=workers,
        out=str(out),
        sha256=demonstrations.digest(Path(out), selection),
        preview=None if preview is None else str(preview),
    )


def _counts(task: str, episodes: int, seen: keeping.Seen) -> dict[str, TaskCount] | None:
    """The counts of each task of a set; None for a single task."""
    tasks = sim.members(task)
    if tasks == (task,):
        return None
    kept = keeping.shares(tasks, episodes)  # every task has its share
    return {name: TaskCount(kept[name], seen.failures[name]) for name in tasks}


def _workers(spec: TaskSpec, episodes: int, drop_below: float) -> int:
    """How many processes are worth their start.

    For a planner that is one per core; scripted experts are fast, and need fewer for few episodes.
    """
    if spec.measure == "return":
        return processes.worker_count(keeping.attempts(episodes, drop_below))
    least = _PER_WORKER if sim.has_colors(spec.name) else _PER_WORKER_METAWORLD
    return processes.worker_count(episodes // least)


def _passed(seen: keeping.Seen, drop_below: float) -> dict[str, Any]:
    """An artifact's meta about the episodes that were recorded and dropped."""
    if not seen.returns:
        return {"attempts": seen.attempts}
    dropped = seen.attempts - len(seen.kept_returns)
    return {
        "attempts": seen.attempts,
        "dropped": dropped,
        "drop_below": drop_below,
        "returns": keeping.summary(seen.returns),
    }


def _check(
    task: str, episodes: int, noise: float, workers: int | None, drop_below: float | None
) -> None:
    sim.check_recordable(task)
    if drop_below is not None and not sim.is_suite(task):
        expected = "a suite task, whose episodes have a return"
        raise AegisError(
            f"drop_below {drop_below:g} for task '{task}'",
            expected,
            "leave it out: failures are dropped anyway",
        )
    if drop_below is not None and not 0 <= drop_below < 1:  # NaN is neither
        raise AegisError(
            f"drop_below {drop_below}",
            "a share of the episodes, 0 or more and below 1",
            "e.g. 0.25",
        )
    if not 1 <= episodes <= MOST_MADE:
        expected = "at least 1 episode" if episodes < 1 else f"at most {MOST_MADE} episodes"
        raise AegisError(f"{episodes} episodes", expected, "use --episodes 300")
    if not (math.isfinite(noise) and noise >= 0):
        raise AegisError(f"noise {noise}", "a finite number >= 0", "use --noise 0.3")
    if workers is not None and workers < 1:
        raise AegisError(
            f"{workers} workers", "at least 1 worker", "leave `workers` out to use every core"
        )


def _check_form(out: Path, form: str, as_video: bool, cameras: Sequence[str]) -> None:
    if form not in FORMATS:
        raise AegisError(
            f"format '{form}'",
            f"one of: {', '.join(FORMATS)}",
            "leave --format out, or use --format lerobot",
        )
    if form == "lerobot":
        write.check_new(out)
        return
    if cameras:
        raise AegisError(
            f"--camera {cameras[0]} with --format safetensors",
            "the format that names its cameras",
            "add --format lerobot",
        )
    if as_video:
        raise AegisError(
            "--video with --format safetensors",
            "the format that can hold video",
            "add --format lerobot",
        )
    files.check_utf8(out, "choose another --out")
    files.check_writable(out)


def _save_folder(
    folder: Path,
    spec: TaskSpec,
    recorded: Iterator[RecordedEpisode],
    as_video: bool,
    cameras: Sequence[str],
) -> None:
    common = write.Spec(
        spec.control_hz, spec.proprio_names, spec.action_names, layout.ROBOT + spec.name, as_video
    )
    # Lazily: each episode is written before the next one is asked for.
    episodes = (_new_episode(episode, cameras) for episode in recorded)
    write.write(folder, episodes, common)


def _new_episode(recorded: RecordedEpisode, cameras: Sequence[str]) -> write.NewEpisode:
    """A recorded episode in the dataset's form, with its pictures by camera name."""
    pictures = (recorded.frames, *recorded.more_frames)
    return write.NewEpisode(
        dict(zip(cameras, pictures, strict=True)),
        recorded.proprio,
        recorded.actions,
        recorded.instruction,
    )


def _save(
    path: Path, spec: TaskSpec, kept: list[RecordedEpisode], seed: int, meta: dict[str, Any]
) -> None:
    instructions = sorted({e.instruction for e in kept})  # sorted, so that equal runs are equal
    starts = np.cumsum([0, *(len(e.actions) for e in kept)])  # [E + 1]
    tensors = {
        "proprio": np.concatenate([e.proprio for e in kept]),
        "actions": np.concatenate([e.actions for e in kept]),
        "episode_starts": starts.astype(np.int64),
        "instruction": np.array([instructions.index(e.instruction) for e in kept], np.int64),
    }
    if spec.measure == "return":
        tensors["returns"] = np.array([e.total_reward for e in kept], np.float64)
    elif sim.has_colors(spec.name):
        tensors["target_color"] = np.array([COLORS.index(e.target_color) for e in kept], np.int64)
        meta = {"colors": list(COLORS), **meta}
    else:
        tasks = sim.members(spec.name)
        tensors["task"] = np.array([tasks.index(e.task) for e in kept], np.int64)
        meta = {"tasks": list(tasks), **meta}
    # Last, because this empties `kept`.
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
            "control_hz": spec.control_hz,
            "action_names": list(spec.action_names),
            "proprio_names": list(spec.proprio_names),
            **meta,
        },
    )


def _join_frames(kept: list[RecordedEpisode], total: int) -> np.ndarray:
    """All frames [N, 64, 64, 3]; empties `kept` on the way, so that no picture is held twice."""
    frames = np.empty((total, *kept[0].frames.shape[1:]), np.uint8)
    kept.reverse()  # `pop` takes from the end
    start = 0
    while kept:
        part = kept.pop().frames
        frames[start : start + len(part)] = part
        start += len(part)
    return frames
