"""A policy that predicts while the robot moves, so that the robot never stands still to wait.

    with RealTime(load_policy("runs/arm")) as running:
        action = running.select_action(robot.get_observation(), "go to the red target")

This is algorithm 1 of real-time chunking (arXiv 2506.07339), called once a step of the robot. Its
guidance, by which a chunk continues the one before (`core.continuation`), is a choice: it makes the
robot move more smoothly, and cost success where it was measured (docs/own-robot.md).
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

_REMEMBERED = 10  # delays, of which the longest is expected of the next prediction


class RealTime:
    """Hands out actions at the robot's rate, while the next chunk is predicted in a thread.

    The first action of an episode, and that of another instruction, waits for its prediction.

    Attributes:
        execute: how many actions are executed at least between two observations that are
            predicted from.
        guided: whether a chunk continues the one before.
        delay: how many actions the next prediction is expected to take, as many as the longest of
            the last ten.
        waited: how often the robot had to wait since the episode began, for a prediction took
            longer than the chunk before it lasted.
    """

    def __init__(
        self, policy: DeployedPolicy, execute: int | None = None, guided: bool = False
    ) -> None:
        """Begin the policy's next episode; nobody else may let it act meanwhile.

        Args:
            execute: None: as many as the policy's `replan`, and half a chunk at most.
            guided: whether a chunk is to continue the one before.

        Raises:
            AegisError: a temporal ensemble, or chunks of which nothing would be left.
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
        # One thread: a prediction at a time, and the next one waits for it.
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="aegis-real-time")
        self._closed = False
        self._pending: Future[np.ndarray] | None = None
        self._delays: deque[int] = deque(maxlen=_REMEMBERED)
        self._guess = 1  # before any is known: what the first prediction took
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
        """Wait for the prediction that is under way, and end the thread."""
        self._thread.shutdown()
        self._closed = True

    def reset(self) -> None:
        """Begin an episode: forget the last prediction, and begin the flow's noise anew."""
        self._forget()
        self._policy.reset()
        self.waited = 0

    def select_action(
        self,
        pictures: Pictures | Mapping[str, Any],
        instruction: str | None = None,
        positions: Positions | None = None,
    ) -> np.ndarray:
        """The next action [A], to be called once a step of the robot.

        Args:
            pictures, instruction, positions: see `DeployedPolicy.predict_action_chunk`.

        Raises:
            AegisError: what `predict_action_chunk` finds wrong with an observation, at each call,
                or found wrong with the actions that it predicted meanwhile.
        """
        if self._closed:
            raise AegisError(
                "a policy in real time that was closed",
                "one that is open",
                "make a new RealTime, and select actions inside `with`",
            )
        # Read at each step, though few are predicted from: what is wrong with one is said at once.
        seen = self._policy.read(pictures, instruction, positions)
        if seen.instruction != self._follows:
            self._begin(seen)
        if self._pending is not None and (self._pending.done() or not self._ahead):
            self._adopt()
        if self._pending is None and (self._since >= self.execute or not self._ahead):
            self._start(seen)
            if not self._ahead:  # an earlier prediction has failed, and the robot has to wait
                self._adopt()
        self._since += 1
        return self._ahead.popleft()

    def _begin(self, seen: Seen) -> None:
        """Predict the first chunk of an episode or of an instruction; the robot waits for it."""
        self._forget()
        started = time.perf_counter()
        self._ahead.extend(self._policy.predict(seen))
        # Only now: after a prediction that failed the next call begins again.
        self._follows = seen.instruction
        steps = (time.perf_counter() - started) * (self._policy.fps or 0)
        self._guess = max(1, math.ceil(steps))

    def _forget(self) -> None:
        """Wait for what is being predicted, and drop it with all that was."""
        if self._pending is not None:
            self._pending.exception()  # waits, and does not raise what nobody asks for any more
        self._pending = None
        self._ahead: deque[np.ndarray] = deque()
        self._follows: str | None = None  # the instruction that the actions ahead are of
        self._since = 0  # actions handed out since the last observation that was predicted from

    def _start(self, seen: Seen) -> None:
        """Predict from this observation, while the robot executes what is left."""
        continued = None
        if self.guided and self._ahead:
            left = torch.from_numpy(np.stack(self._ahead))[None]  # [1, actions left, A]
            # As many as are executed until the prediction is there cannot be changed by it.
            continued = Continued(left, min(self.delay, len(self._ahead)))
        # A camera may write its next picture to where this one lies.
        self._pending = self._thread.submit(self._policy.predict, seen.copy(), continued)
        self._since = 0

    def _adopt(self) -> None:
        """Go on with the chunk that was being predicted; wait for it if it is not there yet."""
        pending, self._pending = self._pending, None
        assert pending is not None
        self.waited += not pending.done()
        chunk = pending.result()  # raises what was wrong with it
        self._delays.append(self._since)
        # The chunk begins at the observation: actions of that time are past.
        self._ahead = deque(chunk[self._since :])
