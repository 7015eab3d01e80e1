"""Run a policy in episodes of a simulated task, and report its success or return."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from aegis_cli import sim
from aegis_cli.common import kept_lines, media
from aegis_cli.common.estimates import estimate
from aegis_cli.common.events import OnEvent, Progress, ignore
from aegis_cli.common.kept_lines import KeptLines
from aegis_cli.common.palette import COLORS, HELD_OUT, SEEN
from aegis_cli.common.pictures import fit
from aegis_cli.core.continuation import Continued
from aegis_cli.core.ensemble import TemporalEnsemble
from aegis_cli.data.batch import Images
from aegis_cli.data.vqa.metrics import wilson_interval
from aegis_cli.models.policy import Policy
from aegis_cli.sim.contract import EVALUATION, Observation, Step, TaskEnv, episode_rng
from aegis_cli.sim.simulators import Simulators, Wanted, opened

EVALUATION_SEED = 0
PLACING = "rollout (placing)"  # the stage in which large simulators start
TARGET_COLORS: dict[str, tuple[str, ...]] = {"seen": SEEN, "held-out": HELD_OUT, "all": COLORS}
DEFAULT = "seen"  # the default, and the only choice for a task without colours


@dataclass(frozen=True)
class PartSuccess:
    """A policy's success in some of the episodes."""

    success: float
    interval: tuple[float, float]
    episodes: int


@dataclass(frozen=True, kw_only=True)
class RolloutReport:
    """A policy's closed-loop results: shares in [0, 1], and the 95 % interval of the success.

    The distance is the mean at the end of the episodes; only a task with coloured targets has one.
    `tasks` has the success in each task of a set, and `suites` in each suite if there are several.
    If the episodes differ in them, `target_colors` has it by the target's colour, and
    `instructions` by the instruction, in which `{color}` stands for the colour.

    `outcomes` has one character per episode, 1 for a success and 0 otherwise.

    A task measured by its return has none of these. It has the mean return, the 95 % interval of
    that (Student's t; None for one episode), and its share of the highest possible return, 1 per
    step.

    `action_change` is the root mean square of the difference between one executed action and the
    next, as a share of a full action: how much the robot jerks. Episodes of one step have none.
    """

    task: str
    colors: str | None = None
    success: float | None = None
    interval: tuple[float, float] | None = None
    outcomes: str | None = None
    wrong_target: float | None = None
    final_distance_m: float | None = None
    suites: dict[str, PartSuccess] | None = None
    tasks: dict[str, PartSuccess] | None = None
    target_colors: dict[str, PartSuccess] | None = None
    instructions: dict[str, PartSuccess] | None = None
    mean_return: float | None = None
    return_interval: tuple[float, float] | None = None
    return_share: float | None = None
    action_change: float | None = None
    episodes: int
    episodes_per_s: float
    video: str | None = None

    def to_json(self) -> dict[str, Any]:
        """The report as values that JSON can hold."""
        return asdict(self)


@dataclass
class _PlayedEpisode:
    """One environment with its episode so far.

    A filmed episode keeps `media.FRAMES_PER_S` `moments` per second, as many as the video shows.
    For other episodes `moments` is None.
    """

    env: TaskEnv
    observation: Observation
    moments: list[media.Moment] | None
    ensemble: TemporalEnsemble | None = None
    left: np.ndarray | None = None  # the rest of its last chunk [n, A]
    executed: np.ndarray | None = None  # the last action [A]
    changes: list[float] = field(default_factory=list)  # mean squares over the dimensions
    last: Step | None = None
    total_reward: float = 0.0
    steps: int = 0

    @property
    def done(self) -> bool:
        return self.last is not None and self.last.done

    @property
    def end(self) -> Step:
        """The last step of an episode that has been played."""
        assert self.last is not None
        return self.last


@dataclass(frozen=True)
class _Played:
    """The result of an episode as plain JSON values, so that it can be stored.

    Attributes:
        distance_m: from the effector to the target at the end, in a task with coloured targets.
        longest: how many steps the episode could have had.
        jerks, jerked: the sum of the mean squared differences between consecutive executed actions,
            and their number.
    """

    success: bool
    wrong_target: bool
    distance_m: float | None
    target_color: str | None
    instruction: str
    total_reward: float
    longest: int
    jerks: float
    jerked: int


@dataclass(frozen=True)
class _Pace:
    """How many actions of each chunk are executed, and which.

    Attributes:
        replan: actions between two predictions.
        delay: how many actions of the previous chunk are executed during a prediction; None: the
            robot stands still meanwhile.
        guided: whether a delayed chunk continues the previous one (see `core.continuation`).
    """

    replan: int
    delay: int | None = None
    guided: bool = False


# (height, width) of each camera's pictures in training; empty if unknown.
Sizes = tuple[tuple[int, int], ...]


class Acting(NamedTuple):
    """A policy ready to act in a task; `replan` actions of each predicted chunk are executed.

    `ensemble` is the decay of its temporal ensemble, which predicts at every step. The task's
    pictures are resized to `sizes` if training used others. `rate`, the actions per second that the
    policy was trained for, is known if it was not trained on a simulated task.
    """

    policy: Policy
    task: str
    replan: int
    cameras: tuple[str, ...] = ()  # that it sees through; empty for the task's own
    ensemble: float | None = None
    sizes: Sizes = ()
    rate: float | None = None


def play(
    acting: Acting,
    episodes: int,
    colors: str,
    stream: int = EVALUATION,
    video_out: Path | None = None,
    on_event: OnEvent = ignore,
    seed: int = EVALUATION_SEED,
    delay: int | None = None,
    guided: bool = False,
    kept: KeptLines | None = None,
) -> RolloutReport:
    """Let a policy act in `episodes` episodes of its task.

    The episodes are the same for every policy: they depend only on the task, the seed, the stream
    and their number. With the decay of a temporal ensemble the policy predicts at every step,
    whatever `replan` is.

    Args:
        colors: one of TARGET_COLORS; only the default for a task without coloured targets.
        delay: steps that a prediction takes, during which the robot continues with the previous
            chunk; None: it waits.
        guided: whether a delayed chunk continues the previous one.
        kept: stored results of the same setting, which are not played again; new results are added.
            None stores nothing.
    """
    task, pace = acting.task, _Pace(acting.replan, delay, guided)
    started = time.perf_counter()
    before, begun = ({}, {}) if kept is None else _kept(kept)
    before_s = 0.0
    finished: list[_Played] = []
    films: list[media.Clip] = []
    stage = f"rollout {colors}" if sim.has_colors(task) else "rollout"
    clips = 0 if video_out is None else media.CLIPS
    at_once = sim.lockstep(task)  # episodes that share a forward pass
    with _simulators(acting, episodes) as simulators:
        for first in range(0, episodes, at_once):
            numbers = range(first, min(episodes, first + at_once))
            known = before.get((first, len(numbers)))
            if known is not None and first >= clips:
                finished += known.episodes
                before_s += known.seconds
                longest = known.episodes[0].longest
                on_event(Progress(stage, numbers.stop * longest, episodes * longest, "steps"))
                continue
            part = begun.get((first, len(numbers)), _Begun([], 0.0))
            began, known_steps = time.perf_counter() - part.seconds, len(part.decided)
            before_s += part.seconds
            try:
                # The first episodes are filmed.
                group = _begun(acting, simulators, seed, stream, numbers, colors, clips, on_event)
                longest = group[0].env.spec.max_steps
                for _ in _play(acting, simulators, group, pace, first, seed, part.decided):
                    # An episode that ended early counts in full, so the progress reaches 100 %.
                    in_group = sum(longest if e.done else e.steps for e in group)
                    done = first * longest + in_group
                    on_event(Progress(stage, done, episodes * longest, "steps"))
            except BaseException:  # a signal, above all
                if kept is not None and len(part.decided) > known_steps:
                    seconds = time.perf_counter() - began
                    kept.add([_line_begun(numbers, _Begun(part.decided, seconds))])
                raise
            films += [_clip(episode) for episode in group[: max(0, clips - first)]]
            played = [_played(episode) for episode in group]
            if kept is not None:
                kept.add([_line(first, _Group(played, time.perf_counter() - began))])
            finished += played
        seconds = before_s + time.perf_counter() - started
        if video_out is not None:
            media.save_video(films, video_out)
        return RolloutReport(
            task=task,
            episodes=episodes,
            episodes_per_s=episodes / seconds,
            video=None if video_out is None else str(video_out),
            action_change=_action_change(finished),
            **_measured(task, colors, finished),
        )


def _played(episode: _PlayedEpisode) -> _Played:
    """The result of a finished episode."""
    return _Played(
        success=bool(episode.end.success),
        wrong_target=bool(episode.end.wrong_target),
        distance_m=episode.env.distance(),
        target_color=episode.env.target_color,
        instruction=episode.observation.instruction,
        total_reward=float(episode.total_reward),
        longest=episode.env.spec.max_steps,
        jerks=sum(episode.changes),
        jerked=len(episode.changes),
    )


class _Group(NamedTuple):
    """Episodes that were played together, and how many seconds they took."""

    episodes: list[_Played]
    seconds: float


def _line(first: int, group: _Group) -> dict[str, Any]:
    """A group as a stored line: an episode's noise depends on how many are played with it."""
    episodes = [asdict(episode) for episode in group.episodes]
    return {"first": first, "seconds": group.seconds, "episodes": episodes}


class _Begun(NamedTuple):
    """The beginning of a group that was interrupted.

    Attributes:
        decided: the chunks [B, H, A] of its unfinished episodes at each prediction so far. With
            them its episodes are played again without the policy, up to where it was interrupted.
        seconds: how long that took.
    """

    decided: list[np.ndarray]
    seconds: float


def _line_begun(numbers: Sequence[int], begun: _Begun) -> dict[str, Any]:
    """The beginning of a group as a stored line."""
    decided = [kept_lines.packed(chunk) for chunk in begun.decided]
    line = {"first": numbers[0], "count": len(numbers), "seconds": begun.seconds}
    return kept_lines.sealed(line | {"decided": decided})


def _read_begun(line: Mapping[str, Any]) -> _Begun:
    decided = [kept_lines.unpacked(chunk) for chunk in line["decided"]]
    return _Begun(decided, float(line["seconds"]))


Key = tuple[int, int]  # a group's first episode, and how many episodes it has


def _kept(kept: KeptLines) -> tuple[dict[Key, _Group], dict[Key, _Begun]]:
    """The stored groups that were finished, and the beginnings of others."""
    found, begun = dict[Key, _Group](), dict[Key, _Begun]()
    for line in kept.read():
        try:
            if "decided" in line:
                if (said := kept_lines.unsealed(line)) is not None:
                    begun[said["first"], said["count"]] = _read_begun(said)
                continue
            episodes = [_Played(**episode) for episode in line["episodes"]]
            found[line["first"], len(episodes)] = _Group(episodes, float(line["seconds"]))
        except (KeyError, TypeError, ValueError):  # an unreadable line: that group is played again
            continue
    return found, begun


def _simulators(acting: Acting, episodes: int) -> AbstractContextManager[Simulators]:
    """The maker of the task's environments, in this process or in several.

    Raises:
        AegisError: the task cannot be made; raised before any process starts.
    """
    workers = sim.workers(acting.task, episodes)
    if workers > 1:  # so that first-use writes and downloads of a benchmark happen once
        sim.make(acting.task, seen_by=acting.cameras)
    return opened(workers, sim.lockstep(acting.task))


def longest_s(acting: Acting, episodes: int, colors: str, stream: int, seed: int) -> float:
    """About how many seconds `play` takes if no episode ends early, from its second chunk.

    The first chunk includes one-time work.
    """
    numbers = range(min(episodes, sim.lockstep(acting.task)))
    placing = time.perf_counter()
    with _simulators(acting, episodes) as simulators:
        group = _begun(acting, simulators, seed, stream, numbers, colors, filmed=0)
        before, taken, seconds, started = 0, 0, 0.0, time.perf_counter()
        begun_s = (started - placing) * math.ceil(episodes / len(group))
        playing = _play(acting, simulators, group, _Pace(acting.replan), 0, seed, [])
        for _ in itertools.islice(playing, 2):
            now, steps = time.perf_counter(), sum(e.steps for e in group)
            seconds, taken = now - started, steps - before
            started, before = now, steps
    return begun_s + seconds * episodes * group[0].env.spec.max_steps / taken


def _action_change(finished: Sequence[_Played]) -> float | None:
    """The root mean square over the steps of all episodes; None if each had a single step."""
    count = sum(episode.jerked for episode in finished)
    return math.sqrt(sum(episode.jerks for episode in finished) / count) if count else None


def _measured(task: str, colors: str, finished: Sequence[_Played]) -> dict[str, Any]:
    """The figures of the report for this kind of task."""
    if sim.is_suite(task):
        return _returns(finished)
    found: dict[str, Any] = {**vars(_success(finished))}
    del found["episodes"]  # every report has this, including one of returns
    found["outcomes"] = "".join(str(int(e.success)) for e in finished)
    if sim.has_colors(task):
        wrong = sum(e.wrong_target for e in finished) / len(finished)
        distance = float(np.mean([e.distance_m for e in finished if e.distance_m is not None]))
        found |= {"colors": colors, "wrong_target": wrong, "final_distance_m": distance}
    tasks = sim.members(task)
    if tasks != (task,):
        # The tasks take turns: episode i is of task i mod n. With few episodes, some tasks have
        # none.
        turns = {name: finished[turn :: len(tasks)] for turn, name in enumerate(tasks)}
        found["tasks"] = {name: _success(played) for name, played in turns.items() if played}
        found["suites"] = _by_suite(task, turns)
    found["target_colors"] = _apart(finished, lambda e: e.target_color)
    found["instructions"] = _apart(finished, _instruction)
    return found


def _by_suite(task: str, turns: Mapping[str, Sequence[_Played]]) -> dict[str, PartSuccess] | None:
    """The success in each suite of a set, from the episodes by task; None if there is one suite."""
    found = {}
    for suite in sim.suites(task):
        played = [episode for name in sim.members(suite) for episode in turns[name]]
        if played:
            found[suite] = _success(played)
    return found or None


def _apart(
    finished: Sequence[_Played], part_of: Callable[[_Played], str | None]
) -> dict[str, PartSuccess] | None:
    """The success in each part of the episodes; None if there is only one part."""
    parts: dict[str, list[_Played]] = {}
    for episode in finished:
        if (name := part_of(episode)) is not None:
            parts.setdefault(name, []).append(episode)
    return {name: _success(parts[name]) for name in sorted(parts)} if len(parts) > 1 else None


def _instruction(episode: _Played) -> str:
    """The instruction of an episode, without the colour of its target."""
    color, said = episode.target_color, episode.instruction
    return said if color is None else said.replace(color, "{color}")


def _success(finished: Sequence[_Played]) -> PartSuccess:
    successes = sum(e.success for e in finished)
    interval = wilson_interval(successes, len(finished))
    return PartSuccess(successes / len(finished), interval, len(finished))


def _returns(finished: Sequence[_Played]) -> dict[str, Any]:
    found = estimate([e.total_reward for e in finished])
    share = found.mean / finished[0].longest
    return {"mean_return": found.mean, "return_interval": found.interval, "return_share": share}


def _begun(
    acting: Acting,
    simulators: Simulators,
    seed: int,
    stream: int,
    numbers: Sequence[int],
    colors: str,
    filmed: int,
    on_event: OnEvent = ignore,
) -> list[_PlayedEpisode]:
    """Start the episodes of these numbers; those below `filmed` are filmed."""
    begun: dict[int, _PlayedEpisode] = {}

    def begin(number: int) -> None:
        shown = number < filmed
        begun[number] = _begin(acting, simulators, seed, stream, number, colors, shown)

    def told(done: int) -> None:
        if sim.of_datasets(acting.task) is not None:  # other simulators start at once
            on_event(Progress(PLACING, done, len(numbers), "episodes"))

    told(0)
    simulators.each(begin, numbers, told)
    return [begun[number] for number in numbers]


def _begin(
    acting: Acting,
    simulators: Simulators,
    seed: int,
    stream: int,
    number: int,
    colors: str,
    filmed: bool,
) -> _PlayedEpisode:
    published = (seed, stream) == (EVALUATION_SEED, EVALUATION)
    env = simulators.make(Wanted(acting.task, number, acting.cameras, published))
    observation = env.reset(episode_rng(seed, stream, number), TARGET_COLORS[colors])
    moments = [media.Moment(observation.image, "start")] if filmed else None
    averaged = None if acting.ensemble is None else TemporalEnsemble(acting.ensemble)
    return _PlayedEpisode(env, observation, moments, averaged)


def _play(
    acting: Acting,
    simulators: Simulators,
    group: list[_PlayedEpisode],
    pace: _Pace,
    first: int,
    seed: int,
    decided: list[np.ndarray],
) -> Iterator[None]:
    """Run a group to its end in lockstep, chunk by chunk; finished episodes drop out.

    Args:
        decided: the chunks that are already known of an earlier, interrupted run of this group, in
            order; all further ones are added.
    """
    # Seeded by the group, so that the noise does not depend on how earlier groups ended.
    generator = torch.Generator().manual_seed(seed * 1_000_003 + first)
    for number in itertools.count():
        if not (active := [e for e in group if not e.done]):
            return
        if number < len(decided):
            # The policy would have drawn this noise.
            acting.policy.draw_noise(len(active), generator)
        else:
            seen = [e.observation for e in active]
            decided.append(_decide(acting, seen, generator, _continued(active, pace)))
        # Only what the policy looks at is rendered.
        looks = number + 1 >= len(decided)
        simulators.each(
            lambda each, looks=looks: _execute(each[0], _to_execute(*each, pace), looks),
            list(zip(active, decided[number], strict=True)),
        )
        yield


def _continued(active: Sequence[_PlayedEpisode], pace: _Pace) -> Continued | None:
    """The actions that the next chunks continue; None at the start of episodes, or unguided."""
    left = [e.left for e in active if e.left is not None and len(e.left)]
    if pace.delay is None or not pace.guided or not left:
        return None
    # In lockstep all have equally many actions left, so they stack to [B, n, A].
    return Continued(torch.from_numpy(np.stack(left)), pace.delay)


def _to_execute(episode: _PlayedEpisode, chunk: np.ndarray, pace: _Pace) -> np.ndarray:
    """The actions [*, A] until the next prediction: from a chunk [H, A], or from the ensemble."""
    if episode.ensemble is not None:
        return episode.ensemble.next(torch.from_numpy(chunk))[None].numpy()  # one action, [1, A]
    if pace.delay and episode.left is not None:
        # While the policy predicted, the robot took `delay` steps of the old chunk.
        chunk = np.concatenate([episode.left[: pace.delay], chunk[pace.delay :]])
    episode.left = chunk[pace.replan :]
    return chunk[: pace.replan]


def _decide(
    acting: Acting,
    observations: list[Observation],
    generator: torch.Generator,
    continued: Continued | None,
) -> np.ndarray:
    """Action chunks [B, H, A] in the task's units."""
    images = _images(observations, acting.sizes)
    proprio = torch.from_numpy(np.stack([o.proprio for o in observations]))  # [B, P]
    instructions = [o.instruction for o in observations]
    return acting.policy.act(images, instructions, proprio, generator, continued).cpu().numpy()


def _images(observations: list[Observation], sizes: Sizes) -> Images:
    """[B, H, W, 3] or, with several cameras, B tuples of [H, W, 3]."""
    rows = [_fitted((o.image, *o.more), sizes) for o in observations]
    if not observations[0].more:
        return torch.from_numpy(np.stack([image for (image,) in rows]))
    return [tuple(map(torch.from_numpy, row)) for row in rows]


def _fitted(pictures: Sequence[np.ndarray], sizes: Sizes) -> Sequence[np.ndarray]:
    """One picture of each camera, resized to the sizes of the training if these are known."""
    if not sizes:
        return pictures
    return [fit(picture, *size) for picture, size in zip(pictures, sizes, strict=True)]


def _execute(episode: _PlayedEpisode, actions: np.ndarray, looks: bool = True) -> None:
    """Execute a chunk of actions.

    An observation is rendered after the last action, if the policy looks at it; for a film, after
    each.
    """
    every = max(1, round(episode.env.spec.control_hz / media.FRAMES_PER_S))
    for number, action in enumerate(actions, 1):
        look = (looks and number == len(actions)) or episode.moments is not None
        # Actions are defined in [-1, 1]; a flow may end slightly outside.
        given = np.clip(action, -1, 1)
        if episode.executed is not None:
            episode.changes.append(float(np.square(given - episode.executed).mean()))
        episode.executed = given
        # `look` renders an observation; without it a step has none.
        episode.last = step = episode.env.step(given, look)
        episode.steps += 1
        episode.observation = step.observation or episode.observation
        episode.total_reward += step.reward or 0.0
        if episode.moments is not None and (episode.steps % every == 0 or step.done):
            episode.moments.append(_moment(episode, step))
        if step.done:
            return


def _moment(episode: _PlayedEpisode, step: Step) -> media.Moment:
    """What a video shows of a step; the outcome is unknown until the episode is over."""
    note = f"step {episode.steps}"
    if step.success is None:
        note += f"   return {episode.total_reward:.1f}"
    elif step.done:
        note += ": " + _ended(step)
    outcome = step.success if step.done else None
    assert step.observation is not None
    return media.Moment(step.observation.image, note, outcome)


def _ended(step: Step) -> str:
    if step.success:
        return "success"
    return "wrong target" if step.wrong_target else "out of time"


def _clip(episode: _PlayedEpisode) -> media.Clip:
    caption = episode.observation.instruction
    assert episode.moments is not None
    return media.Clip(caption, episode.moments, episode.env.target_circle())
