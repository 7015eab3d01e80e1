"""Environments in processes of their own: they are equal, and errors are passed on."""

from __future__ import annotations

import multiprocessing
import os
import signal
from typing import Any

import numpy as np
import pytest
from samples.training import make_policy

from aegis_cli import sim
from aegis_cli.common.errors import AegisError
from aegis_cli.common.palette import SEEN
from aegis_cli.common.processes import WorkerPool
from aegis_cli.models import acting
from aegis_cli.sim.contract import EVALUATION, episode_rng
from aegis_cli.sim.simulators import Wanted, opened


@pytest.mark.usefixtures("quick_workers")
def test_an_environment_is_the_same_in_another_process() -> None:
    def shown(env: Any) -> list[Any]:
        seen = env.reset(episode_rng(3, EVALUATION, 1), SEEN)
        found = [env.spec, env.target_color, env.target_circle(), seen.image, seen.proprio]
        for look in (False, True):
            action = env.expert_action()
            step = env.step(action, look)
            found += [action, step.done, step.success, env.distance()]
        return [*found, step.observation.image, step.observation.instruction]

    here = shown(sim.make("point"))
    with opened(2, 3) as simulators:
        envs = [simulators.make(Wanted("point", number)) for number in range(3)]
        processes = {env._pool.submit(os.getpid).result() for env in envs}
        assert len(processes) == 2 and os.getpid() not in processes
        for env in envs:
            for own, other in zip(here, shown(env), strict=True):
                np.testing.assert_equal(other, own)
    assert not multiprocessing.active_children()


def test_of_one_process_it_is_this_one() -> None:
    with opened(1, 3) as simulators:
        made = simulators.make(Wanted("point", 0))
        assert type(made) is type(sim.make("point"))
        done: list[int] = []
        simulators.each(done.append, range(5))
    assert done == [0, 1, 2, 3, 4]


def test_libero_alone_repays_processes_and_those_of_a_study_start_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 16)
    assert [sim.workers("libero/object", episodes) for episodes in (1, 4, 500)] == [1, 4, 10]
    assert {sim.workers(name, 500) for name in ("reach", "metaworld/mt4")} == {1}
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    assert sim.workers("libero/object", 500) == 2
    with WorkerPool(1, "a process", "") as pool:
        assert pool.submit(sim.workers, "libero/object", 500).result() == 1


def test_a_task_that_cannot_be_made_starts_no_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sim, "workers", lambda *_: 4)

    def missing(*_: Any, **__: Any) -> None:
        raise AegisError("no package 'x'", "it", "install it")

    monkeypatch.setattr(sim, "make", missing)
    played = acting.Acting(make_policy(), "point", 4)
    with pytest.raises(AegisError, match="no package 'x'"):
        acting.play(played, 4, "seen")
    assert not multiprocessing.active_children()


@pytest.mark.usefixtures("quick_workers")
def test_an_error_there_is_an_error_here() -> None:
    with opened(2, 3) as simulators:
        env = simulators.make(Wanted("point", 0))
        env.reset(episode_rng(3, EVALUATION, 1), SEEN)
        for number in range(2):  # the process continues

            def act(_: int) -> None:
                env.step(np.array([np.nan, 0.0]))

            with pytest.raises(AegisError, match="2 finite numbers"):
                simulators.each(act, range(number + 1))


@pytest.mark.usefixtures("quick_workers")
def test_a_process_that_dies_is_named() -> None:
    with (
        pytest.raises(AegisError, match="a simulating process died"),
        opened(2, 3) as simulators,
    ):
        envs = [simulators.make(Wanted("point", number)) for number in range(2)]
        os.kill(envs[1]._pool.submit(os.getpid).result(), signal.SIGKILL)
        simulators.each(lambda env: env.reset(episode_rng(3, EVALUATION, 1), SEEN), envs)
    assert not multiprocessing.active_children()
