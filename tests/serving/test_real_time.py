"""A robot that never waits: its actions are those that were predicted for its current step."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent import futures
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from samples.training import images, make_policy

from aegis_cli import RealTime, load_policy
from aegis_cli.common.errors import AegisError
from aegis_cli.core.continuation import Continued
from aegis_cli.deploy import DeployedPolicy, Seen
from aegis_cli.serving import real_time

TEXT, OTHER = "go to the red target", "go to the blue target"
CHUNK = 4


def deployed(replan: int = 2, ensemble: float | None = None) -> DeployedPolicy:
    return DeployedPolicy(make_policy().eval(), None, (), replan, ensemble=ensemble)


def at(step: int) -> list[float]:
    """Positions that encode the robot's current step."""
    return [float(step), 0.0, 0.0]


class Planned(DeployedPolicy):
    """A policy whose every action is the number of the step for which it is meant.

    All predictions except the first of an instruction wait until they may end.
    """

    def __init__(self, replan: int = 2) -> None:
        super().__init__(make_policy().eval(), None, (), replan)
        self.asked: list[tuple[Seen, Continued | None]] = []
        self.may_end = threading.Semaphore(0)
        self.alone = threading.Lock()
        self.fails = False

    def predict(self, seen: Seen, continued: Continued | None = None) -> np.ndarray:
        self.asked.append((seen, continued))
        assert self.alone.acquire(blocking=False)  # two at once would share the noise
        if threading.current_thread() is not threading.main_thread():
            assert self.may_end.acquire(timeout=30)
        self.alone.release()
        if self.fails:
            raise AegisError("a picture of nothing", "something", "look elsewhere")
        step = seen.positions[0] + np.arange(CHUNK, dtype=np.float32)
        return np.stack([step, step], axis=1)


@pytest.fixture
def planned() -> Iterator[Planned]:
    policy = Planned()
    yield policy
    policy.may_end.release(100)  # a failed test leaves no thread behind


def finished(running: RealTime) -> None:
    """Let the pending prediction end, and wait until it has."""
    running._policy.may_end.release()
    futures.wait([running._pending])


@pytest.mark.parametrize("seed", range(10))
def test_each_action_is_one_for_its_own_step_whatever_predictions_take(
    seed: int, planned: Planned
) -> None:
    rng = np.random.default_rng(seed)
    picture = images(1)[0].numpy()
    taken, ends = list[int](), 0
    with RealTime(planned, guided=True) as running:
        for step in range(30):
            if running._pending is not None and step == ends:
                finished(running)
            action = running.select_action(picture, TEXT, at(step))
            assert action.tolist() == [step, step]
            if running._pending is not None and running._since == 1:  # it has just started
                taken.append(int(rng.integers(1, 3)))  # at most as long as the previous chunk lasts
                ends = step + taken[-1]
        assert running.waited == 0 and running.delay == max(taken[-11:-1])
        planned.may_end.release(10)
    assert len(planned.asked) == 1 + len(taken) > 10
    for seen, continued in planned.asked[1:]:
        left = continued.actions[0, :, 0].numpy()
        np.testing.assert_array_equal(left, seen.positions[0] + np.arange(len(left)))
        assert 1 <= continued.delay <= len(left)


def test_without_guidance_a_chunk_is_predicted_by_itself(planned: Planned) -> None:
    picture = images(1)[0].numpy()
    with RealTime(planned) as running:
        for step in range(8):
            if running._pending is not None:
                finished(running)
            assert running.select_action(picture, TEXT, at(step)).tolist() == [step, step]
        planned.may_end.release(10)
    assert len(planned.asked) > 2 and not any(continued for _, continued in planned.asked)


def test_the_longest_of_the_last_delays_is_expected(planned: Planned) -> None:
    picture = images(1)[0].numpy()
    with RealTime(planned, guided=True) as running:
        for step in range(6):
            if step in (3, 5):  # asked for in step 2, used from step 3 on: a delay of 1
                finished(running)
            running.select_action(picture, TEXT, at(step))
        assert running.delay == 1 and [c and c.delay for _, c in planned.asked] == [None, 1, 1]
        running.select_action(picture, TEXT, at(6))  # two steps have passed since step 4
        planned.may_end.release(10)


def test_a_slow_first_prediction_is_expected_once_and_shifts_no_action(
    planned: Planned, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a GPU, which initializes during it. The robot stands still, so nothing is skipped."""
    picture, times = images(1)[0].numpy(), iter([0.0, 0.65])
    monkeypatch.setattr(real_time, "time", SimpleNamespace(perf_counter=times.__next__))
    planned.fps = 10
    with RealTime(planned, guided=True) as running:
        for step in range(4):
            if step == 3:
                finished(running)
            assert running.select_action(picture, TEXT, at(step)).tolist() == [step, step]
            assert running.delay == (7 if step < 3 else 1)  # 6.5 steps, then the measured time
        # The chunk is held to all that is left of the previous one, and to no more.
        assert [c and (c.delay, c.actions.shape[1]) for _, c in planned.asked] == [None, (2, 2)]
        planned.may_end.release(10)


def test_a_robot_that_has_nothing_left_to_do_waits_and_goes_on(planned: Planned) -> None:
    picture = images(1)[0].numpy()
    with RealTime(planned, guided=True) as running:
        for step in range(4):
            running.select_action(picture, TEXT, at(step))
        threading.Timer(0.05, planned.may_end.release).start()
        # Requested in step 2, it has an action for step 4.
        assert running.select_action(picture, TEXT, at(4)).tolist() == [4, 4]
        assert running.waited == 1 and running.delay == 2
        planned.may_end.release(10)


def test_what_went_wrong_meanwhile_is_said_by_the_next_action(planned: Planned) -> None:
    picture = images(1)[0].numpy()
    with RealTime(planned, guided=True) as running:
        for step in range(3):
            running.select_action(picture, TEXT, at(step))
        planned.fails = True
        finished(running)
        with pytest.raises(AegisError, match="a picture of nothing"):
            running.select_action(picture, TEXT, at(3))
        planned.fails = False
        planned.may_end.release(10)
        # The same step again: the old chunk still has an action for it.
        assert running.select_action(picture, TEXT, at(3)).tolist() == [3, 3]


def test_after_a_failure_the_next_prediction_begins_where_nothing_is_left(
    planned: Planned,
) -> None:
    picture = images(1)[0].numpy()
    with RealTime(planned, 3, guided=True) as running:
        for step in range(4):
            running.select_action(picture, TEXT, at(step))
        planned.fails = True
        planned.may_end.release()
        with pytest.raises(AegisError, match="a picture of nothing"):
            running.select_action(picture, TEXT, at(4))
        planned.fails = False
        planned.may_end.release()
        assert running.select_action(picture, TEXT, at(4)).tolist() == [4, 4]
        planned.may_end.release(10)


def test_a_sensor_that_fails_stops_the_robot_at_once(planned: Planned) -> None:
    picture = images(1)[0].numpy()
    with RealTime(planned, guided=True) as running:
        running.select_action(picture, TEXT, at(0))
        with pytest.raises(AegisError, match="not finite"):
            running.select_action(picture, TEXT, [float("nan"), 0, 0])


def test_another_instruction_begins_anew(planned: Planned) -> None:
    picture = images(1)[0].numpy()
    with RealTime(planned, guided=True) as running:
        for step in range(3):
            running.select_action(picture, TEXT, at(step))
        # The pending prediction is for the old instruction.
        threading.Timer(0.05, planned.may_end.release).start()
        assert running.select_action(picture, OTHER, at(50)).tolist() == [50, 50]
        assert [c is None for _, c in planned.asked] == [True, False, True]
        assert running.select_action(picture, OTHER, at(51)).tolist() == [51, 51]


def test_a_camera_may_write_its_next_picture_over_the_last(planned: Planned) -> None:
    picture, positions = images(1)[0].numpy().copy(), np.array(at(0), np.float32)
    shown = picture.copy()
    with RealTime(planned, guided=True) as running:
        for step in range(3):
            positions[0] = step
            running.select_action(picture, TEXT, positions)
        picture[:], positions[:] = 0, 0  # while it is predicted from
        finished(running)
    seen = planned.asked[-1][0]
    np.testing.assert_array_equal(seen.pictures[0], shown)
    assert seen.positions[0] == 2


def test_an_episode_begins_as_that_of_the_policy_does() -> None:
    picture = images(1)[0].numpy()
    expected = deployed().select_action(picture, TEXT, at(0))
    with RealTime(deployed()) as running:
        first = running.select_action(picture, TEXT, at(0))
        for _ in range(5):
            running.select_action(picture, TEXT, at(0))
        running.reset()
        again = running.select_action(picture, TEXT, at(0))
    np.testing.assert_array_equal(first, expected)
    np.testing.assert_array_equal(again, expected)


def test_chunks_of_a_real_policy_continue_each_other(run_folder: Path) -> None:
    """Its own thread computes gradients, within a program that computes none."""
    picture = images(1)[0].numpy()
    with torch.inference_mode(), RealTime(load_policy(run_folder), guided=True) as running:
        positions = [0.1] * running._policy.positions
        actions = [running.select_action(picture, TEXT, positions) for _ in range(12)]
    assert np.isfinite(actions).all() and len(actions) == 12


@pytest.mark.parametrize(
    ("replan", "execute", "found"), [(2, None, 2), (4, None, 2), (1, None, 1), (2, 3, 3)]
)
def test_it_executes_the_policys_replan_and_half_a_chunk_at_most(
    replan: int, execute: int | None, found: int
) -> None:
    with RealTime(deployed(replan), execute) as running:
        assert running.execute == found


@pytest.mark.parametrize("execute", [0, CHUNK, -1])
def test_chunks_of_which_nothing_is_left_are_refused(execute: int) -> None:
    with pytest.raises(AegisError, match=f"{execute} of the {CHUNK} actions") as caught:
        RealTime(deployed(), execute)
    assert "execute=2" in caught.value.fix


def test_a_temporal_ensemble_is_refused() -> None:
    with pytest.raises(AegisError, match="temporal ensemble 0.1"):
        RealTime(deployed(ensemble=0.1))


def test_a_closed_one_says_so() -> None:
    with RealTime(deployed()) as running:
        running.select_action(images(1)[0].numpy(), TEXT, at(0))
    with pytest.raises(AegisError, match="was closed"):
        running.select_action(images(1)[0].numpy(), TEXT, at(1))
