"""dm_control's suite by name: names, instructions, pictures, returns, demonstrations, refusals."""

from __future__ import annotations

import dataclasses
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console
from samples import studies as study_samples
from samples.command import python, refused
from samples.small_run import recipe

from aegis_cli import inspection, sim
from aegis_cli.cli import render
from aegis_cli.common import artifacts, media, processes
from aegis_cli.common.errors import AegisError
from aegis_cli.data import keeping
from aegis_cli.data import record as demos
from aegis_cli.data.vqa.questions import vocabulary
from aegis_cli.evaluation import rollout
from aegis_cli.models.backbones.tokenizer import SPECIAL, Tokenizer
from aegis_cli.recipes import Demos, study_cells, to_yaml
from aegis_cli.sim import recording, suite
from aegis_cli.sim.contract import EVALUATION, Step, episode_rng
from aegis_cli.sim.planner import Search
from aegis_cli.sim.recording import RecordedEpisode, record
from aegis_cli.sim.suite_table import KNOWN, Known, sentence
from aegis_cli.studies import policy_cells, study
from aegis_cli.training import checkpoint

import mujoco  # isort: skip  (after ours, which choose the OpenGL backend)
from dm_control import suite as published  # isort: skip

NAME = "suite/pendulum-swingup"
# The first task of each domain, except for the two that take seconds to load.
LIGHT = [
    f"suite/{domain}-{own[0]}"
    for domain, own in published.TASKS_BY_DOMAIN.items()
    if domain not in ("dog", "quadruped")
]
QUICK = Known(
    "bring the mass over the arm",
    Search(horizon_s=0.4, knots=2, samples=2, score_s=0.2, replan_s=0.4),
)


def start(name: str, i: int = 0) -> suite.SuiteTask:
    env = sim.make(name)
    env.reset(episode_rng(0, EVALUATION, i), ())
    return env


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """A planner with a minimal search, and episodes of 20 steps."""
    monkeypatch.setitem(KNOWN, "pendulum-swingup", QUICK)
    monkeypatch.setattr(suite, "STEPS", 20)
    monkeypatch.setattr(processes, "_cores", lambda: 1)  # other processes would not be patched
    recording._env.cache_clear()


# --- every task ----------------------------------------------------------------------------------


def test_every_published_task_has_a_name_and_a_sentence() -> None:
    assert len(suite.names()) == len(set(suite.names())) == len(published.ALL_TASKS) > 40
    for name in suite.names():
        sim.check(name)
        words = sentence(name).split(" ")
        assert len(words) >= 3 and all(
            word.isalnum() and word.islower() or word.isdigit() for word in words
        ), name
    assert {f"suite/{name}" for name in KNOWN} <= set(suite.names())


def test_what_is_known_of_tasks_can_be_said_to_the_embedded_vlm() -> None:
    tokenizer = Tokenizer((*SPECIAL, *vocabulary()))
    said = [known.text for known in KNOWN.values() if known.text is not None]
    assert len(said) >= 10
    for text in said:
        tokenizer.encode(text)


@pytest.mark.parametrize("name", LIGHT)
def test_a_step_fits_the_spec(name: str) -> None:
    env = start(name)
    spec, size = env.spec, len(env.spec.action_names)
    step = env.step(np.full(size, 0.3))
    assert (
        spec.name == name
        and spec.templates == (sentence(name),)
        and all(spec.action_names)
        and spec.camera
    )
    assert (
        step.observation.proprio.shape == (len(spec.proprio_names),)
        and np.isfinite(step.observation.proprio).all()
    )
    assert step.observation.image.shape == (64, 64, 3) and np.ptp(step.observation.image) > 20
    assert -np.inf < step.reward <= 1 and not step.done and 10 < spec.control_hz <= 100


# --- the suite's own -----------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["suite/cartpole-swingup", "suite/reacher-easy"])
def test_steps_are_the_suites(name: str) -> None:
    """Equal seed and actions give the observations and rewards of dm_control's own environment."""
    domain, task = name.removeprefix("suite/").split("-")
    ours, theirs = sim.make(name), published.load(domain, task, task_kwargs={"random": 0})
    seen = ours.reset(episode_rng(3, EVALUATION, 1), ())
    theirs.task.random.seed(int(episode_rng(3, EVALUATION, 1).integers(2**32)))
    observation, rng = theirs.reset().observation, np.random.default_rng(0)
    for _ in range(5):
        flat = np.concatenate([np.ravel(part) for part in observation.values()])
        np.testing.assert_allclose(seen.proprio, flat, rtol=1e-6)
        action = rng.uniform(-1, 1, len(ours.spec.action_names))
        step, expected = ours.step(action), theirs.step(action)
        seen, observation = step.observation, expected.observation
        assert step.reward == expected.reward


def test_names_of_proprioception_lead_back_to_the_observation() -> None:
    env = sim.make("suite/manipulator-bring_ball")  # scalars, vectors and a matrix
    proprio = env.reset(episode_rng(0, EVALUATION, 0), ()).proprio
    found = env._env.task.get_observation(env.physics)
    for name, value in zip(env.spec.proprio_names, proprio, strict=True):
        key, _, rest = name.partition("[")
        place = tuple(int(n) for n in rest.rstrip("]").split(",")) if rest else ()
        assert np.float32(np.asarray(found[key])[place]) == value


def test_actions_span_the_suites_ranges() -> None:
    """A quadruped's are asymmetric; lqr's forces have no bounds."""
    env = sim.make("suite/lqr-lqr_2_1")
    env.reset(episode_rng(0, EVALUATION, 0), ())
    env.step(np.ones(1))
    assert env.physics.data.ctrl.tolist() == [1.0]
    env = sim.make("suite/quadruped-walk")
    env.reset(episode_rng(0, EVALUATION, 0), ())
    bounds = env._env.action_spec()
    assert not np.array_equal(bounds.maximum, -bounds.minimum)
    for action, control in (
        (1.0, bounds.maximum),
        (-1.0, bounds.minimum),
        (0.0, (bounds.minimum + bounds.maximum) / 2),
    ):
        env.step(np.full(12, action))
        np.testing.assert_allclose(env.physics.data.ctrl, control)


def test_the_picture_is_upright() -> None:
    env, rows = start(NAME), []
    for angle in (0.0, np.pi):  # up, down
        env.physics.data.qpos[:], env.physics.data.qvel[:] = angle, 0
        pixels = env.step(np.zeros(1)).observation.image.astype(int)
        rows.append(np.nonzero(pixels[..., 0] > pixels[..., 2] + 40)[0].mean())  # orange on blue
    assert rows[0] < rows[1] - 2


def test_terrain_is_drawn_as_it_is() -> None:
    """Environments share one rendering context, but each picture shows its own hills.

    A new context shows the same.
    """
    one, other = (sim.make("suite/quadruped-escape") for _ in range(2))
    one.reset(episode_rng(0, EVALUATION, 0), ())
    assert (
        one.physics._contexts is None
    )  # a renderer of dm_control's own would fail when the interpreter exits
    second = other.reset(episode_rng(0, EVALUATION, 1), ()).image.astype(int)
    first = one._screen.render(one.physics.model.ptr, one.physics.data.ptr).astype(int)
    with mujoco.Renderer(other.physics.model.ptr, 64, 64) as renderer:
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = renderer.scene.flags[
            mujoco.mjtRndFlag.mjRND_REFLECTION
        ] = False
        renderer.update_scene(other.physics.data.ptr, 0)
        theirs = renderer.render().astype(int)
    assert np.abs(second - theirs).mean() < 2 < 8 < np.abs(first - theirs).mean()


def test_a_simulation_that_breaks_down_is_an_error_that_says_so() -> None:
    env = start(NAME)
    env.physics.data.qvel[:] = np.nan
    with pytest.raises(AegisError, match="'suite/pendulum-swingup' broke down"):
        env.step(np.zeros(1))


# --- the planner as the expert -------------------------------------------------------------------


def test_threads_do_not_change_the_expert() -> None:
    acted = []
    for threads in (1, 2):
        env, actions = sim.make(NAME, threads), []
        env.reset(episode_rng(0, EVALUATION, 0), ())
        for _ in range(7):
            actions.append(env.expert_action())
            env.step(actions[-1], look=False)
        acted.append(np.stack(actions))
    np.testing.assert_array_equal(*acted)
    assert acted[0].std() > 0


def test_asked_twice_the_expert_says_the_same_and_asking_changes_nothing() -> None:
    env, other = start(NAME), start(NAME)
    for _ in range(5):
        action = env.expert_action()
        np.testing.assert_array_equal(action, env.expert_action())
        a, b = env.step(action), other.step(action)
        np.testing.assert_array_equal(a.observation.proprio, b.observation.proprio)
        assert a.reward == b.reward


def test_returns_hold_no_guide(monkeypatch: pytest.MonkeyPatch) -> None:
    """The guide of the planner does not count in an episode's return.

    A pendulum that hangs still earns nothing.
    """
    monkeypatch.setitem(
        KNOWN, "pendulum-swingup", Known(search=QUICK.search, guide=lambda physics: 100.0)
    )
    env = start(NAME)
    env.physics.data.qpos[:], env.physics.data.qvel[:] = np.pi, 0
    assert [env.step(np.zeros(1), look=False).reward for _ in range(5)] == [0.0] * 5


def test_the_planner_does_better_than_chance(monkeypatch: pytest.MonkeyPatch) -> None:
    hasty = Search(horizon_s=0.6, knots=4, samples=12, score_s=0.1, replan_s=0.1)
    monkeypatch.setitem(
        KNOWN, "reacher-easy", dataclasses.replace(KNOWN["reacher-easy"], search=hasty)
    )
    env, rng = sim.make("suite/reacher-easy"), np.random.default_rng(0)

    def played(act: Any) -> float:
        total = 0.0
        for i in range(4):
            env.reset(episode_rng(0, EVALUATION, i), ())
            total += sum(env.step(act(), look=False).reward for _ in range(75))
        return total

    assert played(env.expert_action) > 3 * played(lambda: rng.uniform(-1, 1, 2)) + 50


def test_the_guides_lead_to_where_the_rewards_are() -> None:
    """Among random states, the planner is guided to those with the highest reward."""
    guided = {
        known.guide: (name, known) for name, known in KNOWN.items() if known.guide is not None
    }
    for name, known in guided.values():
        env, rng, found = sim.make(f"suite/{name}"), np.random.default_rng(0), []
        env.reset(episode_rng(0, EVALUATION, 0), ())
        for _ in range(300):
            env.physics.data.qpos[:] = rng.uniform(-1, 1, env.physics.model.nq) * (
                np.pi if "swing" in name else 0.3
            )
            env.physics.data.qvel[:] = rng.uniform(-30, 30, env.physics.model.nv) * ("spin" in name)
            env.physics.forward()
            found.append((env._env.task.get_reward(env.physics), known.guide(env.physics)))
        rewards, guides = np.array(found).T
        assert np.isfinite(guides).all() and guides.std() > 0, name
        if rewards.max() > rewards.min():
            assert guides[rewards == rewards.max()].mean() > guides.mean(), name


def test_pushes_are_executed_and_plans_are_the_labels() -> None:
    class Spied:
        def __init__(self, env: suite.SuiteTask) -> None:
            self.env, self.spec, self.target_color = env, env.spec, None
            self.told, self.executed, self.rewards = [], [], []
            self.reset, self.expert_action = env.reset, env.expert_action

        def step(self, action: np.ndarray) -> Step:
            self.told.append(self.env.expert_action())
            self.executed.append(action)
            step = self.env.step(action)
            self.rewards.append(step.reward)
            return (
                step
                if len(self.told) < 25
                else Step(step.observation, None, None, True, step.reward)
            )

    spied = Spied(sim.make("suite/cartpole-balance"))
    episode = record(spied, episode_rng(0, EVALUATION, 0), 0.5, ())
    np.testing.assert_array_equal(episode.actions, np.stack(spied.told))
    assert not np.allclose(episode.actions, np.stack(spied.executed))
    assert (episode.success, episode.target_color) == (None, None)
    assert episode.total_reward == pytest.approx(sum(spied.rewards)) and episode.total_reward > 10


# --- which episodes are kept ---------------------------------------------------------------------


def taken(returns: list[float], episodes: int) -> tuple[list[float], keeping.Seen, list[Any]]:
    def recorded(number: int) -> RecordedEpisode:
        blank = (
            np.zeros((1, 1, 1, 3), np.uint8),
            np.zeros((1, 1), np.float32),
            np.zeros((1, 1), np.float32),
        )
        return RecordedEpisode(*blank, "go", None, None, returns[number])

    seen, events = keeping.Seen(), []
    kept = list(keeping.best(recorded, episodes, len(returns), 1, seen, events.append))
    return [e.total_reward for e in kept], seen, events


@pytest.mark.parametrize("seed", range(20))
def test_what_is_kept_is_above_the_quantile_and_in_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    episodes, share = int(rng.integers(1, 12)), float(rng.uniform(0, 0.9))
    total = keeping.attempts(episodes, share)
    returns = rng.integers(0, 8, size=total).astype(float).tolist()  # with ties
    kept, seen, events = taken(returns, episodes)
    assert len(kept) == episodes and sorted(kept) == sorted(returns)[total - episodes :]
    assert min(kept) >= np.quantile(returns, (total - episodes) / total, method="lower")
    numbers = iter(returns)
    assert all(value in numbers for value in kept)  # a subsequence
    assert (seen.attempts, seen.returns, seen.kept_returns, seen.frames) == (
        total,
        returns,
        kept,
        episodes,
    )
    assert [(e.done, e.total) for e in events] == [(i + 1, total) for i in range(total)]
    assert events[-1].metrics["return"] == pytest.approx(np.mean(returns))


@pytest.mark.parametrize("seed", range(20))
def test_the_share_that_is_dropped_is_the_one_asked_for(seed: int) -> None:
    rng = np.random.default_rng(seed)
    episodes, share = int(rng.integers(1, 400)), float(rng.uniform(0, 0.95))
    total = keeping.attempts(episodes, share)
    assert (total - episodes) / total <= share + 1 / total and (total - 1) * (1 - share) <= episodes
    assert keeping.attempts(episodes, 0.0) == episodes
    assert [keeping.attempts(n, s) for n, s in ((3, 0.25), (20, 0.25), (21, 0.3), (1, 0.8))] == [
        4,
        27,
        30,
        5,
    ]


def test_of_equal_returns_the_first_are_kept() -> None:
    def numbered(i: int) -> RecordedEpisode:
        return RecordedEpisode(*[np.zeros((i + 1, 1))] * 3, "go", None, None, 1.0)

    kept = list(keeping.best(numbered, 2, 5, 1, keeping.Seen(), lambda _: None))
    assert [len(e.actions) for e in kept] == [1, 2]


# --- demonstrations ------------------------------------------------------------------------------


def test_the_artifact_has_returns_and_no_colours(quick: None, tmp_path: Path) -> None:
    path = tmp_path / "d.safetensors"
    report = demos.run(NAME, 3, 0, path, workers=1, drop_below=0.5)
    artifact = artifacts.load(path, "demos")
    tensors, meta = artifact.tensors, artifact.header.meta
    assert (report.episodes, report.attempts, report.dropped, report.success, report.frames) == (
        3,
        6,
        3,
        None,
        60,
    )
    assert (
        "target_color" not in tensors
        and "colors" not in meta
        and tensors["returns"].dtype == torch.float64
    )
    assert tensors["returns"].mean().item() == pytest.approx(report.kept_returns["mean"])
    assert (meta["drop_below"], meta["attempts"], meta["dropped"], meta["returns"]) == (
        0.5,
        6,
        3,
        report.returns,
    )
    assert (
        report.returns["min"]
        <= report.returns["median"]
        <= report.returns["max"]
        == report.kept_returns["max"]
    )
    assert report.returns["mean"] <= report.kept_returns["mean"]
    assert meta["instructions"] == ["bring the mass over the arm"] and meta["control_hz"] == 50
    facts = inspection.run(path).facts
    assert facts["task"] == NAME and facts["returns"] == report.returns


def test_equal_arguments_give_equal_bytes_on_any_machine(
    quick: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    digests = []
    for cores, seed in (
        (1, 0),
        (3, 0),
        (1, 1),
    ):  # the planner's threads use the cores that no process needs
        monkeypatch.setattr(processes, "_cores", lambda: cores)
        digests.append(demos.run(NAME, 2, seed, tmp_path / "d.safetensors", workers=1).sha256)
    assert digests[0] == digests[1] != digests[2]


def test_a_lerobot_dataset_knows_its_task(quick: None, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    from aegis_cli.data import demonstrations

    demos.run(NAME, 2, 0, tmp_path / "set", workers=1, form="lerobot")
    found = demonstrations.load(tmp_path / "set", 0.5, 0)
    assert (
        found.task == NAME
        and found.instructions == ["bring the mass over the arm"]
        and len(found.frames[0]) == 40
    )
    assert inspection.run(tmp_path / "set").facts["cameras"] == ["observation.images.fixed"]


def test_a_rate_that_is_no_whole_number_makes_a_video_all_the_same(
    quick: None, tmp_path: Path
) -> None:
    pytest.importorskip("pyarrow")
    from aegis_cli.data import demonstrations as data

    demos.run("suite/lqr-lqr_2_1", 2, 0, tmp_path / "set", workers=1, form="lerobot", as_video=True)
    assert inspection.run(tmp_path / "set").facts["fps"] == pytest.approx(100 / 3)
    assert data.load(tmp_path / "set", 0.5, 0).frames[0].shape == (40, 64, 64, 3)


# --- learning from them --------------------------------------------------------------------------


@pytest.fixture
def place(quick: None, tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with a recipe for the suite task."""
    monkeypatch.chdir(tmp_path)
    settings = dataclasses.replace(
        recipe(tiny_folder, methods=("naive",)), task=NAME, demos=Demos(episodes=2, drop_below=0.5)
    )
    (tmp_path / "small.yaml").write_text(to_yaml(settings))
    return tmp_path


TRAIN = ("train", "small.yaml", "--demos", "d.safetensors", "--out", "run", "--method", "naive")


def test_demonstrations_training_and_rollout_from_the_command_line(aegis, place: Path) -> None:
    code, out, err = aegis(
        "demos", NAME, "--episodes", 2, "--drop-below", 0.5, "--out", "d.safetensors"
    )
    assert code == 0 and "kept returns" in out and "mean" in out and "success" not in out
    assert "demos: 4/4 episodes (100 %)" in err and "return " in err
    assert aegis(*TRAIN)[0] == 0
    code, out, _ = aegis("rollout", "run", "--episodes", 3, "--video", "v.gif", "--json")
    report = json.loads(out)
    assert code == 0 and report["task"] == NAME and (place / "v.gif").exists()
    assert (
        report["return_share"] == pytest.approx(report["mean_return"] / 20)
        and 0 <= report["return_share"] <= 1
    )
    assert report["return_interval"][0] <= report["mean_return"] <= report["return_interval"][1]
    assert {
        report[key] for key in ("success", "interval", "colors", "wrong_target", "final_distance_m")
    } == {None}
    code, out, _ = aegis("rollout", "run", "--episodes", 2)
    assert code == 0 and "mean return" in out and "return share" in out and "success" not in out
    refusal = refused(aegis("rollout", "run", "--episodes", 1, "--colors", "held-out"))
    assert "held-out colours" in refusal and "leave out --colors" in refusal


def test_a_recipe_from_demonstrations_to_its_table(aegis, place: Path) -> None:
    code, out, _ = aegis("run", "small.yaml", "--out", "runs")
    assert (
        code == 0
        and "Return % of highest" in out
        and "Success" not in out
        and "Wrong target" not in out
    )
    row = json.loads((place / "runs/small/table.json").read_text())["rows"][0]
    played = json.loads((place / "runs/small/naive/rollout-seen.json").read_text())
    assert (
        row["return_share"] == played["return_share"] >= 0
        and row["success_seen"] is row["success_held_out"] is None
    )
    assert artifacts.read_header(place / "runs/small/demos.safetensors").meta["attempts"] == 4


@dataclass
class Puppet:
    """A policy that always pushes the same way."""

    action: float

    def to(self, _: torch.device) -> Puppet:
        return self

    def fingerprint(self) -> str:
        return f"always {self.action}"

    def act(self, images: torch.Tensor, *_: Any) -> torch.Tensor:
        return torch.full((len(images), 4, 1), self.action)


def test_a_rollout_sums_what_the_environment_gives(
    monkeypatch: pytest.MonkeyPatch, quick: None
) -> None:
    name = "suite/cartpole-balance"
    monkeypatch.setattr(
        checkpoint, "load_policy", lambda _: (Puppet(0.25), {"task": name, "replan": 4})
    )
    report = rollout.run(Path("any"), None, 5, "seen")
    sums = []
    for i in range(5):
        env = start(name, i)
        sums.append(sum(env.step(np.full(1, 0.25), look=False).reward for _ in range(20)))
    assert (
        min(sums) > 10
        and report.mean_return == pytest.approx(np.mean(sums))
        and report.episodes == 5
    )


def test_a_video_runs_at_the_speed_of_the_robot(
    monkeypatch: pytest.MonkeyPatch, quick: None
) -> None:
    """50 steps per second, 10 frames per second."""
    shown: list[media.Clip] = []
    monkeypatch.setattr(
        checkpoint, "load_policy", lambda _: (Puppet(0.0), {"task": NAME, "replan": 3})
    )
    monkeypatch.setattr(media, "save_video", lambda clips, _: shown.extend(clips))
    rollout.run(Path("any"), None, 2, "seen", Path("v.gif"))
    assert [len(clip.moments) for clip in shown] == [1 + 20 // 5] * 2
    assert all("return" in clip.moments[-1].note and clip.ring is None for clip in shown)


def test_a_study_compares_returns(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, tiny_folder: Path
) -> None:
    raw = study_samples.raw(
        tiny_folder, tasks=[NAME], tuning={**study_samples.TUNING, "task": NAME}
    )
    loaded = study_cells.load(study_samples.write(tmp_path, raw))
    study_samples.invent(monkeypatch)
    study_samples.fake_bench(monkeypatch)
    successful = study_samples.row

    def row(self: Any, label: str, made: Any, validation: bool = False) -> Any:
        found = successful(made)
        return dataclasses.replace(
            found,
            return_share=found.success_seen,
            success_seen=None,
            success_held_out=None,
            wrong_target=None,
        )

    monkeypatch.setattr(policy_cells.PolicyRunner, "figures", row)
    report = study.run(loaded, tmp_path)
    assert report.finished == report.cells and all(
        0.7 <= point.success <= 1 for point in report.tuning
    )
    naive, other = report.tasks[0].results
    assert other.return_gain_points.mean == pytest.approx(
        100 * (other.return_share.mean - naive.return_share.mean)
    )
    assert (
        other.success_seen is None
        and other.seen_gain_points is None
        and other.bar.passed in (None, False)
    )
    console = Console(file=io.StringIO(), width=200)
    console.print(render.study(report))
    text = console.file.getvalue()
    assert (
        "Return % of highest" in text
        and "Return - naive (points)" in text
        and "Success" not in text
    )
    render.frontier_plot(report, tmp_path / "frontier.png")
    assert (tmp_path / "frontier.png").stat().st_size > 1000


# --- what is refused -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (("suite/cartpole-swngup",), ("'suite/cartpole-swngup'", "use 'suite/cartpole-swingup'")),
        (("suite/cartpole_swingup",), ("use 'suite/cartpole-swingup'",)),
        (("cartpole-swingup",), ("use 'suite/cartpole-swingup'",)),
        (("suite/",), ("'suite/'", "e.g. suite/cartpole-swingup")),
        (("suite",), ("'suite'", "e.g. suite/cartpole-swingup")),
        (("reach", "--drop-below", "0.2"), ("drop_below 0.2", "'reach'", "leave it out")),
        ((NAME, "--drop-below", "1"), ("--drop-below 1", "below 1")),
        ((NAME, "--drop-below", "-0.1"), ("--drop-below -0.1",)),
        ((NAME, "--drop-below", "nan"), ("--drop-below nan",)),
    ],
)
def test_bad_arguments(args: tuple[str, ...], says: tuple[str, ...], aegis, tmp_path: Path) -> None:
    message = refused(aegis("demos", *args, "--episodes", "1", "--out", tmp_path / "d.safetensors"))
    assert all(word in message for word in says), message
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("setting", "says"),
    [
        ("task=suite/pendulum", ("'suite/pendulum'", "suite/DOMAIN-TASK")),
        ("rollout.colors=[seen]", ("rollout.colors: seen", "delete rollout.colors")),
        ("demos.drop_below=1", ("demos.drop_below", "below 1")),
    ],
)
def test_bad_recipes(setting: str, says: tuple[str, ...], aegis, place: Path) -> None:
    message = refused(aegis("run", "small.yaml", "--set", setting))
    assert all(word in message for word in says), message


def test_a_quantile_for_a_task_without_returns(aegis, place: Path) -> None:
    message = refused(
        aegis("run", "small.yaml", "--set", "task=reach", "--set", "demos.drop_below=0.1")
    )
    assert "demos.drop_below: 0.1 with task: reach" in message


@pytest.mark.parametrize(
    "command", [("run", "small.yaml", "--out", "runs"), (*TRAIN, "--dry-run"), TRAIN]
)
def test_a_task_that_the_suite_does_not_have(command: tuple[str, ...], aegis, place: Path) -> None:
    """Its name has a valid form, so only making it can tell; nothing is written before that."""
    demos.run(NAME, 2, 0, place / "d.safetensors", workers=1)
    before = sorted(place.rglob("*"))
    message = refused(aegis(*command, "--set", "task=suite/pendulum-swungup"))
    assert "suite/pendulum-swungup" in message and "suite/pendulum-swingup" in message
    assert sorted(place.rglob("*")) == before


def test_a_study_of_a_task_that_the_suite_does_not_have(tmp_path: Path, tiny_folder: Path) -> None:
    raw = study_samples.raw(tiny_folder, tasks=["suite/pendulum-swungup"])
    with pytest.raises(AegisError, match="use 'suite/pendulum-swingup'"):
        study.run(study_cells.load(study_samples.write(tmp_path, raw)), tmp_path / "runs")
    assert not (tmp_path / "runs").exists()


def test_recipes_with_suite_tasks_need_no_simulator() -> None:
    program = (
        "import sys, dataclasses; from aegis_cli import recipes\n"
        f"made = recipes.load('recipes/quickstart.yaml', ['task={NAME}', 'demos.drop_below=0.5'])\n"
        f"assert made.task == '{NAME}'\n"
        "heavy = {'torch', 'numpy', 'mujoco', 'dm_control'} & set(sys.modules); assert not "
        "heavy, heavy"
    )
    done = python(program)
    assert done.returncode == 0, done.stderr
