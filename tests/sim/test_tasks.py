"""One suite that every task must pass."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from samples.libero import needs_libero
from samples.metaworld import needs_metaworld

from aegis_cli.common.errors import AegisError
from aegis_cli.common.palette import COLORS, HELD_OUT, RGB, SEEN
from aegis_cli.sim import TASKS, has_colors, make, of_datasets
from aegis_cli.sim.contract import DEMOS, EVALUATION, VALIDATION, Step, TaskEnv, episode_rng

VOCABULARY = set("move go point touch reach find push drive bring put".split())
VOCABULARY |= set("target pad finger ball mass arm object the to onto at on".split())


SUITE_TASKS = (
    "suite/pendulum-swingup",
    "suite/finger-turn_easy",
)  # a plain one, and one that writes to its model
# Two that write to their models, and a task of a set that is not its first one.
METAWORLD_TASKS = (
    ("metaworld/button-press", 0),
    ("metaworld/drawer-open", 0),
    ("metaworld/mt4", 2),
)
LIBERO_TASKS = (("libero/goal", 2),)


@dataclass(frozen=True)
class Made:
    """How an environment was made, so that an equal one can be made."""

    name: str
    number: int = 0

    def another(self) -> TaskEnv:
        return make(self.name, number=self.number)


@pytest.fixture(params=sorted(TASKS))
def env(request: pytest.FixtureRequest) -> TaskEnv:
    """Our own tasks, with coloured targets."""
    return make(request.param)


@pytest.fixture(
    params=[
        *(Made(name) for name in (*sorted(TASKS), *SUITE_TASKS)),
        *(pytest.param(Made(*task), marks=needs_metaworld) for task in METAWORLD_TASKS),
        *(pytest.param(Made(*task), marks=needs_libero) for task in LIBERO_TASKS),
    ],
    ids=lambda made: f"{made.name}-{made.number}" if made.number else made.name,
)
def made(request: pytest.FixtureRequest) -> Made:
    """Our own tasks, and some of the suite's, of MetaWorld's and of LIBERO's."""
    return request.param


@pytest.fixture
def any_env(made: Made) -> TaskEnv:
    return made.another()


def an_action(env: TaskEnv) -> np.ndarray:
    """The expert's action; for a task without an expert, always the same push."""
    if of_datasets(env.spec.name) is None:
        return env.expert_action()
    return np.linspace(-1, 1, len(env.spec.action_names), dtype=np.float32)


def start(env: TaskEnv, i: int = 0, colors: tuple[str, ...] = COLORS):
    return env.reset(episode_rng(7, EVALUATION, i), colors)


def finish(env: TaskEnv, act) -> Step:
    """The last step of an episode; nothing is rendered."""
    while True:
        step = env.step(act(), look=False)
        if step.done:
            return step


def pixels_of(image: np.ndarray, color: str) -> np.ndarray:
    """[64, 64] bool: saturated pixels whose direction in RGB is nearest to `color`'s."""
    pixels = image.astype(float)
    saturation = 1 - pixels.min(-1) / np.maximum(pixels.max(-1), 1)
    palette = np.array(list(RGB.values()))
    unit = pixels / np.maximum(np.linalg.norm(pixels, axis=-1, keepdims=True), 1e-9)
    nearest = (unit @ (palette / np.linalg.norm(palette, axis=1, keepdims=True)).T).argmax(-1)
    return (saturation > 0.3) & (nearest == COLORS.index(color))


def widths(mask: np.ndarray) -> tuple[int, int]:
    """Pixels from the first to the last marked column and row."""
    rows, columns = np.nonzero(mask)
    return (int(np.ptp(columns)) + 1, int(np.ptp(rows)) + 1) if len(rows) else (0, 0)


def test_there_are_tasks() -> None:
    assert {"reach", "point"} <= set(TASKS)


def test_unknown_task_names_the_close_one() -> None:
    with pytest.raises(AegisError) as error:
        make("raech")
    assert "'raech'" in error.value.found and "'reach'" in error.value.fix


def test_shapes_are_the_specs(any_env: TaskEnv) -> None:
    env, spec = any_env, any_env.spec
    seen = start(env)
    step = env.step(an_action(env))
    side = 64 if of_datasets(spec.name) is None else 256
    for observation in (seen, step.observation):
        assert observation.image.shape == (side, side, 3) and observation.image.dtype == np.uint8
        assert observation.proprio.shape == (len(spec.proprio_names),)
        assert observation.proprio.dtype == np.float32
    action = an_action(env)
    assert action.shape == (len(spec.action_names),) and action.dtype == np.float32
    assert len(set(spec.action_names)) == len(spec.action_names) and len(
        set(spec.proprio_names)
    ) == len(spec.proprio_names)
    assert make(spec.name).spec == spec and spec.control_hz > 0 and spec.camera
    assert seen.instruction == step.observation.instruction


def test_positions_only(env: TaskEnv) -> None:
    assert not any("vel" in name or "target" in name for name in env.spec.proprio_names)


def test_an_episode_has_a_success_or_a_return(any_env: TaskEnv) -> None:
    env, spec = any_env, any_env.spec
    start(env)
    step = env.step(np.zeros(len(spec.action_names)))
    colored = ["{color}" in template for template in spec.templates]
    if spec.measure == "success":
        assert step.reward is None and isinstance(step.success, bool)
        assert all(colored) if has_colors(spec.name) else not any(colored)
        assert (env.distance() is not None) == has_colors(spec.name)
        assert (step.wrong_target is not None) == has_colors(spec.name)
    else:
        assert spec.measure == "return" and not any(colored)
        assert isinstance(step.reward, float) and (
            step.success,
            step.wrong_target,
            env.distance(),
        ) == (None, None, None)


def test_templates_are_plain_words_the_vlm_knows(env: TaskEnv) -> None:
    assert len(set(env.spec.templates)) >= 4
    for template in env.spec.templates:
        words = template.split(" ")
        assert words.count("{color}") == 1
        assert set(words) - {"{color}"} <= VOCABULARY


def test_same_seed_same_episode(any_env: TaskEnv, made: Made) -> None:
    env, other = any_env, made.another()
    a, b = start(env, 3), start(other, 3)
    for _ in range(4):
        assert a.instruction == b.instruction
        np.testing.assert_array_equal(a.image, b.image)
        np.testing.assert_array_equal(a.proprio, b.proprio)
        action = an_action(env)
        a, b = env.step(action).observation, other.step(action).observation


def test_a_used_environment_starts_like_a_new_one(any_env: TaskEnv) -> None:
    env = any_env
    fresh, first = start(env, 5), an_action(env)
    start(env, 6)
    env.step(an_action(env))
    if env.spec.measure == "success":
        finish(env, lambda: an_action(env))
    else:
        finish(env, lambda: np.ones(len(env.spec.action_names)))
    again = start(env, 5)
    np.testing.assert_array_equal(fresh.image, again.image)
    np.testing.assert_array_equal(fresh.proprio, again.proprio)
    np.testing.assert_array_equal(first, an_action(env))


def test_streams_and_numbers_give_other_episodes(any_env: TaskEnv) -> None:
    rngs = [
        episode_rng(s, stream, i)
        for s in (0, 1)
        for stream in (DEMOS, EVALUATION, VALIDATION)
        for i in (0, 1)
    ]
    starts = {any_env.reset(rng, COLORS).image.tobytes() for rng in rngs}
    assert len(starts) == len(rngs) == 12


def test_environments_of_a_task_do_not_mix(any_env: TaskEnv, made: Made) -> None:
    env, other = any_env, made.another()
    size = len(env.spec.action_names)
    start(env, 0)
    alone = [env.step(np.ones(size)).observation for _ in range(3)]
    start(env, 0)
    start(other, 1)
    for expected in alone:
        other.step(-np.ones(size))
        seen = env.step(np.ones(size)).observation
        np.testing.assert_array_equal(seen.image, expected.image)
        np.testing.assert_array_equal(seen.proprio, expected.proprio)


def test_environments_share_one_model(env: TaskEnv) -> None:
    assert env.physics.model.ptr is make(env.spec.name).physics.model.ptr


def test_expert_succeeds_and_random_does_not(env: TaskEnv) -> None:
    rng = np.random.default_rng(0)
    expert, random = 0, 0
    for i in range(25):
        start(env, i)
        expert += finish(env, env.expert_action).success
        start(env, i)
        random += finish(env, lambda: rng.uniform(-1, 1, 2)).success
    assert expert >= 24 and random <= 3


def test_going_to_a_distractor_ends_the_episode_as_a_failure(env: TaskEnv) -> None:
    start(env, 1)
    goal = env.centers[1]

    def astray() -> np.ndarray:
        gap = goal - env.tip()
        return env.heading(env.tip(), goal) * min(1.0, float(np.linalg.norm(gap)) / 0.05)

    step = finish(env, astray)
    assert step.wrong_target and step.done and not step.success


def test_standing_still_runs_out_of_steps(any_env: TaskEnv) -> None:
    start(any_env)
    size, most = len(any_env.spec.action_names), any_env.spec.max_steps
    steps = [any_env.step(np.zeros(size), look=False) for _ in range(most)]
    assert [s.done for s in steps] == [False] * (most - 1) + [True]
    assert not steps[-1].success and not steps[-1].wrong_target


def test_success_needs_three_steps_of_rest_on_the_target(env: TaskEnv) -> None:
    start(env, 2)
    inside, step = [], None
    while step is None or not step.done:
        step = env.step(env.expert_action(), look=False)
        inside.append(env.distance() < 0.035)
    assert step.success and inside[-3:] == [True] * 3 and not inside[0]


def test_starts_away_from_every_disc_and_discs_are_apart(env: TaskEnv) -> None:
    for i in range(30):
        start(env, i)
        assert 2 <= len(env.centers) <= 4 and len(env.colors) == len(set(env.colors)) == len(
            env.centers
        )
        assert np.linalg.norm(env.centers - env.tip(), axis=1).min() > 2 * 0.035
        gaps = np.linalg.norm(env.centers[:, None] - env.centers[None], axis=-1)
        assert (gaps + np.eye(len(gaps)) > 2 * 0.035).all()


def test_no_constant_observation(any_env: TaskEnv) -> None:
    rng, size = np.random.default_rng(0), len(any_env.spec.action_names)
    seen = []
    for i in range(12):
        start(any_env, i)
        seen += [any_env.step(rng.uniform(-1, 1, size)).observation for _ in range(4)]
    varies = np.stack([o.proprio for o in seen]).std(0) > 1e-3
    assert [
        name for name, v in zip(any_env.spec.proprio_names, varies) if not v and "touch" not in name
    ] == []
    assert np.stack([o.image for o in seen]).std(0).max() > 10


def test_looks_and_words_vary(env: TaskEnv) -> None:
    seen = [start(env, i) for i in range(12)]
    assert np.stack([o.image for o in seen]).std(0).min() > 0
    assert len({o.instruction for o in seen}) > 6


def test_instruction_names_the_true_target_only(env: TaskEnv) -> None:
    for i in range(20):
        words = start(env, i).instruction.split()
        assert [w for w in words if w in COLORS] == [env.target_color]


def test_the_named_colour_lies_where_success_is(env: TaskEnv) -> None:
    """The picture shows the target's colour at the position from which `distance` measures.

    An effector that ends there covers it.
    """
    start(env, 4)
    before = pixels_of(env.observe().image, env.target_color)
    rows, columns = np.nonzero(before)
    middle = np.array([columns.mean(), rows.mean()])
    assert finish(env, env.expert_action).success
    after = pixels_of(env.observe().image, env.target_color)
    covered_rows, covered_columns = np.nonzero(before & ~after)
    assert len(covered_rows) > 0  # the effector's dot
    assert np.hypot(*(np.array([covered_columns.mean(), covered_rows.mean()]) - middle)) < 3


def test_proprioception_holds_nothing_of_the_target(env: TaskEnv) -> None:
    other = make(env.spec.name)
    start(env, 0), start(other, 1)
    other.physics.data.qpos[:] = env.physics.data.qpos
    other.physics.forward()
    assert not np.array_equal(env.centers[0], other.centers[0])
    np.testing.assert_array_equal(env.observe().proprio, other.observe().proprio)


def test_proprioception_does_not_see_velocity(env: TaskEnv) -> None:
    start(env)
    before = env.observe().proprio
    env.physics.data.qvel[:] = 1.0
    env.physics.forward()
    np.testing.assert_array_equal(before, env.observe().proprio)


def test_every_disc_is_at_least_six_pixels_wide(env: TaskEnv) -> None:
    for i in range(20):
        image = start(env, i).image
        for color in env.colors:
            assert min(widths(pixels_of(image, color))) >= 6, (i, color)


def test_discs_stay_visible_under_the_effector(env: TaskEnv) -> None:
    for i in range(8):
        start(env, i)
        finish(env, env.expert_action)
        image = env.observe().image
        for color in env.colors:
            assert pixels_of(image, color).sum() >= 20, (i, color)


def test_seen_targets_only_when_asked_for(env: TaskEnv) -> None:
    targets, distractors = set(), set()
    for i in range(60):
        start(env, i, SEEN)
        targets.add(env.target_color)
        distractors |= set(env.colors[1:])
    assert targets == set(SEEN)
    assert set(HELD_OUT) <= distractors


@pytest.mark.parametrize("action", [(1, 0), (0, -1), (-0.5, 0.5)])
def test_action_is_a_displacement_in_image_axes(env: TaskEnv, action: tuple[float, float]) -> None:
    errors = []
    for i in range(10):
        start(env, i)
        if np.linalg.norm(env.tip()) > 0.18:
            continue  # a stretched arm or a wall would be in the way
        env.step(np.array(action), look=False)
        before = env.tip()
        env.step(np.array(action), look=False)
        errors.append(
            np.linalg.norm(env.tip() - before - np.array(action) * env.step_m) / env.step_m
        )
    assert len(errors) >= 3 and max(errors) < 0.3 and np.mean(errors) < 0.15


def test_left_and_up_in_the_picture(env: TaskEnv) -> None:
    """The effector's dot is the only near-black spot."""

    def dot() -> np.ndarray:
        rows, columns = np.nonzero(env.observe().image.max(-1) < 20)
        return np.array([columns.mean(), rows.mean()])

    seen = 0
    for i in range(10):
        start(env, i)
        if np.linalg.norm(env.tip()) > 0.18:
            continue  # a stretched arm or a wall would be in the way
        before = dot()
        for _ in range(2):
            env.step(np.array([-1.0, 1.0]), look=False)
        right, down = dot() - before
        assert right < -2 and down < -2, i
        seen += 1
    assert seen >= 3


def test_actions_are_clipped(any_env: TaskEnv) -> None:
    size = len(any_env.spec.action_names)
    ends = []
    for action in (1.0, 50.0, 0.5):
        start(any_env, 0)
        for _ in range(3):
            step = any_env.step(np.full(size, action))
        ends.append(step.observation.proprio)
    np.testing.assert_array_equal(ends[0], ends[1])
    assert not np.array_equal(ends[0], ends[2])


@pytest.mark.parametrize("wrong", [lambda n: np.full(n, np.nan), lambda n: np.zeros(n + 1)])
def test_bad_actions_are_refused(any_env: TaskEnv, wrong) -> None:
    start(any_env)
    with pytest.raises(AegisError, match="finite numbers"):
        any_env.step(wrong(len(any_env.spec.action_names)))


@pytest.mark.parametrize("colors", [(), ("mauve",)])
def test_bad_colours_are_refused(env: TaskEnv, colors: tuple[str, ...]) -> None:
    with pytest.raises(AegisError):
        start(env, 0, colors)


def test_the_expert_goes_around_the_reachers_base() -> None:
    from aegis_cli.sim.reach import around

    tip, goal = np.array([0.15, 0.0]), np.array([-0.15, 0.02])
    path = [tip]
    while np.linalg.norm(path[-1] - goal) > 0.004 and len(path) < 500:
        path.append(path[-1] + 0.002 * around(path[-1], goal, 0.065))
    assert np.linalg.norm(path, axis=1).min() > 0.063
    assert len(path) * 0.002 < 0.36  # the shortest way round is 0.33 m
    np.testing.assert_allclose(around(tip, np.array([0.15, 0.1]), 0.065), [0, 1])  # clear: straight
