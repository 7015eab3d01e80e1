"""Closed loop: known policies have known success, and equal runs give equal results.

No episode equals a demonstration.
"""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import pytest
import torch
from samples.small_run import recipe

from aegis_cli import sim
from aegis_cli.common import artifacts, cache, media
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, Progress, Warned
from aegis_cli.common.palette import HELD_OUT, RGB, SEEN
from aegis_cli.common.pictures import fit
from aegis_cli.core.continuation import Continued
from aegis_cli.data.vqa.metrics import wilson_interval
from aegis_cli.evaluation import rollout
from aegis_cli.models import acting
from aegis_cli.models.policy import Policy
from aegis_cli.sim.contract import Observation, Step
from aegis_cli.training import checkpoint, train

Decide = Callable[["Seen"], np.ndarray]


class Seen:
    """An environment that records what could be seen, whether or not it was rendered."""

    def __init__(self, env: Any) -> None:
        self.env, self.spec = env, env.spec
        self.shown: list[Observation] = []

    def reset(self, rng: np.random.Generator, colors: tuple[str, ...]) -> Observation:
        self.shown.append(self.env.reset(rng, colors))
        return self.shown[-1]

    def step(self, action: np.ndarray, look: bool) -> Step:
        step = self.env.step(action)
        self.shown.append(step.observation)
        return step if look else dataclasses.replace(step, observation=None)

    @property
    def target_color(self) -> str:
        return self.env.target_color

    def distance(self) -> float:
        return self.env.distance()

    def target_circle(self) -> tuple[float, float, float]:
        return self.env.target_circle()


@pytest.fixture
def envs(monkeypatch: pytest.MonkeyPatch) -> list[Seen]:
    """Every environment that the rollout makes, in order."""
    made: list[Seen] = []
    make = sim.make

    def seen(name: str, **_: Any) -> Seen:
        made.append(Seen(make(name)))
        return made[-1]

    monkeypatch.setattr(rollout.sim, "make", seen)
    return made


class Puppet:
    """A policy that knows each picture's environment, and asks `decide` for its chunk there."""

    def __init__(self, envs: list[Seen], decide: Decide, chunk: int) -> None:
        self.envs, self.decide, self.chunk, self.calls = envs, decide, chunk, 0

    def to(self, _: torch.device) -> Puppet:
        return self

    def fingerprint(self) -> str:
        return str(id(self))  # unlike that of any other policy

    def act(
        self,
        images: torch.Tensor,
        texts: list[str],
        proprio: torch.Tensor,
        _: torch.Generator,
        continued: Continued | None = None,
    ) -> torch.Tensor:
        assert continued is None
        self.calls += 1
        by_picture = {env.shown[-1].image.tobytes(): env for env in self.envs}
        seen = [by_picture[image.numpy().tobytes()] for image in images]
        assert [env.shown[-1].instruction for env in seen] == texts
        assert np.array_equal(np.stack([env.shown[-1].proprio for env in seen]), proprio.numpy())
        actions = np.stack([self.decide(env) for env in seen])
        return torch.from_numpy(actions).float()[:, None].repeat(1, self.chunk, 1)


def expert(seen: Seen) -> np.ndarray:
    return seen.env.expert_action()


def rest(seen: Seen) -> np.ndarray:
    return np.zeros(2, np.float32)


def to_a_distractor(seen: Seen) -> np.ndarray:
    """The scripted expert, sent to the disc beside the true one."""
    gap = seen.env.centers[1] - seen.env.tip()
    return gap / max(np.linalg.norm(gap), seen.env.slow_m)


@pytest.fixture
def puppet(envs: list[Seen], monkeypatch: pytest.MonkeyPatch) -> Callable[..., Puppet]:
    """Replace every trained policy with a puppet."""

    def install(decide: Decide, task: str = "point", chunk: int = 1) -> Puppet:
        policy = Puppet(envs, decide, chunk)
        monkeypatch.setattr(
            checkpoint, "load_policy", lambda _: (policy, {"task": task, "replan": chunk})
        )
        return policy

    return install


def timeless(report: rollout.RolloutReport) -> rollout.RolloutReport:
    return dataclasses.replace(report, episodes_per_s=0.0)


# --- known policies ------------------------------------------------------------------------------


@pytest.mark.parametrize("task", sorted(sim.TASKS))
def test_the_expert_succeeds(task: str, puppet: Callable[..., Puppet]) -> None:
    puppet(expert, task)
    report = rollout.run(Path("any"), task, 16, "all")
    assert (
        report.success >= 15 / 16 and report.wrong_target == 0 and report.final_distance_m < 0.035
    )
    assert (
        report.interval == wilson_interval(round(16 * report.success), 16) and report.episodes == 16
    )
    assert (report.task, report.colors) == (task, "all")


def test_who_rests_fails_and_stays_away(puppet: Callable[..., Puppet]) -> None:
    puppet(rest, chunk=10)
    report = rollout.run(Path("any"), None, 4, "seen")
    assert (report.success, report.wrong_target) == (0, 0) and report.final_distance_m > 0.08


def test_the_wrong_disc_is_counted_as_such(puppet: Callable[..., Puppet]) -> None:
    puppet(to_a_distractor)
    report = rollout.run(Path("any"), None, 8, "seen")
    assert report.success == 0 and report.wrong_target >= 7 / 8


def test_successes_are_told_by_colour_and_by_instruction(
    puppet: Callable[..., Puppet], envs: list[Seen]
) -> None:
    def to_red_alone(seen: Seen) -> np.ndarray:
        return expert(seen) if seen.env.target_color == "red" else rest(seen)

    puppet(to_red_alone)
    report = rollout.run(Path("any"), None, 24, "seen")
    asked = [(env.env.target_color, env.shown[0].instruction) for env in envs[-24:]]
    assert set(report.target_colors) == {color for color, _ in asked}
    for color, found in report.target_colors.items():
        assert found.episodes == sum(color == own for own, _ in asked)
        assert found.success == (color == "red")
        assert found.interval == wilson_interval(found.episodes * (color == "red"), found.episodes)
    assert set(report.instructions) <= set(sim.make("point").env.spec.templates)
    for text, found in report.instructions.items():
        own = [color for color, said in asked if text.format(color=color) == said]
        assert found.episodes == len(own) > 0
        assert found.success == pytest.approx(own.count("red") / len(own))
    assert sum(found.episodes for found in report.instructions.values()) == 24


def test_successes_are_told_by_suite(
    puppet: Callable[..., Puppet], monkeypatch: pytest.MonkeyPatch
) -> None:
    """For a set as large as LIBERO's four suites: every third episode is of the second suite."""
    members = {"point": ("a", "b", "c"), "one": ("a", "c"), "two": ("b",)}
    monkeypatch.setattr(sim, "members", members.__getitem__)
    monkeypatch.setattr(sim, "suites", lambda _: ("one", "two"))
    puppet(expert)
    report = rollout.run(Path("any"), None, 7, "seen")
    assert {name: found.episodes for name, found in report.suites.items()} == {"one": 5, "two": 2}
    won = [char == "1" for char in report.outcomes]
    assert report.suites["two"].success == np.mean([won[1], won[4]])
    assert report.suites["one"].success == np.mean([won[i] for i in (0, 2, 3, 5, 6)])


def test_episodes_that_are_all_of_one_kind_are_not_told_apart(
    puppet: Callable[..., Puppet],
) -> None:
    puppet(rest, chunk=40)
    report = rollout.run(Path("any"), None, 1, "seen")
    assert report.target_colors is None and report.instructions is None


@pytest.mark.parametrize(("replan", "calls"), [(None, 10), (2, 20), (40, 1)])
def test_replan_is_how_many_actions_of_a_chunk_are_executed(
    replan: int | None, calls: int, puppet: Callable[..., Puppet], envs: list[Seen]
) -> None:
    steps = sim.make("point").env.spec.max_steps
    envs.clear()
    policy = puppet(rest, chunk=40)
    checkpoint_meta = {"task": "point", "replan": 4}
    load = lambda _: (policy, checkpoint_meta)  # noqa: E731
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(checkpoint, "load_policy", load)
        rollout.run(Path("any"), None, 2, "seen", replan=replan)
    assert steps == 40 and policy.calls == calls  # both episodes share each call
    assert [len(env.shown) for env in envs] == [steps + 1] * 2


@pytest.mark.parametrize(
    ("asked", "own", "decay"), [(0.2, None, 0.2), (None, 0.4, 0.4), (-0.3, 0.4, -0.3)]
)
def test_an_ensemble_executes_the_mean_of_what_was_predicted(
    asked: float | None,
    own: float | None,
    decay: float,
    puppet: Callable[..., Puppet],
    envs: list[Seen],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Several episodes, each compared with a plain sum of ACT's weights, one prediction a step."""
    chunk, predicted, executed = 3, list[np.ndarray](), dict[int, list[np.ndarray]]()
    draws = np.random.default_rng(0)
    policy = puppet(rest, chunk=chunk)

    def act(images: torch.Tensor, *_: Any) -> torch.Tensor:
        predicted.append(draws.uniform(-0.2, 0.2, (len(images), chunk, 2)).astype(np.float32))
        return torch.from_numpy(predicted[-1])

    def step(self: Seen, action: np.ndarray, look: bool) -> Step:
        executed.setdefault(envs.index(self), []).append(action)
        return self.env.step(action)

    monkeypatch.setattr(policy, "act", act)
    monkeypatch.setattr(Seen, "step", step)
    meta = {"task": "point", "replan": 1} | ({} if own is None else {"ensemble": own})
    monkeypatch.setattr(checkpoint, "load_policy", lambda _: (policy, meta))
    rollout.run(Path("any"), None, 2, "seen", ensemble=asked)
    steps = len(predicted)
    assert steps == 40 and [len(actions) for actions in executed.values()] == [steps] * 2
    for number, actions in executed.items():
        for at, found in enumerate(actions):
            told = [predicted[t][number, at - t] for t in range(max(0, at - chunk + 1), at + 1)]
            weights = np.exp(-decay * np.arange(len(told)))
            expected = weights @ np.stack(told) / weights.sum()
            np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(("far", "change"), [(0.2, 0.4), (3.0, 2.0)])
def test_the_change_of_the_actions_is_that_of_what_is_executed(
    far: float, change: float, puppet: Callable[..., Puppet], monkeypatch: pytest.MonkeyPatch
) -> None:
    """For a policy that reverses at every step in one of two dimensions; 1 is a full action."""
    policy = puppet(rest, chunk=2)
    turns = np.array([[far, 0.1], [-far, 0.1]], np.float32)
    monkeypatch.setattr(policy, "act", lambda images, *_: torch.from_numpy(turns)[None])
    report = rollout.run(Path("any"), None, 1, "seen")
    assert report.action_change == pytest.approx(change / math.sqrt(2))


def test_a_replan_that_is_asked_for_executes_chunks_as_they_are(
    puppet: Callable[..., Puppet], monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = puppet(rest, chunk=40)
    meta = {"task": "point", "replan": 1, "ensemble": 0.1}
    monkeypatch.setattr(checkpoint, "load_policy", lambda _: (policy, meta))
    rollout.run(Path("any"), None, 2, "seen", replan=20)
    assert policy.calls == 2
    with pytest.raises(AegisError, match="decay inf"):
        rollout.run(Path("any"), None, 2, "seen", ensemble=float("inf"))


@pytest.mark.parametrize("known", [True, False])
def test_pictures_are_shown_in_the_sizes_of_training(
    known: bool, puppet: Callable[..., Puppet], envs: list[Seen], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in `load_policy` and `aegis evaluate`; in the task's own size if none is known."""
    policy, shown = puppet(rest, chunk=40), list[np.ndarray]()

    def act(images: torch.Tensor, *_: Any) -> torch.Tensor:
        shown.extend(images.numpy())
        return torch.zeros(len(images), 40, 2)

    monkeypatch.setattr(policy, "act", act)
    meta = {"task": "point", "replan": 40} | ({"pictures": [[40, 60]]} if known else {})
    monkeypatch.setattr(checkpoint, "load_policy", lambda _: (policy, meta))
    rollout.run(Path("any"), None, 2, "seen")
    first = [env.shown[0].image for env in envs]
    expected = [fit(picture, 40, 60) for picture in first] if known else first
    np.testing.assert_array_equal(np.stack(shown), np.stack(expected))


@pytest.mark.parametrize("guided", [True, False])
@pytest.mark.parametrize(("replan", "delay"), [(4, 3), (5, 0), (3, 3), (6, 1)])
def test_while_a_delayed_chunk_is_predicted_the_one_before_is_executed(
    replan: int,
    delay: int,
    guided: bool,
    puppet: Callable[..., Puppet],
    envs: list[Seen],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """This holds for each of several episodes, one of which ends before the others."""
    horizon, predicted = 9, list[np.ndarray]()
    told, executed = list[Continued | None](), dict[int, list[np.ndarray]]()
    draws = np.random.default_rng(0)
    policy = puppet(rest, chunk=horizon)
    policy.expert = SimpleNamespace(shape=SimpleNamespace(chunk=horizon))

    def act(images: torch.Tensor, *given: Any) -> torch.Tensor:
        predicted.append(draws.uniform(-0.2, 0.2, (len(images), horizon, 2)).astype(np.float32))
        told.append(given[-1])
        return torch.from_numpy(predicted[-1])

    def step(self: Seen, action: np.ndarray, look: bool) -> Step:
        number = envs.index(self)
        executed.setdefault(number, []).append(action)
        done = number == 1 and len(executed[number]) == 20
        found = self.env.step(action)
        return dataclasses.replace(found, done=True) if done else found

    monkeypatch.setattr(policy, "act", act)
    monkeypatch.setattr(Seen, "step", step)
    meta = {"task": "point", "replan": replan}
    monkeypatch.setattr(checkpoint, "load_policy", lambda _: (policy, meta))
    rollout.run(Path("any"), None, 3, "seen", delay=delay, guided=guided)
    assert [len(executed[number]) for number in range(3)] == [40, 20, 40]
    for number, actions in executed.items():
        for at, found in enumerate(actions):
            asked, into = divmod(at, replan)
            late = asked > 0 and into < delay  # the previous chunk continues
            rows = [3 if turn * replan < 20 else 2 for turn in range(len(predicted))]
            chunk = predicted[asked - late]
            row = number if rows[asked - late] == 3 or number == 0 else 1
            expected = chunk[row, into + replan * late]
            np.testing.assert_array_equal(found, expected)
    assert told[0] is None and all((one is not None) == guided for one in told[1:])
    for one, before in zip(told[1:], predicted, strict=False):
        if one is not None and len(one.actions) == len(before):
            # The rest of the previous chunk, without what was executed.
            assert one.delay == delay
            np.testing.assert_array_equal(one.actions, before[:, replan:])


@pytest.mark.parametrize(
    ("replan", "delay", "longest"), [(2, 3, 2), (7, 3, 2), (9, 1, 0), (2, -1, 2)]
)
def test_a_delay_that_a_chunk_cannot_bridge_is_refused(
    replan: int, delay: int, longest: int, puppet: Callable[..., Puppet]
) -> None:
    policy = puppet(rest, chunk=9)
    policy.expert = SimpleNamespace(shape=SimpleNamespace(chunk=9))
    with pytest.raises(AegisError, match=f"a delay of {delay} steps") as caught:
        rollout.run(Path("any"), None, 1, "seen", replan=replan, delay=delay)
    assert f"0 to {longest}:" in caught.value.expected and policy.calls == 0


def test_a_delay_is_not_for_a_temporal_ensemble(run_folder: Path) -> None:
    with pytest.raises(AegisError, match="with the temporal ensemble 0.1"):
        rollout.run(run_folder, None, 1, "seen", delay=1, ensemble=0.1)


def test_progress_and_more_episodes_than_one_group(
    puppet: Callable[..., Puppet], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sim, "lockstep", lambda _: 2)
    puppet(expert)
    events: list = []
    report = rollout.run(Path("any"), None, 5, "held-out", on_event=events.append)
    loading, events = events[:2], events[2:]
    assert [e.stage for e in loading] == 2 * ["rollout (loading)"]
    assert [e.done for e in loading] == [0, 1]
    done, longest = [e.done for e in events], sim.make("reach").spec.max_steps
    assert done == sorted(done) and done[-1] == 5 * longest and report.success >= 4 / 5
    assert 0 < done[0] <= 2 * 4 and {2 * longest, 4 * longest} < set(
        done
    )  # one chunk per episode; an episode that ends early is done
    assert {(e.stage, e.total, e.unit) for e in events} == {
        ("rollout held-out", 5 * longest, "steps")
    }


# --- which episodes ------------------------------------------------------------------------------


def test_no_episode_is_a_demonstrations(
    puppet: Callable[..., Puppet], envs: list[Seen], demos_file: Path
) -> None:
    puppet(rest, "reach", chunk=40)
    rollout.run(Path("any"), None, 8, "seen")
    tensors = artifacts.load(demos_file, "demos").tensors
    starts = {
        frame.numpy().tobytes() for frame in tensors["frames"][tensors["episode_starts"][:-1]]
    }
    shown = {env.shown[0].image.tobytes() for env in envs}
    assert len(starts) == len(shown) == 8 and not starts & shown


@pytest.mark.parametrize(
    ("colors", "allowed"), [("seen", SEEN), ("held-out", HELD_OUT), ("all", SEEN + HELD_OUT)]
)
def test_colours_are_those_asked_for(
    colors: str, allowed: tuple[str, ...], puppet: Callable[..., Puppet], envs: list[Seen]
) -> None:
    puppet(expert)
    rollout.run(Path("any"), None, 12, colors)
    named = {
        word for env in envs for word in env.shown[0].instruction.split() if word in SEEN + HELD_OUT
    }
    assert named <= set(allowed) and len(named) >= 2
    assert colors != "all" or named & set(HELD_OUT)


def test_episodes_are_the_same_for_every_policy_and_number(
    puppet: Callable[..., Puppet], envs: list[Seen]
) -> None:
    puppet(rest, chunk=40)
    rollout.run(Path("any"), None, 3, "seen")
    puppet(expert)
    rollout.run(Path("any"), None, 5, "seen")
    first = [env.shown[0].image.tobytes() for env in envs]
    assert first[:3] == first[3:6] and len(set(first)) == 5


# --- a trained run -------------------------------------------------------------------------------


def test_the_same_run_twice_gives_the_same_result(run_folder: Path, envs: list[Seen]) -> None:
    first = rollout.run(run_folder, "reach", 3, "seen")
    shutil.rmtree(cache.folder("episodes"))  # otherwise the second would be the first
    second = rollout.run(run_folder, None, 3, "seen")
    assert timeless(first) == timeless(second) and first.episodes_per_s > 0
    paths = [[s.proprio.tobytes() for s in env.shown] for env in envs]
    assert paths[:3] == paths[3:] and len(set(paths[0])) > 5  # the same steps, and it moves


@pytest.mark.parametrize("groups", [1, 2])
def test_an_interrupted_rollout_goes_on_to_the_same_report(
    groups: int, run_folder: Path, envs: list[Seen], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It resumes after the groups of episodes that were played; the others are played as usual."""
    monkeypatch.setattr(sim, "lockstep", lambda _: 2)

    class Stopped(Exception):
        pass

    def stop(event: Event) -> None:
        longest = sim.make("reach").spec.max_steps
        if isinstance(event, Progress) and event.done > groups * 2 * longest:
            raise Stopped

    with pytest.raises(Stopped):
        rollout.run(run_folder, None, 5, "seen", on_event=stop)
    del envs[:]
    events: list[Event] = []
    resumed = rollout.run(run_folder, None, 5, "seen", on_event=events.append)
    assert len(envs) == 5 - 2 * groups
    told = [event for event in events if isinstance(event, Progress) and event.unit == "steps"]
    assert told[-1].done == told[-1].total
    del envs[:]
    again = rollout.run(run_folder, None, 5, "seen")
    assert envs == [] and timeless(again) == timeless(resumed)
    assert again.episodes_per_s < 1000  # the speed of playing, not of finding
    shutil.rmtree(cache.folder("episodes"))
    assert timeless(rollout.run(run_folder, None, 5, "seen")) == timeless(resumed)


class Counted:
    """Interrupts a rollout after some predictions, and counts these."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.asked, self.until = 0, math.inf
        plain = Policy.act_from

        def act_from(policy: Policy, *given: Any) -> torch.Tensor:
            if self.asked >= self.until:
                raise KeyboardInterrupt
            self.asked += 1
            return plain(policy, *given)

        monkeypatch.setattr(Policy, "act_from", act_from)


WAYS: list[dict[str, Any]] = [
    {"replan": 2},
    {"ensemble": 0.1},
    {"replan": 2, "delay": 1},
    {"replan": 2, "delay": 1, "guided": True},
]


@pytest.mark.parametrize("way", WAYS)
def test_a_rollout_interrupted_within_a_group_predicts_nothing_twice(
    way: dict[str, Any], run_folder: Path, envs: list[Seen], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its episodes repeat the actions that they had, and nothing else of the report differs."""
    counted = Counted(monkeypatch)
    whole = rollout.run(run_folder, None, 3, "seen", **way)
    needed, paths = counted.asked, [env.shown[-1].proprio.tobytes() for env in envs]
    shutil.rmtree(cache.folder("episodes"))
    counted.asked, stops = 0, (3, 4, needed - 1)
    for counted.until in stops:
        with pytest.raises(KeyboardInterrupt):
            rollout.run(run_folder, None, 3, "seen", **way)
        assert counted.asked == counted.until
    counted.until = math.inf
    del envs[:]
    resumed = rollout.run(run_folder, None, 3, "seen", **way)
    assert counted.asked == needed and timeless(resumed) == timeless(whole)
    assert [env.shown[-1].proprio.tobytes() for env in envs] == paths
    assert resumed.episodes_per_s < 1000


def test_the_video_of_a_resumed_rollout_is_the_same(
    run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Byte for byte, since filmed episodes are rendered again."""
    counted, film = Counted(monkeypatch), tmp_path / "v.mp4"
    rollout.run(run_folder, None, 3, "seen", film, 2)
    whole, needed = film.read_bytes(), counted.asked
    shutil.rmtree(cache.folder("episodes"))
    counted.asked, counted.until = 0, 5
    with pytest.raises(KeyboardInterrupt):
        rollout.run(run_folder, None, 3, "seen", film, 2)
    counted.until = math.inf
    rollout.run(run_folder, None, 3, "seen", film, 2)
    assert film.read_bytes() == whole and counted.asked == needed


@pytest.mark.parametrize("damage", ['"type"', '"shape"', '"bytes"', "A"])
def test_the_beginning_of_a_group_that_is_damaged_is_played_again(
    damage: str, run_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counted = Counted(monkeypatch)
    whole = rollout.run(run_folder, None, 3, "seen", replan=2)
    needed = counted.asked
    shutil.rmtree(cache.folder("episodes"))
    counted.asked, counted.until = 0, 3
    with pytest.raises(KeyboardInterrupt):
        rollout.run(run_folder, None, 3, "seen", replan=2)
    (kept,) = cache.folder("episodes").glob("*.jsonl")
    text = kept.read_text()
    assert damage in text
    kept.write_text(text.replace(damage, damage.replace("A", "B").replace("e", "o"), 1))
    counted.asked, counted.until = 0, math.inf
    assert timeless(rollout.run(run_folder, None, 3, "seen", replan=2)) == timeless(whole)
    assert counted.asked == needed


def test_what_was_played_otherwise_is_played_again(
    run_folder: Path, envs: list[Seen], tmp_path: Path
) -> None:
    """With other colours or another pace, with another number at once, or for a video."""
    rollout.run(run_folder, None, 2, "seen")
    options: list[dict[str, Any]] = [
        {"colors": "held-out"},
        {"replan": 2},
        {"seed": 3},
        {"ensemble": 0.1},
        {"episodes": 1},
        {"video_out": tmp_path / "v.gif"},
    ]
    for changed in options:
        del envs[:]
        asked = {"run_path": run_folder, "task": None, "episodes": 2, "colors": "seen", **changed}
        rollout.run(**asked)
        assert len(envs) == asked["episodes"], changed


def test_several_processes_play_the_same_episodes(
    run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Down to the bytes of the video."""
    alone = rollout.run(run_folder, None, 3, "seen", tmp_path / "v.mp4")
    shutil.rmtree(cache.folder("episodes"))
    film = (tmp_path / "v.mp4").read_bytes()
    monkeypatch.setattr(sim, "workers", lambda *_: 2)
    shared = rollout.run(run_folder, None, 3, "seen", tmp_path / "v.mp4")
    assert timeless(alone) == timeless(shared)
    assert (tmp_path / "v.mp4").read_bytes() == film


def test_no_picture_of_an_episode_that_is_over_is_held(
    puppet: Callable[..., Puppet], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pictures may be large, and there may be thousands of episodes."""
    puppet(rest, chunk=40)
    held: list[Any] = []
    measured = acting._measured

    def noted(task: str, colors: str, finished: list[Any]) -> dict[str, Any]:
        held.extend(finished)
        return measured(task, colors, finished)

    monkeypatch.setattr(acting, "_measured", noted)
    rollout.run(Path("any"), None, 3, "seen")
    assert len(held) == 3
    for episode in held:
        json.dumps(dataclasses.asdict(episode))  # plain values only, without an array


@pytest.mark.parametrize(("rate", "warnings"), [(None, 0), (10.0, 0), (30.0, 1)])
def test_steps_of_another_length_than_the_trainings_are_warned_of(
    rate: float | None, warnings: int, run_folder: Path
) -> None:
    """This can only happen for a policy that was trained for no task."""
    assert sim.make("reach").spec.control_hz == 10.0

    def load(folder: Path, task: str | None) -> rollout.Acting:
        return rollout.load_run(folder, task)._replace(rate=rate)

    events: list[Event] = []
    rollout.run(run_folder, None, 1, "seen", on_event=events.append, load=load)
    said = [event.text for event in events if isinstance(event, Warned)]
    assert len(said) == warnings
    assert all("'reach' has 10 steps a second" in text and "on 30" in text for text in said)


def test_a_checkpoint_is_rolled_out_by_its_own_folder(
    tiny_folder: Path, demos_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train.run(recipe(tiny_folder, steps=4), "naive", demos_file, None, tmp_path / "run")
    loaded: list[torch.Tensor] = []

    def play(played: acting.Acting, *_: object) -> None:
        loaded.append(next(played.policy.expert.parameters()))

    monkeypatch.setattr(rollout, "play", play)
    checkpoints = tmp_path / "run" / "checkpoints"
    for folder in (
        tmp_path / "run",
        checkpoints / "last",
        checkpoints / "000004",
        checkpoints / "000002",
    ):
        rollout.run(folder, None, 1, "seen")
    newest, last, fourth, second = loaded
    assert newest.equal(last) and newest.equal(fourth) and not newest.equal(second)


def test_json_keys(aegis, run_folder: Path) -> None:
    code, out, _ = aegis(
        "rollout", run_folder, "--task", "reach", "--episodes", 2, "--colors", "held-out", "--json"
    )
    report = json.loads(out)
    assert code == 0 and {"success", "interval", "wrong_target", "episodes"} <= set(report)
    assert (report["episodes"], report["colors"]) == (2, "held-out") and len(
        report["interval"]
    ) == 2


def test_another_seed_plays_other_episodes(aegis, run_folder: Path) -> None:
    kept = run_folder / "results" / "rollout-seen.json"
    for seed in (0, 7):
        code, _, err = aegis("rollout", run_folder, "--episodes", 2, "--seed", seed)
        assert code == 0 and json.loads(kept.read_text())["settings"]["seed"] == seed, err
    with pytest.MonkeyPatch.context() as patch:
        begun: list[tuple[int, int]] = []
        begin = acting._begin

        def noted(*given: Any) -> Any:
            _, _, seed, _, number, *_ = given
            begun.append((seed, number))
            return begin(*given)

        patch.setattr(acting, "_begin", noted)
        shutil.rmtree(cache.folder("episodes"))
        assert aegis("rollout", run_folder, "--episodes", 2, "--seed", 7)[0] == 0
    assert begun == [(7, 0), (7, 1)]


def test_the_table_is_for_people(aegis, run_folder: Path) -> None:
    code, out, _ = aegis("rollout", run_folder, "--episodes", 1)
    assert code == 0 and "success" in out and " %" in out


# --- videos --------------------------------------------------------------------------------------


CELL, LINE, LEFT, TOP = 288, 296, 10, 26  # a video's tiles, and the origin of their pictures


def picture_in(frame: np.ndarray, column: int) -> np.ndarray:
    """What a policy saw, cut from a tile of a video's frame; the note and the ring are on it."""
    left = LEFT + column * CELL
    return frame[TOP + 2 : TOP + 256 : 4, left + 2 : left + 256 : 4]


def border_of(frame: np.ndarray, column: int) -> np.ndarray:
    """The colour of a tile's lower edge."""
    return frame[TOP + 259, LEFT + column * CELL + 128]


def test_gif(puppet: Callable[..., Puppet], envs: list[Seen], tmp_path: Path) -> None:
    from PIL import Image as image

    puppet(expert)
    report = rollout.run(Path("any"), None, 3, "seen", tmp_path / "v.gif")
    assert report.video == str(tmp_path / "v.gif") and [p.name for p in tmp_path.iterdir()] == [
        "v.gif"
    ]
    with image.open(tmp_path / "v.gif") as gif:
        longest = max(len(env.shown) for env in envs)
        # Equal frames are merged, so the pause at the end is one frame.
        assert longest - 3 <= gif.n_frames <= longest + 1 and gif.info["loop"] == 0
        first, last = (
            np.asarray((gif.seek(i), gif.convert("RGB"))[1], int) for i in (0, gif.n_frames - 1)
        )
    for i, env in enumerate(envs):  # each episode's tile is its picture, enlarged
        for frame, observation in ((first, env.shown[0]), (last, env.shown[-1])):
            off = np.abs(picture_in(frame, i) - observation.image).max(axis=-1)
            assert np.median(off) < 12  # 256 colours for all, a ring and a note
        assert np.abs(border_of(first, i) - media.UNDECIDED).max() < 12
        assert np.abs(border_of(last, i) - media.SUCCESS).max() < 12
    assert (np.abs(first - last) > 60).any()


def test_mp4(puppet: Callable[..., Puppet], envs: list[Seen], tmp_path: Path) -> None:

    puppet(to_a_distractor)
    rollout.run(Path("any"), None, 2, "seen", tmp_path / "v.mp4")
    with av.open(str(tmp_path / "v.mp4")) as container:
        frames = [
            frame.to_ndarray(format="rgb24").astype(int) for frame in container.decode(video=0)
        ]
    assert len(frames) == max(len(env.shown) for env in envs) + 10  # a second to see the end
    for frame, observation in ((frames[0], envs[0].shown[0]), (frames[-1], envs[0].shown[-1])):
        off = np.abs(picture_in(frame, 0) - observation.image).max(axis=-1)
        assert np.median(off) < 12
    assert np.abs(border_of(frames[0], 0) - media.UNDECIDED).max() < 20
    assert np.abs(border_of(frames[-1], 0) - media.FAILURE).max() < 20
    assert (np.abs(frames[0] - frames[-1]) > 60).any()


@pytest.mark.parametrize(
    ("decide", "end"),
    [(expert, "success"), (to_a_distractor, "wrong target"), (rest, "out of time")],
)
def test_a_video_says_the_step_the_end_and_the_instruction(
    decide: Decide,
    end: str,
    puppet: Callable[..., Puppet],
    envs: list[Seen],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    saved: list[media.Clip] = []
    monkeypatch.setattr(media, "save_video", lambda clips, _: saved.extend(clips))
    puppet(decide)
    rollout.run(Path("any"), None, 1, "seen", tmp_path / "v.gif")
    (clip,), (env,) = saved, envs
    notes = [moment.note for moment in clip.moments]
    steps = len(env.shown) - 1
    assert notes[:3] == ["start", "step 1", "step 2"] and notes[-1] == f"step {steps}: {end}"
    assert [moment.outcome for moment in clip.moments] == [None] * steps + [end == "success"]
    assert clip.caption == env.shown[0].instruction


def test_a_task_measured_by_its_return_shows_that_and_never_ends_well_or_badly() -> None:
    observation = Observation(np.zeros((64, 64, 3), np.uint8), np.zeros(2, np.float32), "run")
    step = Step(observation, None, None, True, reward=0.5)
    episode = acting._PlayedEpisode(None, observation, [], last=step, total_reward=83.44, steps=120)
    moment = acting._moment(episode, step)
    assert (moment.note, moment.outcome) == ("step 120   return 83.4", None)


@pytest.mark.parametrize("task", sorted(sim.TASKS))
def test_the_ring_is_where_the_picture_shows_the_target(task: str) -> None:
    env = sim.make(task)
    for i in range(5):
        image = env.reset(sim.contract.episode_rng(0, 1, i), SEEN).image.astype(int)
        right, down, radius = env.target_circle()
        y, x = np.mgrid[:64, :64] + 0.5
        away = np.hypot(x - 64 * right, y - 64 * down)
        inside, outside = image[away < 0.6 * 64 * radius], image[away > 1.3 * 64 * radius]
        found = np.median(inside, axis=0)
        hue = found / found.max()
        assert (
            np.abs(hue - np.array(RGB[env.target_color]) / max(RGB[env.target_color])).max() < 0.2
        )
        assert np.abs(outside - found).max(axis=-1).min() > 20  # no other place has its colour


# --- what is refused -----------------------------------------------------------------------------


def test_wrong_task(run_folder: Path) -> None:
    with pytest.raises(AegisError, match="task 'point' for a policy trained on 'reach'") as caught:
        rollout.run(run_folder, "point", 2, "seen")
    assert caught.value.fix == "--task reach"
    with pytest.raises(AegisError, match="use 'reach'"):
        rollout.run(run_folder, "raech", 2, "seen")


def test_no_run_and_zero_episodes(tmp_path: Path, run_folder: Path) -> None:
    with pytest.raises(AegisError, match="no checkpoint in"):
        rollout.run(tmp_path, None, 2, "seen")
    with pytest.raises(AegisError, match="0 episodes"):
        rollout.run(run_folder, None, 0, "seen")


@pytest.mark.parametrize("name", ["v.avi", "v", "none/v.gif", "/"])
def test_a_video_that_cannot_be_written_is_refused_before_any_step(
    name: str, puppet: Callable[..., Puppet], envs: list[Seen], tmp_path: Path
) -> None:
    puppet(expert)
    with pytest.raises(AegisError) as caught:
        rollout.run(Path("any"), None, 2, "seen", tmp_path / name)
    assert caught.value.fix and not envs and not list(tmp_path.iterdir())


def test_a_video_takes_no_folders_place(tmp_path: Path) -> None:
    (tmp_path / "v.gif").mkdir()
    for path in (tmp_path / "v.gif", Path(".")):
        with pytest.raises(AegisError, match="cannot be written"):
            media.check_video(path)
