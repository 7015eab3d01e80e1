"""`aegis bench --latency`: how long a run's policy takes to predict one chunk, on this machine."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from aegis_cli.common import devices
from aegis_cli.common.events import OnEvent, Progress, ignore
from aegis_cli.deploy import DeployedPolicy, load_policy
from aegis_cli.evaluation.bench_runs import INSTRUCTION

_WARM_UP = 3  # predictions that are not timed: the first ones allocate and compile
_SIDE = 224  # of the pictures, in pixels, for a backbone that accepts any size


@dataclass(frozen=True)
class LatencyReport:
    """Milliseconds from pictures to actions, one observation at a time.

    Attributes:
        precision: of the matrix products, the default of `load_policy`.
        p50_ms, p95_ms: the median and the 95 % quantile of the predictions' times.
        chunk, replan: actions per prediction, and the number of them that is executed.
        actions_per_s: `replan` actions per median prediction; a robot whose motion waits for the
            next prediction gets fewer.
    """

    run: str
    device: str
    precision: str
    p50_ms: float
    p95_ms: float
    chunk: int
    replan: int
    actions_per_s: float
    repeats: int


def run(run_path: Path, repeats: int = 50, on_event: OnEvent = ignore) -> LatencyReport:
    """Time `repeats` predictions of a run's policy, on random pictures.

    Raises:
        AegisError: there is no such run.
    """
    # Nothing is said of the positions, which are no robot's.
    policy = load_policy(run_path).begin(lambda _: None)
    taken = 1000 * np.array(seconds(policy, repeats, on_event))  # [repeats] ms
    p50, p95 = (float(ms) for ms in np.quantile(taken, (0.5, 0.95)))
    return LatencyReport(
        run=str(run_path),
        device=str(devices.pick()),
        precision=policy.precision,
        p50_ms=p50,
        p95_ms=p95,
        chunk=policy.chunk,
        replan=policy.replan,
        actions_per_s=1000 * policy.replan / p50,
        repeats=repeats,
    )


def seconds(policy: DeployedPolicy, repeats: int, on_event: OnEvent = ignore) -> list[float]:
    """The seconds of each of `repeats` predictions.

    The actions are copied to the CPU, so a GPU has finished when the time is taken.
    """
    # Random pictures: the time of a prediction does not depend on their contents.
    rng = np.random.default_rng(0)
    side = policy.image_size or _SIDE
    names = policy.cameras or ("image",)
    pictures = {name: rng.integers(0, 256, (side, side, 3), np.uint8) for name in names}
    shown = pictures if len(names) > 1 else pictures[names[0]]
    positions = np.zeros(policy.positions, np.float32)
    found = []
    for i in range(_WARM_UP + repeats):
        started = time.perf_counter()
        policy.predict_action_chunk(shown, INSTRUCTION, positions)
        found.append(time.perf_counter() - started)
        on_event(Progress("latency", i + 1, _WARM_UP + repeats, "chunks"))
    return found[_WARM_UP:]
