"""Record an episode of the expert, with noisy execution and clean labels; no torch, no files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from aegis_cli.sim import make, member, members
from aegis_cli.sim.contract import DEMOS, TaskEnv, episode_rng

# Probability per step that a burst of noise begins or ends, so bursts and the pauses between them
# last 4 steps on average.
_SWITCH = 0.25


@dataclass(frozen=True)
class RecordedEpisode:
    """T recorded steps, up to and including the one that ended the episode."""

    frames: np.ndarray  # [T, 64, 64, 3] uint8
    proprio: np.ndarray  # [T, P] float32
    actions: np.ndarray  # [T, A] float32, the expert's action at each frame
    instruction: str
    target_color: str | None
    # A task has one of these two, as in `contract.Step`.
    success: bool | None
    total_reward: float | None = None
    task: str | None = None  # for a set, the task whose turn it was
    more_frames: tuple[np.ndarray, ...] = ()  # [T, 64, 64, 3] uint8 of each further camera


def bursts(rng: np.random.Generator, size: float, actions: int) -> Iterator[np.ndarray]:
    """Endless pushes [A] in bursts: each burst is one constant random push, followed by zeros.

    A constant push moves the effector off its path, so that the labels show how to recover. White
    noise would average out and only visit the expert's own states.

    Args:
        size: standard deviation of a push.
    """
    push = np.zeros(actions)
    while True:
        if rng.random() < _SWITCH:
            push = np.zeros(actions) if push.any() else rng.normal(0.0, size, actions)
        yield push


def record(
    env: TaskEnv, rng: np.random.Generator, noise: float, colors: Sequence[str]
) -> RecordedEpisode:
    """Run one episode of `env` to its end; the target's colour is one of `colors`."""
    seen = env.reset(rng, colors)
    frames, more, proprio, actions, rewards = [], [], [], [], []
    pushes = bursts(rng, noise, len(env.spec.action_names))
    while True:
        push = next(pushes)
        label = env.expert_action()
        frames.append(seen.image)
        more.append(seen.more)
        proprio.append(seen.proprio)
        actions.append(label)
        step = env.step(label + push)
        if step.reward is not None:
            rewards.append(step.reward)
        if step.done:
            break
        assert step.observation is not None
        seen = step.observation
    return RecordedEpisode(
        np.stack(frames),
        np.stack(proprio),
        np.stack(actions),
        seen.instruction,
        env.target_color,
        step.success,
        sum(rewards) if rewards else None,
        more_frames=tuple(np.stack(camera) for camera in zip(*more, strict=True)),
    )


def record_numbered(
    task: str,
    seed: int,
    noise: float,
    colors: Sequence[str],
    i: int,
    threads: int = 1,
    seen_by: tuple[str, ...] = (),
) -> RecordedEpisode:
    """Episode `i` of `seed`, the same in whichever process it is recorded.

    Args:
        threads: number of threads with which a planner simulates; the episode does not depend on
            it.
        seen_by: cameras, in this order; empty for the task's own.
    """
    env = _env(task, threads, i % len(members(task)), seen_by)
    episode = record(env, episode_rng(seed, DEMOS, i), noise, colors)
    return replace(episode, task=member(task, i))


@cache  # one environment per task and process: creating one takes longer than an episode
def _env(task: str, threads: int, turn: int, seen_by: tuple[str, ...]) -> TaskEnv:
    return make(task, threads, turn, seen_by)
