"""`suite/<domain>-<task>`: any original task of dm_control's suite; the expert is a planner."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from aegis_cli.common.errors import AegisError
from aegis_cli.sim.contract import SUITE, Observation, Step, TaskSpec, checked
from aegis_cli.sim.planner import Simulator, follow, improve, shift
from aegis_cli.sim.screen import Screen
from aegis_cli.sim.suite_table import KNOWN, Known, sentence

import mujoco  # isort: skip  (after planner, which chooses the OpenGL backend)
from dm_control import suite  # isort: skip
from dm_control.rl.control import PhysicsError  # isort: skip

_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
STEPS = 1000  # an episode's limit: the suite's own, and ours for lqr, which has none
_UNBOUNDED = 1e9  # larger bounds count as none, as for lqr's forces; 1 then means one newton


def names() -> tuple[str, ...]:
    """The names of all tasks of the suite in `aegis`."""
    return tuple(f"{SUITE}{domain}-{task}" for domain, task in suite.ALL_TASKS)


class SuiteTask:
    """A `contract.TaskEnv` without target colours.

    The action is the suite's own, with its range mapped to [-1, 1]. Proprioception is the suite's
    full observation, including velocities. Our own tasks leave velocities out, because a policy
    that sees that it is at rest learns to stay at rest. Here the action is a force without a servo,
    and balancing a pole requires knowing how it falls.

    The expert is a planner. It makes a plan every `Search.replan_s` and follows it until the next.
    """

    target_color = None

    def __init__(self, name: str, threads: int = 1) -> None:
        domain, _, task = name.removeprefix(SUITE).partition("-")
        # A fixed seed, because lqr draws its springs when it is created.
        self._env = suite.load(domain, task, task_kwargs={"random": 0})
        self.physics = _without_contexts(self._env.physics)
        self.spec = self._describe(name)
        self._screen = _screen(name, self.physics.model.ptr)
        self._expert = _Expert(self._env, KNOWN.get(name.removeprefix(SUITE), Known()), threads)

    def _describe(self, name: str) -> TaskSpec:
        model = self.physics.model
        return TaskSpec(
            name=name,
            action_names=tuple(model.id2name(i, "actuator") for i in range(model.nu)),
            proprio_names=tuple(_labels(self._env.reset().observation)),
            max_steps=STEPS,
            control_hz=1 / self._env.control_timestep(),
            templates=(sentence(name),),
            measure="return",
            camera=model.id2name(0, "camera"),
        )

    def reset(self, rng: np.random.Generator, target_colors: Sequence[str]) -> Observation:
        """See `contract.TaskEnv`; there are no colours."""
        self._env.task.random.seed(int(rng.integers(2**32)))
        self._expert.begin(np.random.default_rng(int(rng.integers(2**63))))
        self._steps = 0
        return self._observe(self._env.reset().observation)

    def _observe(self, observation: Mapping[str, Any]) -> Observation:
        proprio = np.concatenate([np.ravel(part) for part in observation.values()])
        image = self._screen.render(self.physics.model.ptr, self.physics.data.ptr)
        return Observation(image, proprio.astype(np.float32), self.spec.templates[0])

    def step(self, action: np.ndarray, look: bool = True) -> Step:
        """See `contract.TaskEnv`.

        Raises:
            AegisError: the action has another shape, or the simulation breaks down under it.
        """
        control = self._expert.scale(checked(action, len(self.spec.action_names)))
        try:
            now = self._env.step(control)
        except PhysicsError as error:
            raise AegisError(
                f"the simulation of '{self.spec.name}' broke down: {error}",
                "finite positions and velocities",
                "use another seed, or gentler actions",
            ) from error
        self._steps += 1
        done = now.last() or self._steps >= self.spec.max_steps
        observation = self._observe(now.observation) if look else None
        return Step(observation, None, None, done, float(now.reward))

    def expert_action(self) -> np.ndarray:
        """The plan's action [A] float32 for this step."""
        return self._expert.action(self._steps).astype(np.float32)

    def distance(self) -> None:
        """None, because a suite task has no single target."""

    def target_circle(self) -> None:
        """None, because a suite task has no single target."""


class _Expert:
    """The planner for one environment, with its current plan."""

    def __init__(self, env: Any, known: Known, threads: int) -> None:
        self._env, self._search, self._guide = env, known.search, known.guide
        self._physics, self._model = env.physics, env.physics.model.ptr
        bounds, step_s = env.action_spec(), env.control_timestep()
        self._low = np.where(np.abs(bounds.minimum) < _UNBOUNDED, bounds.minimum, -1.0)
        self._high = np.where(np.abs(bounds.maximum) < _UNBOUNDED, bounds.maximum, 1.0)
        # Control steps in a plan, between two plans, and between two rewards that count.
        self._horizon = max(2, round(known.search.horizon_s / step_s))
        self._replan = max(1, round(known.search.replan_s / step_s))
        self._every = max(1, round(known.search.score_s / step_s))
        self._simulator = Simulator(self._model, round(step_s / env.physics.timestep()), threads)
        self._imagined = env.physics.copy(share_model=True)

    def begin(self, rng: np.random.Generator) -> None:
        """Begin an episode; the search starts from a plan that does nothing."""
        self._rng, self._made = rng, None
        self._plan = np.zeros((self._search.knots, len(self._low)))

    def scale(self, actions: np.ndarray) -> np.ndarray:
        """Actions [..., A] in [-1, 1] as controls in the suite's ranges."""
        return self._low + (actions + 1) / 2 * (self._high - self._low)

    def action(self, step: int) -> np.ndarray:
        """The plan's action [A] at a step of the episode; repeated calls return the same."""
        passed = 0 if self._made is None else step - self._made
        if self._made is None or passed >= self._replan:
            plan = shift(self._plan, passed / (self._horizon - 1))
            self._plan = improve(plan, self._score, self._search.samples, self._rng)
            self._made, passed = step, 0
        return follow(self._plan, self._horizon)[passed]

    def _score(self, plans: np.ndarray) -> np.ndarray:
        """Sum of rewards and guide values over each plan's horizon [N]."""
        controls = self.scale(np.stack([follow(plan, self._horizon) for plan in plans]))
        start = np.empty(mujoco.mj_stateSize(self._model, _STATE))
        mujoco.mj_getState(self._model, self._physics.data.ptr, start, _STATE)
        states = self._simulator.states(start, controls)
        at = range(self._every - 1, self._horizon, self._every)
        totals = []
        for i in range(len(plans)):
            totals.append(sum(self._reward(states[i, t], controls[i, t]) for t in at))
        return np.array(totals)

    def _reward(self, state: np.ndarray, control: np.ndarray) -> float:
        """The planner's reward in one state: that of the task, plus the guide.

        It is computed on a copy of the physics, because the real one must not move.
        """
        physics = self._imagined
        mujoco.mj_setState(self._model, physics.data.ptr, state, _STATE)
        physics.data.ctrl[:] = control
        mujoco.mj_forward(self._model, physics.data.ptr)
        reward = self._env.task.get_reward(physics)
        if self._guide is None:
            return reward
        return reward + self._guide(physics)


def _labels(observation: Mapping[str, Any]) -> Iterator[str]:
    """One name per value: `height`, `velocity[2]`, `arm_pos[1,0]`."""
    for key, value in observation.items():
        for place in np.ndindex(np.shape(value)):
            yield f"{key}[{','.join(map(str, place))}]" if place else key


def _without_contexts(physics: Any) -> Any:
    """The same physics, prevented from starting dm_control's own renderer.

    Together with ours, that renderer fails when the interpreter exits. quadruped-escape would start
    it to upload new terrain.
    """
    physics.__class__ = type("Physics", (type(physics),), {"contexts": None})
    return physics


_screens: dict[str, Screen] = {}  # by task: each has an OpenGL context, and their number is limited


def _screen(name: str, model: mujoco.MjModel) -> Screen:
    if name not in _screens:
        _screens[name] = Screen(model)
    return _screens[name]
