"""`aegis rollout`: a trained policy in closed loop, on episodes that no demonstration came from."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from aegis_cli import sim
from aegis_cli.common import circumstances, devices, gl, media
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Warned, ignore, loading_told
from aegis_cli.common.kept_lines import KeptLines
from aegis_cli.common.limits import MOST_MADE
from aegis_cli.core import ensemble as temporal
from aegis_cli.evaluation import results
from aegis_cli.models.acting import DEFAULT, EVALUATION_SEED, Acting, RolloutReport, play
from aegis_cli.models.policy import Policy
from aegis_cli.sim import libero_table
from aegis_cli.sim.contract import EVALUATION, TaskSpec
from aegis_cli.training import checkpoint

_LIBERO = "libero/spatial"
Load = Callable[[Path, str | None], Acting]


def load_run(run: Path, task: str | None) -> Acting:
    """The policy of one training run, and its task: the one trained on, or the requested one.

    Raises:
        AegisError: no trained run, another task than the run's, or a policy with several cameras.
    """
    policy, meta = checkpoint.load_policy(run)
    cameras = checkpoint.cameras_of(meta, meta["task"] or task)
    acts_in = _task(policy, meta["task"], task)
    sizes = checkpoint.sizes_of(meta)
    rate = meta.get("fps") if meta["task"] is None else None
    return Acting(policy, acts_in, meta["replan"], cameras, meta.get("ensemble"), sizes, rate)


def run(
    run_path: Path,
    task: str | None,
    episodes: int,
    colors: str,
    video_out: Path | None = None,
    replan: int | None = None,
    on_event: OnEvent = ignore,
    stream: int = EVALUATION,
    load: Load | None = None,
    seed: int = EVALUATION_SEED,
    keep: bool = False,
    ensemble: float | None = None,
    delay: int | None = None,
    guided: bool = False,
) -> RolloutReport:
    """Act in `episodes` episodes; `replan` actions of each predicted chunk are executed.

    The episodes are the same for every run and method: they depend only on the task, the seed and
    their number.

    Args:
        colors: one of TARGET_COLORS; a task without coloured targets has the default only.
        load: how the folder is read; default: `load_run`, which reads runs of one policy.
        keep: write the report into the run's folder.
        ensemble: decay of a temporal ensemble; None: the policy's own, unless `replan` is given.
        delay: steps that a prediction takes, during which the robot continues with the previous
            chunk; None: it waits.
        guided: whether a delayed chunk is guided to continue the previous one.

    Raises:
        AegisError: no trained run, another task than the run's, colours it does not have, zero
            episodes, a decay that is not finite, or a delay for which a chunk is too short.
    """
    if ensemble is not None:
        temporal.check(ensemble)
    if not 1 <= episodes <= MOST_MADE:
        expected = "at least 1 episode" if episodes < 1 else f"at most {MOST_MADE} episodes"
        raise AegisError(f"{episodes} episodes", expected, "use --episodes 50")
    if video_out is not None:
        media.check_video(video_out)
    gl.check()
    with loading_told("rollout", on_event):
        acting = (load or load_run)(Path(run_path), task)
    if acting.rate is not None:
        _check_rate(acting.rate, acting.task, on_event)
    # A given `replan` disables the policy's own ensemble, which executes one action per prediction.
    decay = acting.ensemble if ensemble is None and replan is None else ensemble
    if not sim.has_colors(acting.task) and colors != DEFAULT:
        raise AegisError(
            f"{colors} colours for '{acting.task}'",
            "a task with coloured targets",
            "leave out --colors",
        )
    executed = replan or acting.replan
    if delay is not None:
        _check_delay(delay, executed, acting.policy.expert.shape.chunk, decay)
    about = _circumstances(acting, colors, stream, seed, delay, guided, executed, decay)
    policy = acting.policy.to(devices.pick())
    acting = acting._replace(policy=policy, replan=executed, ensemble=decay)
    kept = KeptLines("episodes", about, on_event)
    report = play(acting, episodes, colors, stream, video_out, on_event, seed, delay, guided, kept)
    if keep:
        name = "-".join(["rollout", *([] if task is None else [task]), colors])
        settings = {"task": acting.task, "episodes": episodes, "colors": colors, "seed": seed}
        settings |= {"replan": executed}
        settings |= {} if decay is None else {"ensemble": decay}
        settings |= {} if delay is None else {"delay": delay, "guided": guided}
        results.keep_if_possible(Path(run_path), name, report.to_json(), settings, on_event)
    return report


def _circumstances(acting: Acting, *settings: Any) -> dict[str, Any]:
    """What the episodes depend on: the policy, where and how it acts, and the simulator."""
    policy = acting.policy.fingerprint()
    place = [acting.task, list(acting.cameras), [list(size) for size in acting.sizes]]
    played = circumstances.of_episodes(gl.choose_backend())
    return {"policy": policy, "place": place, "how": list(settings), **played}


def _check_delay(delay: int, replan: int, chunk: int, ensemble: float | None) -> None:
    """Raise AegisError for a delay for which chunks are too short."""
    if ensemble is not None:
        raise AegisError(
            f"a delay of {delay} steps with the temporal ensemble {ensemble:g}",
            "one of the two",
            "leave the delay out: it is for policies that execute several actions of each chunk",
        )
    longest = min(replan, chunk - replan)
    if not 0 <= delay <= longest:
        raise AegisError(
            f"a delay of {delay} steps, with chunks of {chunk} actions, {replan} of them executed",
            f"0 to {longest}: at most as many as are left of a chunk and executed of the next",
            f"use --delay {longest}, or a policy of longer chunks (train.chunk)",
        )


def _task(policy: Policy, trained: str | None, asked: str | None) -> str:
    """The task to act in: the one trained on, or else a requested one that fits the policy."""
    if asked is not None:
        sim.check(asked)
    if trained is not None:
        if asked is not None and asked != trained and not _alike(trained, asked):
            found = f"task '{asked}' for a policy trained on '{trained}'"
            raise AegisError(found, "the task it was trained on", f"--task {trained}")
        return asked or trained
    shape = policy.expert.shape
    own = (shape.proprio, shape.actions)
    if asked is None:
        libero = libero_table.spec(_LIBERO)
        likely = _LIBERO if own == _sizes(libero) else next(iter(sim.TASKS))
        raise AegisError(
            "a policy trained on a dataset that is not of a simulated task",
            "a task with the positions and actions that it was trained on",
            f"--task {likely}",
        )
    sizes = _sizes(sim.make(asked).spec)
    if sizes != own:
        found = f"a policy of {own[0]} positions and {own[1]} actions for task '{asked}'"
        raise AegisError(
            found, f"{sizes[0]} and {sizes[1]}, as the task has", "roll it out on its own robot"
        )
    return asked


def _sizes(spec: TaskSpec) -> tuple[int, int]:
    """How many positions and actions a task has."""
    return len(spec.proprio_names), len(spec.action_names)


def _alike(trained: str, asked: str) -> bool:
    """Whether both are tasks of LIBERO, which has one robot, and whose datasets mix suites."""
    return None not in (sim.of_datasets(trained), sim.of_datasets(asked))


def _check_rate(rate: float, task: str, on_event: OnEvent) -> None:
    """Warn about a task whose time step differs from that of the policy's training."""
    spec = sim.make(task).spec
    own = spec.control_hz
    if not any(math.isclose(known, rate, rel_tol=1e-3) for known in (own, spec.said_hz or own)):
        text = (
            f"'{task}' has {own:g} steps a second, but the policy was trained on {rate:g}: its "
            "actions are meant for steps of a different length"
        )
        on_event(Warned("rollout", text))
