"""Demonstrations: what is recorded, and that only the arguments determine the bytes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError
from aegis_cli.common.palette import HELD_OUT
from aegis_cli.data import record as demos
from aegis_cli.sim import TASKS, make
from aegis_cli.sim.contract import DEMOS, Observation, Step, episode_rng
from aegis_cli.sim.recording import RecordedEpisode, bursts, record, record_numbered


class Spied:
    """A task that remembers the expert's and the executed actions."""

    def __init__(self, name: str) -> None:
        self._env = make(name)
        self.spec = self._env.spec
        self.expert: list[np.ndarray] = []
        self.executed: list[np.ndarray] = []

    @property
    def target_color(self) -> str:
        return self._env.target_color

    def reset(self, rng: np.random.Generator, colors: tuple[str, ...]) -> Observation:
        return self._env.reset(rng, colors)

    def step(self, action: np.ndarray) -> Step:
        self.expert.append(self._env.expert_action())  # at the state in which the action is applied
        self.executed.append(np.asarray(action))
        return self._env.step(action)

    def expert_action(self) -> np.ndarray:
        return self._env.expert_action()


Recorded = tuple[demos.DemosReport, artifacts.Artifact]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    path = tmp_path_factory.mktemp("demos") / "reach.safetensors"
    report = demos.run("reach", 12, 3, path, workers=1)
    return report, artifacts.load(path, "demos")


@pytest.mark.parametrize("task", sorted(TASKS))
def test_labels_are_the_experts_and_execution_is_noisy(task: str) -> None:
    env = Spied(task)
    episode = record(env, episode_rng(0, DEMOS, 0), 0.5, ("red",))
    np.testing.assert_array_equal(episode.actions, np.stack(env.expert))
    assert not np.allclose(episode.actions, np.stack(env.executed))
    assert episode.target_color == "red" and " red " in episode.instruction


def test_without_noise_the_labels_are_executed() -> None:
    env = Spied("point")
    episode = record(env, episode_rng(0, DEMOS, 0), 0.0, ("red",))
    np.testing.assert_array_equal(episode.actions, np.stack(env.executed))


def test_noise_comes_in_bursts_of_the_asked_size() -> None:
    source = bursts(np.random.default_rng(0), 0.3, 2)
    pushes = np.stack([next(source) for _ in range(8000)])
    on = pushes.any(axis=1)
    assert 0.4 < on.mean() < 0.6
    assert 0.27 < pushes[on].std() < 0.33
    same = (pushes[1:] == pushes[:-1]).all(axis=1)
    assert 0.7 < same.mean() < 0.8  # a push lasts several steps


def test_frames_belong_to_their_labels() -> None:
    """The recorded picture is from before the action: replaying the episode shows it again."""
    episode = record_numbered("point", 5, 0.0, ("blue",), 2)
    env = make("point")
    seen = env.reset(episode_rng(5, DEMOS, 2), ("blue",))
    for frame, proprio, action in zip(episode.frames, episode.proprio, episode.actions):
        np.testing.assert_array_equal(frame, seen.image)
        np.testing.assert_array_equal(proprio, seen.proprio)
        step = env.step(action)
        seen = step.observation
    assert step.success and episode.success


def test_artifact_is_consistent(recorded: Recorded) -> None:
    report, artifact = recorded
    tensors, meta = artifact.tensors, artifact.header.meta
    starts = tensors["episode_starts"].tolist()
    n = starts[-1]
    assert report.episodes == 12 == len(starts) - 1 and report.frames == n
    assert starts[0] == 0 and all(a < b for a, b in zip(starts, starts[1:]))
    assert tensors["frames"].shape == (n, 64, 64, 3)
    assert tensors["proprio"].shape == (n, len(meta["proprio_names"]))
    assert tensors["actions"].shape == (n, len(meta["action_names"]))
    assert meta["task"] == "reach" and artifact.header.seed == 3
    for instruction, color in zip(
        tensors["instruction"].tolist(), tensors["target_color"].tolist()
    ):
        assert f" {meta['colors'][color]} " in meta["instructions"][instruction]


def test_no_held_out_target(recorded: Recorded) -> None:
    meta = recorded[1].header.meta
    shown = {meta["colors"][i] for i in recorded[1].tensors["target_color"].tolist()}
    assert len(shown) > 1 and not shown & set(HELD_OUT)


def test_recording_ends_soon_after_arrival() -> None:
    """Few frames rest at the target; otherwise a policy learns to rest."""
    kept = [record_numbered("reach", 0, 0.3, ("red",), i) for i in range(10)]
    slow = [int((np.linalg.norm(e.actions, axis=1) < 0.1).sum()) for e in kept]
    assert max(slow) <= 4


def test_same_bytes_from_one_worker_and_two(recorded: Recorded, tmp_path: Path) -> None:
    two = demos.run("reach", 12, 3, tmp_path / "two.safetensors", workers=2)
    assert two.workers == 2 and two.sha256 == recorded[0].sha256


def test_no_noise_is_none_with_either_sign(tmp_path: Path) -> None:
    """NumPy treats -0.0 as a negative deviation."""
    for name, noise in (("plus", 0.0), ("minus", -0.0)):
        demos.run("point", 1, 0, tmp_path / name, noise=noise, workers=1)
    assert (tmp_path / "plus").read_bytes() == (tmp_path / "minus").read_bytes()


def test_another_seed_gives_other_bytes(recorded: Recorded, tmp_path: Path) -> None:
    assert (
        demos.run("reach", 12, 4, tmp_path / "other.safetensors", workers=1).sha256
        != recorded[0].sha256
    )


def test_failures_are_dropped_and_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def every_third_fails(
        task: str, seed: int, noise: float, colors: tuple[str, ...], i: int, **_: int
    ) -> RecordedEpisode:
        t = i + 1  # so that the lengths tell which episodes were kept
        blank = (
            np.zeros((t, 64, 64, 3), np.uint8),
            np.zeros((t, 2), np.float32),
            np.zeros((t, 2), np.float32),
        )
        return RecordedEpisode(*blank, "go to the red pad", "red", success=i % 3 != 0)

    monkeypatch.setattr(demos, "record_numbered", every_third_fails)
    report = demos.run("point", 4, 0, tmp_path / "d.safetensors", workers=1)
    assert (report.episodes, report.attempts, report.success) == (4, 6, 4 / 6)
    assert artifacts.load(tmp_path / "d.safetensors").tensors["episode_starts"].tolist() == [
        0,
        2,
        5,
        10,
        16,
    ]


def test_an_expert_that_keeps_failing_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    failed = RecordedEpisode(*[np.zeros(1)] * 3, "go to the red pad", "red", success=False)
    monkeypatch.setattr(demos, "record_numbered", lambda *_, **__: failed)
    with pytest.raises(AegisError, match="0 of 26"):
        demos.run("point", 3, 0, tmp_path / "d.safetensors", workers=1)
    assert not list(tmp_path.iterdir())


def test_progress_counts_every_episode(tmp_path: Path) -> None:
    events: list = []
    demos.run("point", 3, 0, tmp_path / "d.safetensors", workers=1, on_event=events.append)
    assert [(e.stage, e.done, e.total) for e in events] == [("demos", i, 3) for i in (1, 2, 3)]


def test_preview_shows_the_frames(tmp_path: Path) -> None:
    from PIL import Image as image

    report = demos.run(
        "point", 3, 0, tmp_path / "d.safetensors", workers=1, preview=tmp_path / "p.png"
    )
    assert report.preview == str(tmp_path / "p.png")
    sheet = np.asarray(image.open(tmp_path / "p.png"))
    frame = artifacts.load(tmp_path / "d.safetensors").tensors["frames"][0].numpy()
    tile = frame.repeat(3, axis=0).repeat(3, axis=1)
    np.testing.assert_array_equal(sheet[20 : 20 + 192, 4 : 4 + 192], tile)


@pytest.mark.parametrize("form", demos.FORMATS)
def test_a_preview_is_a_file_of_its_own(
    form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demos, "record_numbered", lambda *_, **__: pytest.fail("recorded"))
    with pytest.raises(AegisError, match="--preview .*, which this command also"):
        demos.run("point", 2, 0, tmp_path / "d", preview=tmp_path / "." / "d", form=form)


@pytest.mark.parametrize(
    "change",
    [
        {"episodes": 0},
        {"episodes": -1},
        {"task": "raech"},
        {"noise": -0.1},
        {"noise": float("nan")},
        {"workers": 0},
        {"colors": ()},
        {"colors": ("mauve",)},
    ],
)
def test_bad_arguments_are_one_error_and_no_file(change: dict, tmp_path: Path) -> None:
    with pytest.raises(AegisError):
        demos.run(
            **{
                "task": "point",
                "episodes": 2,
                "seed": 0,
                "out": tmp_path / "d.safetensors",
                **change,
            }
        )
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("where", ["out", "preview"])
def test_a_missing_folder_is_found_before_recording(
    where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demos, "record_numbered", lambda *_, **__: pytest.fail("recorded"))
    paths = {"out": tmp_path / "d.safetensors", where: tmp_path / "none" / "file"}
    with pytest.raises(AegisError, match="mkdir"):
        demos.run("point", 2, 0, **paths)
