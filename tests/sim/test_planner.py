"""The planner on problems with a known best plan, and what it must never depend on."""

from __future__ import annotations

from functools import cache

import mujoco
import numpy as np
import pytest

from aegis_cli.sim.planner import Score, Simulator, follow, improve, shift

STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
RNG = np.random.default_rng
SLIDER = """
<mujoco>
  <option timestep="0.01" gravity="0 0 0"/>
  <worldbody>
    <body>
      <joint name="x" type="slide" axis="1 0 0"/>
      <geom size="0.1" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor joint="x" gear="5"/></actuator>
</mujoco>
"""


def random_plan(seed: int) -> np.ndarray:
    rng = RNG(seed)
    return rng.uniform(-1, 1, size=(int(rng.integers(2, 10)), int(rng.integers(1, 4))))


def near(goal: np.ndarray):
    """The values of plans whose every knot should be `goal`."""
    return lambda plans: -np.square(plans - goal).sum((1, 2))


@pytest.mark.parametrize("seed", range(5))
def test_a_plan_is_followed_in_straight_lines_from_knot_to_knot(seed: int) -> None:
    plan = random_plan(seed)
    between = 4  # steps from a knot to the next
    actions = follow(plan, (len(plan) - 1) * between + 1)
    np.testing.assert_allclose(actions[::between], plan, atol=1e-12)
    np.testing.assert_allclose(
        actions[1:-1:between], plan[:-1] * 0.75 + plan[1:] * 0.25, atol=1e-12
    )


@pytest.mark.parametrize("seed", range(5))
def test_shifting_by_knots_moves_them_and_holds_the_last(seed: int) -> None:
    plan = random_plan(seed)
    for knots in range(len(plan)):
        moved = shift(plan, knots / (len(plan) - 1))
        np.testing.assert_allclose(moved[: len(plan) - knots], plan[knots:], atol=1e-12)
        np.testing.assert_allclose(
            moved[len(plan) - knots :], np.tile(plan[-1], (knots, 1)), atol=1e-12
        )
    np.testing.assert_allclose(shift(plan, 0.0), plan, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_the_known_best_plan_is_found(seed: int) -> None:
    goal = RNG(seed).uniform(-0.9, 0.9, size=2)
    plan, rng = np.zeros((3, 2)), RNG(seed)
    for _ in range(150):
        plan = improve(plan, near(goal), 32, rng)
    assert np.abs(plan - goal).max() < 0.1


@pytest.mark.parametrize("seed", range(5))
def test_plans_stay_within_bounds_whatever_the_worth(seed: int) -> None:
    plan, rng = random_plan(seed), RNG(seed)
    for _ in range(20):
        plan = improve(
            plan, near(np.full(plan.shape[1], 5.0)), 16, rng
        )  # the best plan is far outside
        assert np.abs(plan).max() <= 1
    assert plan.mean() > 0.8


@pytest.mark.parametrize(
    "worth", [near(np.zeros(1)), lambda plans: np.abs(plans.mean((1, 2)))]
)  # one best way, and two
def test_nothing_that_was_tried_is_better_than_what_is_chosen(worth: Score) -> None:
    for seed in range(20):
        tried: list[float] = []

        def score(plans: np.ndarray) -> np.ndarray:
            tried.extend(worth(plans))
            return worth(plans)

        chosen = improve(np.zeros((4, 1)), score, 8, RNG(seed))
        assert worth(chosen[None])[0] == max(tried) >= worth(np.zeros((1, 4, 1)))[0]


def test_where_all_plans_are_worth_the_same_the_plan_stays() -> None:
    plan = random_plan(0)
    np.testing.assert_array_equal(
        improve(plan, lambda plans: np.ones(len(plans)), 16, RNG(0)), plan
    )


def test_equal_generators_give_equal_plans() -> None:
    plan, score = random_plan(1), near(np.zeros(random_plan(1).shape[1]))
    first, again, other = (improve(plan, score, 16, RNG(seed)) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


# --- simulation ----------------------------------------------------------------------------------


@cache
def slider() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(SLIDER)


def start_of(model: mujoco.MjModel) -> np.ndarray:
    data, state = mujoco.MjData(model), np.empty(mujoco.mj_stateSize(model, STATE))
    data.qpos[0], data.qvel[0] = 0.2, -0.5
    mujoco.mj_getState(model, data, state, STATE)
    return state


def test_states_are_those_of_stepping_by_hand() -> None:
    model, controls = slider(), RNG(0).uniform(-1, 1, size=(3, 4, 1))
    states = Simulator(model, substeps=5).states(start_of(model), controls)
    data, state = mujoco.MjData(model), np.empty(states.shape[-1])
    for plan in range(3):
        mujoco.mj_setState(model, data, start_of(model), STATE)
        for t in range(4):
            data.ctrl[:] = controls[plan, t]
            mujoco.mj_step(model, data, 5)
            mujoco.mj_getState(model, data, state, STATE)
            np.testing.assert_allclose(states[plan, t], state, rtol=0, atol=1e-12)


@pytest.mark.parametrize("threads", [2, 3])
def test_threads_change_nothing(threads: int) -> None:
    from dm_control import suite

    model = suite.load(
        "finger", "spin", task_kwargs={"random": 0}
    ).physics.model.ptr  # with contacts
    controls = RNG(0).uniform(-1, 1, size=(17, 20, 2))
    one, several = (Simulator(model, 2, n).states(start_of(model), controls) for n in (1, threads))
    np.testing.assert_array_equal(one, several)
    assert one.shape[:2] == (17, 20) and one[:, -1].std(0).max() > 0


def test_a_slider_is_brought_to_rest_at_its_goal() -> None:
    """Ten replans of a planner in closed loop.

    With full force the goal can be reached in half of that time.
    """
    model = slider()
    simulator, data, rng = Simulator(model, 2), mujoco.MjData(model), RNG(0)
    plan, state = np.zeros((4, 1)), np.empty(mujoco.mj_stateSize(model, STATE))
    for _ in range(40):
        mujoco.mj_getState(model, data, state, STATE)

        def worth(plans: np.ndarray) -> np.ndarray:
            found = simulator.states(state, np.stack([follow(p, 20) for p in plans]))
            return -np.abs(found[:, :, 1] - 0.5).sum(1) - 0.1 * np.abs(found[:, -1, 2])

        plan = improve(plan, worth, 32, rng)
        for action in follow(plan, 20)[:4]:
            data.ctrl[:] = action
            mujoco.mj_step(model, data, 2)
        plan = shift(plan, 4 / 19)
    assert abs(data.qpos[0] - 0.5) < 0.05 and abs(data.qvel[0]) < 0.3
