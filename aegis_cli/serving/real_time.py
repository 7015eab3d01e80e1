"""A policy that predicts while the robot moves, so that the robot need not stop and wait.

    with RealTime(load_policy("runs/arm")) as running:
        action = running.select_action(robot.get_observation(), "go to the red target")

This is algorithm 1 of real-time chunking (arXiv 2506.07339), called once per step of the robot. Its
guidance, which makes a chunk continue the previous one (`core.continuation`), is optional: it makes
the robot move more smoothly, but reduced success where it was measured (docs/own-robot.md).
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Any

import numpy as np
import torch

from aegis_cli.common.errors import AegisError
from aegis_cli.core.continuation import Continued
from aegis_cli.deploy import DeployedPolicy, Pictures, Positions, Seen

_REMEMBERED = 10  # past delays; the longest is expected for the next prediction


class RealTime:
    """Returns actions at the robot's rate, while the next chunk is predicted in a thread.

    The first action of an episode, or after a change of instruction, waits for its prediction.

    Attributes:
        execute: the fewest actions executed between two observations used for predictions.
        guided: whether a chunk continues the previous one.
        delay: how many actions the next prediction is expected to take: the longest of the last
            ten.
        waited: how often in this episode the robot had to wait, because a prediction took longer
            than the previous chunk lasted.
    """

    def __init__(
        self, policy: DeployedPolicy, execute: int | None = None, guided: bool = False
    ) -> None:
        """Begin the policy's next episode; the policy must not be used elsewhere meanwhile.

        Args:
            execute: None: the policy's `replan`, but at most half a chunk.
            guided: whether a chunk continues the previous one.

        Raises:
            AegisError: the policy has a temporal ensemble, or no actions of a chunk would be left.
        """
        if policy.ensemble is not None:
            raise AegisError(
                f"a policy with the temporal ensemble {policy.ensemble:g}",
                "one that executes several actions of each chunk",
                "use its own select_action, which predicts at every step, or train without it",
            )
        if execute is None:
            execute = max(1, min(policy.replan, policy.chunk // 2))
        if not 1 <= execute < policy.chunk:
            fix = f"RealTime(policy, execute={policy.chunk // 2})"
            raise AegisError(
                f"{execute} of the {policy.chunk} actions of a chunk to execute",
                "at least one, and fewer than a chunk has: the robot goes on with the others while "
                "the next chunk is predicted",
                fix if policy.chunk > 1 else "train with a longer train.chunk",
            )
        self._policy, self.execute, self.guided = policy, execute, guided
        # One thread: one prediction at a time, for which the next one waits.
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="aegis-real-time")
        self._closed = False
        self._pending: Future[np.ndarray] | None = None
        self._delays: deque[int] = deque(maxlen=_REMEMBERED)
        self._guess = 1  # until delays are known: from the time of the first prediction
        self.reset()

    def __enter__(self) -> RealTime:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    @property
    def delay(self) -> int:
        """How many actions the next prediction is expected to take."""
        return max(self._delays, default=self._guess)

    def close(self) -> None:
        """Wait for the prediction in progress, and end the thread."""
        self._thread.shutdown()
        self._closed = True

    def reset(self) -> None:
        """Begin an episode: forget the last prediction, and restart the flow's noise."""
        self._forget()
        self._policy.reset()
        self.waited = 0

    def select_action(
        self,
        pictures: Pictures | Mapping[str, Any],
        instruction: str | None = None,
        positions: Positions | None = None,
    ) -> np.ndarray:
        """The next action [A]; to be called once per step of the robot.

        Args:
            pictures, instruction, positions: see `DeployedPolicy.predict_action_chunk`.

        Raises:
            AegisError: as in `predict_action_chunk`, at each call for the observation, or for
                actions predicted meanwhile.
        """
        if self._closed:
            raise AegisError(
                "a policy in real time that was closed",
                "one that is open",
                "make a new RealTime, and select actions inside `with`",
            )
        # Read at each step, although few are used for predictions, to report errors at once.
        seen = self._policy.read(pictures, instruction, positions)
        if seen.instruction != self._follows:
            self._begin(seen)
        if self._pending is not None and (self._pending.done() or not self._ahead):
            self._adopt()
        if self._pending is None and (self._since >= self.execute or not self._ahead):
            self._start(seen)
            if not self._ahead:  # an earlier prediction failed, so the robot has to wait
                self._adopt()
        self._since += 1
        return self._ahead.popleft()

    def _begin(self, seen: Seen) -> None:
        """Predict the first chunk of an episode or of an instruction; the robot waits for it."""
        self._forget()
        started = time.perf_counter()
        self._ahead.extend(self._policy.predict(seen))
        # Only now, so that after a failed prediction the next call begins again.
        self._follows = seen.instruction
        steps = (time.perf_counter() - started) * (self._policy.fps or 0)
        self._guess = max(1, math.ceil(steps))

    def _forget(self) -> None:
        """Wait for the prediction in progress, and drop it with all earlier actions."""
        if self._pending is not None:
            self._pending.exception()  # waits, without raising an error that no longer matters
        self._pending = None
        self._ahead: deque[np.ndarray] = deque()
        self._follows: str | None = None  # the instruction of the remaining actions
        self._since = 0  # actions returned since the last observation used for a prediction

    def _start(self, seen: Seen) -> None:
        """Predict from this observation while the robot executes the remaining actions."""
        continued = None
        if self.guided and self._ahead:
            left = torch.from_numpy(np.stack(self._ahead))[None]  # [1, actions left, A]
            # The actions executed until the prediction arrives cannot be changed by it.
            continued = Continued(left, min(self.delay, len(self._ahead)))
        # A copy, since a camera may overwrite this picture with its next one.
        self._pending = self._thread.submit(self._policy.predict, seen.copy(), continued)
        self._since = 0

    def _adopt(self) -> None:
        """Continue with the predicted chunk; wait for it if it is not ready."""
        pending, self._pending = self._pending, None
        assert pending is not None
        self.waited += not pending.done()
        chunk = pending.result()  # raises the error of the prediction
        self._delays.append(self._since)
        # The chunk starts at its observation: the first actions are already past.
        self._ahead = deque(chunk[self._since :])
