"""LIBERO's tasks as LIBERO itself shows them; needs LIBERO and its meshes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from samples.command import python
from samples.libero import needs_libero

from aegis_cli import sim
from aegis_cli.common.errors import AegisError
from aegis_cli.sim import libero_table as table
from aegis_cli.sim.contract import EVALUATION, VALIDATION, Observation, TaskEnv, episode_rng
from aegis_cli.sim.simulators import Wanted, opened

pytestmark = needs_libero

BOTH = ("image", "image2")


def made(name: str, number: int = 0, **how: Any) -> Any:
    return sim.make(name, number=number, seen_by=BOTH, **how)


def begun(env: TaskEnv, number: int, stream: int = EVALUATION) -> Observation:
    return env.reset(episode_rng(0, stream, number), ())


def same(one: Observation, other: Observation) -> bool:
    pictures = zip((one.image, *one.more), (other.image, *other.more), strict=True)
    return np.array_equal(one.proprio, other.proprio) and all(
        np.array_equal(left, right) for left, right in pictures
    )


def pushes(count: int) -> np.ndarray:
    """[count, 7]"""
    return np.random.default_rng(1).uniform(-1, 1, (count, 7))


def test_every_suite_is_as_the_table_says() -> None:
    from aegis_cli.sim.libero import _benchmark

    lerobot = pytest.importorskip("lerobot.envs.libero").TASK_SUITE_MAX_STEPS
    assert {f"libero_{suite}": most for suite, (_, most) in table.SUITES.items()} == lerobot
    for suite, (count, _) in table.SUITES.items():
        env = sim.make(f"libero/{suite}")
        said = env.spec.templates
        assert len(said) == count == _benchmark(suite).n_tasks
        assert all(text and text == text.strip() for text in said)


@pytest.mark.parametrize("suite", table.SUITES)
def test_the_instructions_are_as_the_table_says(suite: str) -> None:
    assert sim.make(f"libero/{suite}").spec.templates == table.instructions(f"libero/{suite}")


def test_an_episode_follows_from_its_numbers_alone() -> None:
    env, before = made("libero/goal", 2, published=True), np.random.get_state()[1].copy()
    first = begun(env, 2)
    assert same(first, begun(made("libero/goal", 2, published=True), 2))
    assert np.array_equal(before, np.random.get_state()[1])  # others draw from it too
    assert first.image.shape == first.more[0].shape == (256, 256, 3)
    assert first.proprio.shape == (8,) and first.proprio.dtype == np.float32


def test_published_episodes_are_others_than_those_of_a_validation() -> None:
    published = [begun(made("libero/object", n, published=True), n) for n in (0, 10)]
    drawn = [begun(made("libero/object", n), n, VALIDATION) for n in (0, 10)]
    seen = [o.image for o in (*published, *drawn)]
    assert {o.instruction for o in (*published, *drawn)} == {published[0].instruction}
    assert all(not np.array_equal(seen[i], seen[j]) for i in range(4) for j in range(i))


def test_published_episodes_begin_in_liberos_states() -> None:
    """The tasks take turns, and each goes through its states in order."""
    from aegis_cli.sim.libero import _states

    states, turns = _states("object", 3), {3: 0, 13: 1, 503: 0}
    for number, state in turns.items():
        env = made("libero/object", number, published=True)
        begun(env, number)
        now = env._env.sim.get_state().flatten()
        # After ten steps of rest the objects have hardly moved; other states are decimetres apart.
        far = np.abs(states - now)[:, 10:].sum(1)
        assert int(far.argmin()) == state, number


def test_several_processes_simulate_the_same() -> None:
    actions = pushes(3)

    def seen(env: TaskEnv) -> list[Observation]:
        return [begun(env, 1), *(env.step(action).observation for action in actions)]

    here = seen(made("libero/goal", 1, published=True))
    with opened(2, 10) as simulators:
        wanted = Wanted("libero/goal", 1, BOTH, published=True)
        envs = [simulators.make(wanted) for _ in range(3)]
        found: dict[int, list[Observation]] = {}
        simulators.each(lambda at: found.update({at: seen(envs[at])}), range(3))
    # The processes have ended with open simulators.
    for observations in found.values():
        assert all(same(own, other) for own, other in zip(here, observations, strict=True))


@pytest.mark.parametrize("visible", ["", "GPU-1234", "3"])
def test_what_gpus_are_visible_to_pytorch_is_nothing_to_the_pictures(
    visible: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    program = (
        "from aegis_cli import sim\n"
        "from aegis_cli.sim.contract import episode_rng\n"
        "env = sim.make('libero/object')\n"
        "print(env.reset(episode_rng(0, 1, 0), ()).image.std() > 10)\n"
    )
    done = python(program)
    assert (done.returncode, done.stdout.strip(), done.stderr) == (0, "True", "")


def test_a_home_that_it_cannot_write_to_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    where = str(tmp_path / "file" / "libero")
    program = (
        f"import os; os.environ['LIBERO_CONFIG_PATH'] = {where!r}\n"
        "from aegis_cli import sim\n"
        "try:\n    sim.check('libero/object')\n"
        "except sim.AegisError as error:\n    print(error.fix)\n"
    )
    done = python(program)
    assert (done.stdout.strip(), done.stderr) == ("export LIBERO_CONFIG_PATH=FOLDER", "")


def test_a_signal_ends_the_placing_of_objects(monkeypatch: pytest.MonkeyPatch) -> None:
    """LIBERO's own `reset` would start again, whatever has ended it."""
    from aegis_cli.sim import libero

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    env = made("libero/object")
    domain = type(libero._environment("object", 0, ("agentview",)).env)
    monkeypatch.setattr(domain, "_reset_internal", interrupted)
    with pytest.raises(KeyboardInterrupt):
        begun(env, 0)


def test_places_that_are_not_found_are_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    from aegis_cli.sim import libero

    tries: list[int] = []

    def failing(*_: object) -> None:
        tries.append(1)
        raise libero.RandomizationError("no place")

    env = made("libero/object")
    domain = type(libero._environment("object", 0, ("agentview",)).env)
    monkeypatch.setattr(domain, "reset", failing)
    with pytest.raises(AegisError, match="no places for a scene's objects"):
        begun(env, 0)
    assert len(tries) == libero._TRIES


def test_what_is_not_looked_at_changes_nothing() -> None:
    looking, blind = made("libero/spatial", published=True), made("libero/spatial", published=True)
    assert same(begun(looking, 0), begun(blind, 0))
    for number, action in enumerate(pushes(6)):
        seen, unseen = looking.step(action), blind.step(action, look=number == 5)
    assert same(seen.observation, unseen.observation)
    assert all(picture.std() > 10 for picture in (seen.observation.image, *seen.observation.more))


def test_one_that_ends_leaves_anothers_pictures() -> None:
    """Each has an OpenGL context, one of which is current."""
    alone, other, ends = (made("libero/spatial", n, published=True) for n in (1, 1, 0))
    begun(alone, 1), begun(other, 1)
    begun(ends, 0)
    ends._close()
    for action in pushes(3):
        left, right = alone.step(action), other.step(action)
    assert same(left.observation, right.observation) and left.observation.image.std() > 10


def test_a_process_that_draws_other_things_too_ends_quietly() -> None:
    """Its simulator and Aegis's own scenes share OpenGL's display."""
    program = (
        "from aegis_cli import sim\n"
        "from aegis_cli.data.vqa.scenes import renderer_of_thread\n"
        "from aegis_cli.sim.contract import episode_rng\n"
        "renderer_of_thread()\n"
        "env = sim.make('libero/object')\n"
        "env.reset(episode_rng(0, 1, 0), ())\n"
        "env.step([0.0] * 7)\n"
    )
    done = python(program)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_folders_of_another_installation_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """LIBERO stores the paths of its files in the home folder, for all environments."""
    from aegis_cli.sim import libero

    monkeypatch.setattr(libero, "get_libero_path", lambda kind: f"/gone/{kind}")
    with pytest.raises(AegisError, match="no file '/gone/bddl_files/libero_goal/") as caught:
        begun(made("libero/goal"), 0)
    assert "config.yaml" in caught.value.expected


def test_it_ends_after_its_suites_steps_and_closes_its_simulator() -> None:
    env = made("libero/all", 9)
    begun(env, 9)
    steps, done = 0, False
    while not done:
        step = env.step(np.zeros(7), look=False)
        steps, done = steps + 1, step.done
    assert steps == 280 and step.success is False and env._env is None


@pytest.mark.parametrize(("suite", "number"), [("object", 3), ("goal", 2), ("spatial", 1)])
def test_it_is_the_environment_of_lerobot(suite: str, number: int) -> None:
    """Pictures are equal to the pixel, and positions up to rounding, after its processor."""
    envs = pytest.importorskip("lerobot.envs.libero")
    processor = pytest.importorskip("lerobot.processor.env_processor").LiberoProcessorStep()
    import torch
    from libero.libero import benchmark

    theirs = envs.LiberoEnv(
        benchmark.get_benchmark(f"libero_{suite}")(),
        number,
        f"libero_{suite}",
        obs_type="pixels_agent_pos",
    )

    def processed(seen: dict[str, Any]) -> Observation:
        state = {
            part: {name: torch.from_numpy(np.asarray(value))[None] for name, value in of.items()}
            for part, of in seen["robot_state"].items()
        }
        found = {"observation.robot_state": state}
        for name, picture in seen["pixels"].items():
            found[f"observation.images.{name}"] = torch.from_numpy(picture).permute(2, 0, 1)[None]
        done = processor.observation(found)
        pictures = [done[f"observation.images.{n}"][0].permute(1, 2, 0).numpy() for n in BOTH]
        return Observation(pictures[0], done["observation.state"][0].numpy(), "", (pictures[1],))

    ours = made(f"libero/{suite}", number, published=True)
    seed = int(episode_rng(0, EVALUATION, number).integers(2**31))
    own, other = begun(ours, number), processed(theirs.reset(seed=seed)[0])
    assert own.instruction == theirs.task_description
    for action in pushes(8):
        np.testing.assert_array_equal(own.image, other.image)
        np.testing.assert_array_equal(own.more[0], other.more[0])
        np.testing.assert_allclose(own.proprio, other.proprio, atol=1e-6)
        own, other = ours.step(action).observation, processed(theirs.step(action)[0])


def test_it_ends_in_success_when_liberos_goal_is_reached() -> None:
    """The soup is dropped into the basket."""
    env = made("libero/object", published=True)
    begun(env, 0)
    assert not env.step(np.zeros(7), look=False).done
    data = env._env.sim.data
    place = np.concatenate([data.get_body_xpos("basket_1_main"), [1, 0, 0, 0]])
    place[2] += 0.1
    data.set_joint_qpos("alphabet_soup_1_joint0", place)
    for _ in range(40):
        step = env.step(np.zeros(7))
        if step.done:
            break
    assert step.success is True and step.observation is not None and env._env is None
