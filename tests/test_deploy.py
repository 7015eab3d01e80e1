"""A trained policy in a user's program does the same as the run's policy."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from samples import lerobot
from samples.small_run import recipe
from samples.training import images, make_policy

from aegis_cli import deploy, load_policy, sim
from aegis_cli.common import devices
from aegis_cli.common import pictures as fitting
from aegis_cli.common.errors import AegisError
from aegis_cli.continual import robots
from aegis_cli.continual.train import run as learn_stream
from aegis_cli.deploy import DeployedPolicy
from aegis_cli.evaluation import rollout
from aegis_cli.models.acting import Acting
from aegis_cli.publishing import card, export
from aegis_cli.training import checkpoint, train

TEXT, OTHER, REPLAN = "go to the red target", "go to the blue target", 2
POSITIONS = [0.3, -0.1, 0.2]


def deployed(**changes: Any) -> DeployedPolicy:
    settings: dict[str, Any] = {"task": None, "cameras": (), "replan": REPLAN}
    return DeployedPolicy(make_policy().eval(), **settings | changes)


def frame(seed: int = 0) -> np.ndarray:
    return images(seed + 1)[seed].numpy()


def test_it_predicts_what_the_runs_policy_predicts(run_folder: Path) -> None:
    policy, meta = checkpoint.load_policy(run_folder)
    positions = np.linspace(-1, 1, policy.expert.shape.proprio, dtype=np.float32)
    generator = torch.Generator().manual_seed(3)
    expected = policy.act(
        torch.from_numpy(frame())[None], [TEXT], torch.from_numpy(positions)[None], generator
    )[0]
    own = load_policy(run_folder, seed=3)
    found = own.predict_action_chunk(frame(), TEXT, positions)
    np.testing.assert_array_equal(found, expected.numpy())
    assert found.shape == (own.chunk, own.actions) and own.positions == len(positions)
    assert (own.task, own.cameras, own.replan) == ("reach", (), meta["replan"])


@pytest.fixture(params=[torch.float64, torch.bfloat16, "meta"], ids=str)
def another_default(request: pytest.FixtureRequest) -> Iterator[Callable[[], None]]:
    """A program whose new tensors have another dtype, like one that simulates in float64.

    Or they are on another device, as if it had set a GPU; numbers on "meta" have no values.

    Returns:
        a function that sets the defaults.
    """
    is_type = isinstance(request.param, torch.dtype)
    change = torch.set_default_dtype if is_type else torch.set_default_device
    yield lambda: change(request.param)
    torch.set_default_dtype(torch.float32)
    torch.set_default_device(None)


def test_the_programs_defaults_change_no_action(
    run_folder: Path, tmp_path: Path, another_default: Callable[[], None]
) -> None:
    """Loading and acting do not depend on them, nor does an ensemble, nor a continued chunk."""
    export.run(run_folder, tmp_path / "lerobot")
    picture = frame()
    expected = acted(run_folder, picture)
    another_default()
    for folder in (run_folder, tmp_path / "lerobot"):
        np.testing.assert_array_equal(acted(folder, picture), expected)


def acted(folder: Path, picture: np.ndarray) -> np.ndarray:
    """The actions of a folder's policy, in each of the ways to ask for them."""
    own, averaging = load_policy(folder), load_policy(folder, ensemble=0.01)
    positions = [0.1] * own.positions
    found = [one.select_action(picture, TEXT, positions) for one in (own, averaging, own.begin())]
    chunk = own.predict_action_chunk(picture, TEXT, positions)
    continued = own.predict_action_chunk(picture, TEXT, positions, previous=chunk[1:], delay=1)
    return np.concatenate([*found, chunk.ravel(), continued.ravel()])


@pytest.mark.parametrize("blank", ["", "  \n"])
def test_a_blank_instruction_is_refused(blank: str) -> None:
    with pytest.raises(AegisError, match="a blank instruction"):
        deployed().select_action(frame(), blank, POSITIONS)


def test_a_picture_that_nobody_may_write_to_is_taken_as_it_is() -> None:
    """So are those of PIL and of a file; a warning here would be an error."""
    picture = frame()
    expected = deployed().select_action(picture, TEXT, POSITIONS)
    picture.flags.writeable = False
    np.testing.assert_array_equal(deployed().select_action(picture, TEXT, POSITIONS), expected)


def test_it_knows_the_names_of_its_numbers_and_its_rate(run_folder: Path, tmp_path: Path) -> None:
    """The demonstrations' names, also after other episodes and after each export and back."""
    spec = sim.make("reach").spec
    expected = (spec.action_names, spec.proprio_names, spec.control_hz)
    export.run(run_folder, tmp_path / "lerobot")
    export.run(tmp_path / "lerobot", tmp_path / "back", card.AEGIS)
    export.run(run_folder, tmp_path / "plain", card.AEGIS)
    for folder in (run_folder, *(tmp_path / name for name in ("lerobot", "back", "plain"))):
        for own in (load_policy(folder), load_policy(folder).begin()):
            assert (own.action_names, own.state_names, own.fps) == expected


def test_an_older_checkpoint_has_neither_names_nor_rate() -> None:
    old = Path(__file__).parent / "samples" / "old_runs" / "policy-2e38d13" / "run"
    own = load_policy(old)
    assert (own.action_names, own.state_names, own.fps) == (None, None, None)


def test_positions_in_other_units_are_warned_of_once_and_acted_on(
    caplog: pytest.LogCaptureFixture,
) -> None:
    own = deployed(recorded={"proprio_names": ["pan.pos", "lift.pos", "grip.pos"]})
    own.select_action(frame(), TEXT, POSITIONS)
    assert not caplog.records
    for _ in range(3):
        assert own.select_action(frame(), TEXT, [0.1, -2000.0, 0.2]).shape == (2,)
        own.reset()
    (record,) = caplog.records
    assert record.levelname == "WARNING" and "lift.pos' is -2000" in record.message
    assert "training mean -0.2, standard deviation 0.5" in record.message
    own.begin().select_action(frame(), TEXT, [0.1, -2000.0, 0.2])
    assert len(caplog.records) == 2


def test_a_run_knows_how_far_a_joint_ever_was_that_hardly_ever_moved(
    tiny_folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A gripper that closed in one frame of hundreds is far from its mean whenever it closes."""
    rng = np.random.default_rng(0)
    state = rng.normal(size=(3, 100, 3)).astype(np.float32)
    state[:, :, 2] = 0.0
    state[:, 7, 2] = 100.0
    shown = {"top": np.zeros((100, 16, 16, 3), np.uint8)}
    made = [lerobot.write.NewEpisode(shown, one, one[:, :2], TEXT) for one in state]
    made += [lerobot.write.NewEpisode(shown, state[0] * [1, 1, 0], state[0, :, :2], TEXT)] * 3
    demos = lerobot.save(tmp_path / "demos", made)
    run = tmp_path / "run"
    train.run(recipe(tiny_folder, steps=1, validation_share=0.2), "naive", demos, None, run)
    export.run(run, tmp_path / "lerobot")
    for folder in (run, tmp_path / "lerobot"):
        own = load_policy(folder)
        own.select_action(frame(), TEXT, [0.0, 0.0, 100.0])
        assert not caplog.records
        own.select_action(frame(), TEXT, [0.0, 0.0, 4096.0])
        assert "'z' is 4096" in caplog.text
        caplog.clear()


def test_an_empty_picture_of_a_runs_policy_is_refused(run_folder: Path) -> None:
    own = load_policy(run_folder)
    with pytest.raises(AegisError, match=r"\(0, 640, 3\)"):
        own.select_action(np.zeros((0, 640, 3), np.uint8), TEXT, [0.0] * own.positions)


@pytest.mark.parametrize("task", ["reach", "point"])
def test_of_a_stream_it_is_the_policy_of_the_task(task: str, make: Any, tmp_path: Path) -> None:
    learn_stream(make("igsp"), tmp_path / "run")
    policy = robots.load_policy(tmp_path / "run", task).policy
    positions = torch.linspace(-1, 1, len(policy.proprio_scale.mean))
    expected = policy.act(
        torch.from_numpy(frame())[None], [TEXT], positions[None], torch.Generator().manual_seed(0)
    )[0]
    own = load_policy(tmp_path / "run", task=task)
    np.testing.assert_array_equal(
        own.predict_action_chunk(frame(), TEXT, positions.numpy()), expected.numpy()
    )
    assert own.task == task


@pytest.mark.parametrize("cameras", [(), ("wrist",), ("image", "image2")])
def test_of_a_stream_it_takes_a_picture_of_each_camera(
    cameras: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A single camera needs no name there either."""
    acting = Acting(make_policy().eval(), "libero/object", REPLAN, cameras)
    monkeypatch.setattr(deploy, "is_robot_stream_run", lambda _: True)
    trained = SimpleNamespace(normalization="mean_std")
    run = SimpleNamespace(
        recipe=SimpleNamespace(simulated=True, train=trained),
        policies=[acting.policy],
        acting=lambda _: acting,
        views=[{}],
    )
    monkeypatch.setattr(robots, "number_of", lambda *_: 0)
    monkeypatch.setattr(robots, "load_to_act", lambda *_: run)
    found = load_policy(tmp_path, task="libero/object")
    several = len(cameras) > 1
    assert found.cameras == (cameras if several else ())
    if several:
        with pytest.raises(AegisError, match="one picture for a policy of 2 cameras"):
            found.predict_action_chunk(frame(), TEXT, POSITIONS)


def test_actions_of_a_chunk_come_one_by_one_and_a_new_chunk_is_of_the_new_picture() -> None:
    own, other = deployed(), deployed()
    first = other.predict_action_chunk(frame(0), TEXT, POSITIONS)
    second = other.predict_action_chunk(frame(2), TEXT, POSITIONS)
    taken = [own.select_action(frame(i), TEXT, POSITIONS) for i in range(2 * REPLAN)]
    np.testing.assert_array_equal(
        np.stack(taken), np.concatenate([first[:REPLAN], second[:REPLAN]])
    )


def test_a_chunk_continues_what_the_robot_executes_meanwhile(run_folder: Path) -> None:
    """The held part is close to the old chunk, most where it is executed; the rest is free."""
    own = load_policy(run_folder, seed=3)
    free = own.predict_action_chunk(frame(), TEXT, [0.1] * own.positions)
    own.reset()
    nothing = own.predict_action_chunk(
        frame(), TEXT, [0.1] * own.positions, np.zeros((0, own.actions))
    )
    np.testing.assert_array_equal(nothing, free)
    scale = own._policy.action_scale.std.numpy()
    previous = free[2:] + 2 * scale * np.random.default_rng(0).normal(size=free[2:].shape)
    own.reset()
    with torch.inference_mode():  # a program's own inference mode makes no difference
        held = own.predict_action_chunk(
            frame(), TEXT, [0.1] * own.positions, previous=previous, delay=2
        )
    off = np.abs(held[: len(previous)] - previous) / scale
    before = np.abs(free[: len(previous)] - previous) / scale
    assert off[:2].mean() < 0.2 * before[:2].mean() and off[:2].mean() < off[-1].mean()


def test_a_policy_says_what_it_is() -> None:
    made = DeployedPolicy(make_policy().eval(), "reach", ("top", "wrist"), 2)
    assert repr(made).startswith("<policy of reach: top, wrist and ")
    assert f"{made.chunk} x {made.actions} actions, 2 of them executed" in repr(made)
    nowhere = DeployedPolicy(make_policy().eval(), None, (), 1)
    assert repr(nowhere).startswith("<policy of a robot: one picture and ")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"previous": np.zeros((2, 3))}, r"\(2, 3\)"),
        ({"previous": np.zeros(2)}, r"\(2,\)"),
        ({"previous": np.zeros((5, 2))}, r"\(5, 2\)"),
        ({"previous": np.full((2, 2), np.nan)}, "not finite"),
        ({"previous": "two"}, "actions of type str"),
        ({"previous": np.zeros((2, 2)), "delay": 3}, "a delay of 3 actions, where 2 are left"),
        ({"previous": np.zeros((2, 2)), "delay": -1}, "a delay of -1"),
        ({"previous": np.zeros((2, 2)), "delay": 0.5}, "a delay of 0.5"),
        ({"delay": 1}, "and no previous actions"),
    ],
)
def test_what_no_chunk_can_continue_is_refused(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(AegisError, match=said):
        deployed().predict_action_chunk(frame(), TEXT, POSITIONS, **changes)


@pytest.mark.parametrize(
    ("delay", "fix"), [(3, "ask for the next chunk earlier"), (-1, "count"), (2.0, "count")]
)
def test_a_delay_that_is_none_has_another_cure_than_one_that_is_too_long(
    delay: Any, fix: str
) -> None:
    with pytest.raises(AegisError) as caught:
        deployed().predict_action_chunk(
            frame(), TEXT, POSITIONS, previous=np.zeros((2, 2)), delay=delay
        )
    assert fix in caught.value.fix


def test_another_instruction_drops_the_chunk_of_the_one_before() -> None:
    """The rest of a chunk is neither executed nor continued."""
    own, other = deployed(), deployed()
    first = other.predict_action_chunk(frame(0), TEXT, POSITIONS)
    second = other.predict_action_chunk(frame(1), OTHER, POSITIONS)
    third = other.predict_action_chunk(frame(3), TEXT, POSITIONS)
    texts = (TEXT, OTHER, OTHER, TEXT, TEXT)
    taken = [own.select_action(frame(i), text, POSITIONS) for i, text in enumerate(texts)]
    np.testing.assert_array_equal(
        np.stack(taken), np.concatenate([first[:1], second[:REPLAN], third[:REPLAN]])
    )


def test_an_unknown_word_is_refused_before_a_chunk_has_ended() -> None:
    own = deployed()
    own.select_action(frame(), TEXT, POSITIONS)
    with pytest.raises(AegisError, match="xylophone"):
        own.select_action(frame(), "go to the xylophone", POSITIONS)


def test_an_episode_begins_anew_after_reset() -> None:
    own = deployed()
    first = [own.select_action(frame(i), TEXT, POSITIONS) for i in range(3)]
    own.reset()
    np.testing.assert_array_equal(
        [own.select_action(frame(i), TEXT, POSITIONS) for i in range(3)], first
    )


def test_a_picture_of_another_size_is_fitted_as_in_training() -> None:
    own, large = deployed(), np.random.default_rng(0).integers(0, 256, (90, 70, 3), np.uint8)
    size = make_policy().backbone.image_size
    expected = deployed().predict_action_chunk(fitting.fit(large, size, size), TEXT, POSITIONS)
    np.testing.assert_array_equal(own.predict_action_chunk(large, TEXT, POSITIONS), expected)


class Cameras:
    """A policy that returns the pictures it was given."""

    def __init__(self) -> None:
        inner = make_policy()
        self.proprio_scale, self.action_scale, self.expert, self.backbone = (
            inner.proprio_scale,
            inner.action_scale,
            inner.expert,
            inner.backbone,
        )
        self.seen: list[Any] = []

    def act(self, shown: Any, texts: list[str], proprio: torch.Tensor, *_: Any) -> torch.Tensor:
        self.seen.append(shown)
        return torch.zeros(1, 4, 2)


def test_pictures_of_several_cameras_come_in_the_order_of_training() -> None:
    policy = Cameras()
    own = DeployedPolicy(policy, None, ("top", "wrist"), 1)  # type: ignore[arg-type]
    own.select_action({"wrist": frame(1), "top": frame(0)}, TEXT, POSITIONS)
    ((top, wrist),) = policy.seen[0]
    np.testing.assert_array_equal(top, frame(0))
    np.testing.assert_array_equal(wrist, frame(1))


@pytest.mark.parametrize("name", ["wrist", "observation.images.wrist"])
@pytest.mark.parametrize("given", ["wrist", "observation.images.wrist", None])
def test_the_picture_of_a_single_camera_may_have_its_name(name: str, given: str | None) -> None:
    policy = Cameras()
    own = DeployedPolicy(policy, None, (name,), 1)  # type: ignore[arg-type]
    own.select_action(frame(1) if given is None else {given: frame(1)}, TEXT, POSITIONS)
    np.testing.assert_array_equal(policy.seen[0][0], frame(1))


def test_a_backbone_of_any_size_is_shown_the_sizes_of_training() -> None:
    """Each camera has its own, in later episodes too; unknown ones are shown as they are."""
    policy = Cameras()
    policy.backbone.image_size = None
    sizes = ((40, 60), (30, 30))
    pictures = {name: np.zeros((90, 70, 3), np.uint8) for name in ("top", "wrist")}
    own = DeployedPolicy(policy, None, ("top", "wrist"), 1, sizes=sizes)  # type: ignore[arg-type]
    for each in (own, own.begin()):
        each.select_action(pictures, TEXT, POSITIONS)
        ((top, wrist),) = policy.seen.pop()
        assert (top.shape[:2], wrist.shape[:2]) == sizes
    unknown = DeployedPolicy(policy, None, (), 1)  # type: ignore[arg-type]
    unknown.select_action(pictures["top"], TEXT, POSITIONS)
    assert policy.seen[0].shape[1:3] == (90, 70)


@pytest.mark.parametrize(
    ("cameras", "pictures", "positions", "told"),
    [
        ((), frame(), [0.0], ("positions of shape (1,)", "(3,)")),
        ((), frame(), [0.0, math.nan, 0.0], ("not finite", "finite numbers")),
        ((), frame(), TEXT, ("positions of type str", "instruction, positions")),
        ((), frame(), [[0.0], [0.0, 1.0]], ("positions of type list", "numbers")),
        ((), TEXT, POSITIONS, ("a picture of shape ()", "[H, W, 3] uint8")),
        ((), frame()[None], POSITIONS, ("shape (1, ", "[H, W, 3] uint8")),
        ((), frame().astype(np.float32) / 255, POSITIONS, ("float32", "0 to 255")),
        ((), frame().transpose(2, 0, 1), POSITIONS, ("shape (3, ", "channels come last")),
        ((), np.zeros((0, 64, 3), np.uint8), POSITIONS, ("shape (0, 64, 3)", "delivered a frame")),
        ((), np.zeros((64, 0, 3), np.uint8), POSITIONS, ("shape (64, 0, 3)", "one pixel")),
        ((), {"top": frame()}, POSITIONS, ("pictures of top", "one picture")),
        (("top", "wrist"), frame(), POSITIONS, ("2 cameras", "top, wrist")),
        (("top", "wrist"), {"top": frame()}, POSITIONS, ("pictures of top", "top, wrist")),
    ],
)
def test_what_it_was_not_trained_on_is_one_error(
    cameras: tuple[str, ...], pictures: Any, positions: Any, told: tuple[str, ...]
) -> None:
    """At the call that predicts, and at a call that continues a chunk."""
    begun = deployed(cameras=cameras)
    begun._ahead.append(np.zeros(2, dtype=np.float32))
    for policy in (deployed(cameras=cameras), begun):
        with pytest.raises(AegisError) as caught:
            policy.select_action(pictures, TEXT, positions)
        said = f"{caught.value.found} {caught.value.expected} {caught.value.fix}"
        assert all(part in said for part in told)


def test_state_and_text_in_each_others_place_are_one_error() -> None:
    for state in (POSITIONS, np.array(POSITIONS), torch.tensor(POSITIONS)):
        with pytest.raises(AegisError) as caught:
            deployed().select_action(frame(), state, TEXT)  # type: ignore[arg-type]
        assert caught.value.fix == "the order is: pictures, instruction, positions"


def test_unknown_words_runs_and_tasks_are_one_error(run_folder: Path, tmp_path: Path) -> None:
    with pytest.raises(AegisError, match="xylophone"):
        deployed().select_action(frame(), "go to the xylophone", POSITIONS)
    for said in (["go"], None):
        with pytest.raises(AegisError, match="an instruction of type"):
            deployed().select_action(frame(), said, POSITIONS)  # type: ignore[arg-type]
    with pytest.raises(AegisError, match="no checkpoint"):
        load_policy(tmp_path)
    with pytest.raises(AegisError, match="task 'point' for a policy of 'reach'"):
        load_policy(run_folder, task="point")


def test_actions_that_are_not_finite_are_refused() -> None:
    """A finite position can be so far off that the prediction for it is not finite."""
    own = deployed()
    for act in (own.predict_action_chunk, own.select_action):
        with pytest.raises(AegisError, match=r"8 of 8 predicted numbers .* not finite"):
            act(frame(), TEXT, [1e30] * 3)
    own.reset()
    expected = deployed().select_action(frame(), TEXT, POSITIONS)
    np.testing.assert_array_equal(own.select_action(frame(), TEXT, POSITIONS), expected)


# --- observations in one mapping ------------------------------------------------------------------

NAMES = {"action_names": ["pan.pos", "lift.pos"], "proprio_names": ["a.pos", "b.pos", "c.pos"]}


def lemotors() -> dict[str, Any]:
    """An observation as LeRobot's preprocessing passes it."""
    shown = torch.from_numpy(frame()).permute(2, 0, 1).float() / 255
    state = torch.tensor([POSITIONS])
    return {"observation.images.top": shown[None], "observation.state": state, "task": [TEXT]}


def motors() -> dict[str, Any]:
    """An observation as a robot gives it."""
    return {"top": frame(), "c.pos": POSITIONS[2], "a.pos": POSITIONS[0], "b.pos": POSITIONS[1]}


def test_lerobots_observations_and_a_robots_are_acted_on_as_pictures_text_and_positions() -> None:
    own = deployed(cameras=("observation.images.top",), recorded=NAMES)
    expected = own.predict_action_chunk(frame(), TEXT, POSITIONS)
    for given in ((lemotors(),), (lemotors() | {"task": OTHER}, TEXT), (motors(), TEXT)):
        np.testing.assert_array_equal(own.begin().predict_action_chunk(*given), expected)
        acting = own.begin()
        taken = [acting.select_action(*given) for _ in range(REPLAN)]
        np.testing.assert_array_equal(taken, expected[:REPLAN])


def test_another_task_in_the_observation_drops_the_chunk_of_the_one_before() -> None:
    own, other = deployed(cameras=("top",)), deployed()
    other.predict_action_chunk(frame(), TEXT, POSITIONS)
    expected = other.predict_action_chunk(frame(), OTHER, POSITIONS)
    own.select_action(lemotors())
    np.testing.assert_array_equal(own.select_action(lemotors() | {"task": OTHER}), expected[0])


def test_an_action_has_the_names_that_a_robot_takes() -> None:
    own = deployed(recorded=NAMES)
    assert own.named(np.array([1.5, -2.0], np.float32)) == {"pan.pos": 1.5, "lift.pos": -2.0}
    assert all(type(x) is float for x in own.named(np.zeros(2, np.float32)).values())
    with pytest.raises(AegisError, match=r"shape \(4, 2\)"):
        own.named(np.zeros((4, 2)))
    with pytest.raises(AegisError, match="names of its actions"):
        deployed().named(np.zeros(2))
    alike = deployed(recorded=NAMES | {"action_names": ["waist", "waist"]})
    with pytest.raises(AegisError, match="several actions of one name"):
        alike.named(np.zeros(2))


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ((frame(),), "no positions"),
        ((frame(), TEXT), "no positions"),
        (({"top": frame()}, TEXT), "the positions (none)"),
        ((motors(),), "no instruction"),
        ((motors() | {"b.pos": math.nan}, TEXT), "not finite"),
        ((motors() | {"wrist": frame(), "elbow.pos": 1.0}, TEXT), "the positions"),
        ((motors() | {"top": frame()[0]}, TEXT), "a picture of shape (64, 3)"),
        ((lemotors() | {"observation.state": POSITIONS[:2]},), "positions of shape (2,)"),
        ((lemotors() | {"task": "go to the xylophone"},), "xylophone"),
    ],
)
def test_an_observation_that_does_not_fit_is_one_error(given: Any, told: str) -> None:
    """At the call that predicts, and at a call that continues a chunk."""
    begun = deployed(cameras=("top",), recorded=NAMES)
    begun.select_action(motors(), TEXT)
    for policy in (deployed(cameras=("top",), recorded=NAMES), begun):
        with pytest.raises(AegisError) as caught:
            policy.select_action(*given)
        assert told in str(caught.value)


# --- a temporal ensemble --------------------------------------------------------------------------


def test_an_ensemble_averages_what_was_predicted_for_each_step() -> None:
    """Compared with a plain sum of ACT's weights; a new policy or episode starts anew."""
    decay, steps = 0.3, 7
    own, plain = deployed(ensemble=decay), deployed()
    chunks = [plain.predict_action_chunk(frame(i % 3), TEXT, POSITIONS) for i in range(steps)]
    for acting in (own, own.begin(), own):
        acting.reset()
        for step in range(steps):
            found = acting.select_action(frame(step % 3), TEXT, POSITIONS)
            first = max(0, step - own.chunk + 1)
            told = [chunks[at][step - at].astype(np.float64) for at in range(first, step + 1)]
            weights = [math.exp(-decay * i) for i in range(len(told))]
            expected = sum(w * a for w, a in zip(weights, told, strict=True)) / sum(weights)
            np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
            assert found.dtype == np.float32
    assert (own.replan, own.ensemble, plain.replan, plain.ensemble) == (1, decay, REPLAN, None)


def test_another_instruction_begins_the_ensemble_anew() -> None:
    own, other = deployed(ensemble=0.0), deployed()
    chunks = [other.predict_action_chunk(frame(), text, POSITIONS) for text in (TEXT, TEXT, OTHER)]
    for text in (TEXT, TEXT):
        own.select_action(frame(), text, POSITIONS)
    np.testing.assert_array_equal(own.select_action(frame(), OTHER, POSITIONS), chunks[2][0])


def test_the_decay_of_a_run_is_its_recipes_or_the_one_asked_for(
    tiny_folder: Path, demos_file: Path, tmp_path: Path
) -> None:
    """This holds after each export and back."""
    chosen = recipe(tiny_folder, steps=2)
    chosen = replace(chosen, rollout=replace(chosen.rollout, replan=1, ensemble=0.25))
    train.run(chosen, "naive", demos_file, None, tmp_path / "run")
    export.run(tmp_path / "run", tmp_path / "lerobot")
    export.run(tmp_path / "lerobot", tmp_path / "back", card.AEGIS)
    for folder in ("run", "lerobot", "back"):
        assert load_policy(tmp_path / folder).ensemble == 0.25
        asked = load_policy(tmp_path / folder, ensemble=0.5)
        assert (asked.ensemble, asked.replan) == (0.5, 1)
    config = json.loads((tmp_path / "lerobot" / "config.json").read_text())
    assert (config["temporal_ensemble_coeff"], config["n_action_steps"]) == (0.25, 1)
    report = rollout.run(tmp_path / "run", None, 1, "seen", keep=True)
    kept = json.loads((tmp_path / "run/results/rollout-seen.json").read_text())
    assert kept["settings"]["ensemble"] == 0.25 and report.episodes == 1


def test_a_run_has_no_ensemble_by_itself(run_folder: Path) -> None:
    own = load_policy(run_folder)
    assert own.ensemble is None and own.replan > 1
    assert load_policy(run_folder, ensemble=0.0).ensemble == 0.0
    with pytest.raises(AegisError, match="decay nan"):
        load_policy(run_folder, ensemble=math.nan)


# --- precision ------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["cpu", "cuda"])
@pytest.mark.parametrize("multiplies", [False, True])
def test_a_policy_acts_in_bf16_by_itself_only_on_a_gpu_that_has_it(
    kind: str, multiplies: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The processor's features do not decide what a policy answers."""
    monkeypatch.setattr(devices, "multiplies_bf16", lambda _: multiplies)
    device = torch.device(kind)
    found = devices.acting_precision(device, "auto")
    assert found == ("bf16" if kind == "cuda" and multiplies else "float32")
    for wanted in ("bf16", "float32"):
        assert devices.acting_precision(device, wanted) == wanted
    with pytest.raises(AegisError, match="the precision 'half'"):
        devices.acting_precision(device, "half")


def test_what_a_policy_answers_in_bf16_is_nearly_what_it_answers_in_float32(
    run_folder: Path,
) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    found = {}
    for precision in ("auto", "float32", "bf16"):
        policy = load_policy(run_folder, precision=precision)
        found[precision] = policy.predict_action_chunk(picture, "go to the red pad", [0.1] * 6)
    np.testing.assert_array_equal(found["auto"], found["float32"])
    assert found["bf16"].dtype == np.float32 and (found["bf16"] != found["float32"]).any()
    spread = found["float32"].std()
    assert np.abs(found["bf16"] - found["float32"]).max() < 0.1 * spread


def test_policies_of_the_same_weights_act_one_after_the_other(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A backbone's hooks would record the reads of two simultaneous passes as one."""
    policy, at_once, most = deployed(), [], []
    act = policy._policy.act

    def noting(*given: Any) -> torch.Tensor:
        at_once.append(given)
        most.append(len(at_once))
        time.sleep(0.02)
        found = act(*given)
        at_once.pop()
        return found

    monkeypatch.setattr(policy._policy, "act", noting)
    robots = [policy.begin() for _ in range(3)]
    with ThreadPoolExecutor(3) as threads:
        found = [
            threads.submit(robot.predict_action_chunk, frame(), TEXT, POSITIONS) for robot in robots
        ]
    first, *others = (one.result() for one in found)
    assert most == [1, 1, 1] and all(np.array_equal(first, other) for other in others)
