"""An observation in one mapping: what is read from LeRobot's, and from a robot's own."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from aegis_cli.common.errors import AegisError
from aegis_cli.data.lerobot import observation

CAMERAS, JOINTS = ("observation.images.top", "wrist"), ("pan.pos", "lift.pos", "gripper.pos")
TOP = np.random.default_rng(0).integers(0, 256, (6, 8, 3), np.uint8)
WRIST = 255 - TOP
STATE = np.array([1.5, -2.0, 3.0], np.float32)


def tensor(shown: np.ndarray) -> torch.Tensor:
    """The picture as LeRobot's own preprocessing passes it."""
    return torch.from_numpy(shown).permute(2, 0, 1).float() / 255


def lerobots(**changes: Any) -> dict[str, Any]:
    found = {
        "observation.images.wrist": WRIST,
        "observation.images.top": TOP,
        "observation.state": STATE,
        "task": "pick",
    }
    return found | changes


def robots(**changes: Any) -> dict[str, Any]:
    motors = {name: float(x) for name, x in zip(reversed(JOINTS), reversed(STATE), strict=True)}
    return motors | {"wrist": WRIST, "top": TOP} | changes


def check(found: observation.Observed, task: str | None) -> None:
    assert found.pictures.keys() == set(CAMERAS) and found.task == task
    np.testing.assert_array_equal(found.pictures[CAMERAS[0]], TOP)
    np.testing.assert_array_equal(found.pictures[CAMERAS[1]], WRIST)
    np.testing.assert_array_equal(found.positions, STATE)


@pytest.mark.parametrize(
    "shown",
    [
        lambda x: x,
        lambda x: x[None],
        tensor,
        lambda x: tensor(x)[None],
        lambda x: tensor(x).numpy(),
        lambda x: tensor(x).to(torch.float64),
        lambda x: torch.from_numpy(x),
        lambda x: torch.from_numpy(x).permute(2, 0, 1),
    ],
)
def test_each_form_of_a_picture_is_the_same_bytes(shown: Any) -> None:
    given = {f"observation.images.{n}": shown(x) for n, x in (("top", TOP), ("wrist", WRIST))}
    check(observation.read(lerobots(**given), CAMERAS, None), "pick")


@pytest.mark.parametrize("state", [STATE, STATE[None], torch.tensor(STATE)[None], STATE.tolist()])
@pytest.mark.parametrize("task", ["pick", ["pick"], ("pick",)])
def test_a_batch_of_one_is_the_one(state: Any, task: Any) -> None:
    given = lerobots(**{"observation.state": state, "task": task})
    check(observation.read(given, CAMERAS, JOINTS), "pick")


def test_what_else_a_datasets_frame_has_is_ignored() -> None:
    other = {"action": STATE, "timestamp": torch.tensor(0.1), "observation.effort": STATE}
    check(observation.read(lerobots(**other), CAMERAS, JOINTS), "pick")


def test_what_a_robot_gives_is_put_in_the_order_of_the_policy() -> None:
    check(observation.read(robots(), CAMERAS, JOINTS), None)
    of_arrays = robots(**{"pan.pos": np.array([1.5]), "lift.pos": torch.tensor(-2.0), "task": "go"})
    check(observation.read(of_arrays, CAMERAS, JOINTS), "go")


@pytest.mark.parametrize("task", [None, "", " ", ["a", "b"]])
def test_no_text_is_no_task(task: Any) -> None:
    assert observation.read(robots(task=task or ""), CAMERAS, JOINTS).task is None
    assert observation.read(lerobots(task=task), CAMERAS, JOINTS).task is None


@pytest.mark.parametrize("key", ["observation.images.any", "observation.image"])
def test_the_only_picture_of_a_policy_without_names_may_have_any(key: str) -> None:
    found = observation.read({key: TOP, "observation.state": STATE}, (), None)
    np.testing.assert_array_equal(found.pictures, TOP)


@pytest.mark.parametrize("given", [robots(side=TOP), lerobots(**{"observation.images.side": TOP})])
def test_a_robot_may_have_more_cameras_than_the_policy(given: dict[str, Any]) -> None:
    found = observation.read(given, ("top", "wrist"), JOINTS)
    assert sorted(found.pictures) == ["top", "wrist"]
    assert np.array_equal(found.pictures["top"], observation.picture("top", TOP))


def without(given: dict[str, Any], *names: str) -> dict[str, Any]:
    return {name: value for name, value in given.items() if name not in names}


@pytest.mark.parametrize(
    ("given", "fix"),
    [
        (without(robots(), "wrist"), "add wrist"),
        (without(robots(), "lift.pos", "top"), "add top, lift.pos"),
        (robots(**{"elbow.pos": 1.0}), "leave out or rename elbow.pos"),
        (
            without(robots(**{"lift": 1.0}), "lift.pos"),
            "add lift.pos; leave out or rename lift",
        ),
        (without(robots(side=TOP), "top"), "add top; leave out or rename side"),
        (without(lerobots(), "observation.images.top"), "add top"),
        (lerobots(top=TOP), "give each camera once"),
    ],
)
def test_missing_and_other_names_are_one_error_with_both_lists(
    given: dict[str, Any], fix: str
) -> None:
    cameras = ("top", "wrist")
    with pytest.raises(AegisError) as caught:
        observation.read(given, cameras, JOINTS)
    assert caught.value.fix == fix
    positions = ["observation.state"] if "observation.state" in given else JOINTS
    assert caught.value.expected == (
        f"the cameras top, wrist and the positions {', '.join(positions)}"
    )
    for name in without(given, "task", "observation.state"):
        assert name.removeprefix("observation.images.") in caught.value.found


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (robots(), "does not know the names of its positions"),
        (without(lerobots(), "observation.state"), "'observation.state' in the observation"),
    ],
)
def test_a_policy_without_names_wants_the_state(given: dict[str, Any], told: str) -> None:
    with pytest.raises(AegisError, match=told):
        observation.read(given, CAMERAS, None)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (tensor(TOP) * 255, r"from 0 to 2\d\d"),
        (tensor(TOP) - 0.5, r"from -0\.5"),
        (tensor(TOP) * float("nan"), "from nan"),
        (TOP / 255, r"shape \(6, 8, 3\) and type float64"),
        (torch.stack([tensor(TOP)] * 2), r"shape \(2, 3, 6, 8\)"),
        (np.zeros((3, 0, 8), np.float32)[:, :0, :, None], r"shape \(3, 0, 8, 1\)"),
        ([[1], [1, 2]], "not an array"),
    ],
)
def test_other_floats_than_lerobots_are_no_picture(given: Any, told: str) -> None:
    with pytest.raises(AegisError, match=told):
        observation.read(lerobots(**{"observation.images.top": given}), CAMERAS, JOINTS)


@pytest.mark.parametrize("value", [None, np.zeros(2), object()])
def test_a_motor_that_gives_no_number_is_named(value: Any) -> None:
    with pytest.raises(AegisError, match=r"'lift\.pos' is \w+"):
        observation.read(robots(**{"lift.pos": value}), CAMERAS, JOINTS)


@pytest.mark.parametrize(
    ("value", "told"),
    [
        (None, "'top' is NoneType"),  # as from a camera that has no frame yet
        (Image.fromarray(TOP), "'top' is Image"),
        (TOP.reshape(-1), r"'top' is ndarray of shape \(144,\)"),  # as from a compressed one
        ("frame.png", "'top' is str"),
    ],
)
def test_a_camera_that_gives_no_picture_is_named(value: Any, told: str) -> None:
    with pytest.raises(AegisError, match=told) as caught:
        observation.read(robots(top=value), CAMERAS, JOINTS)
    assert "np.asarray(image)" in caught.value.fix


@pytest.mark.parametrize(
    ("state", "given", "wanted"),
    [
        (("observation.ee",), {"observation.ee": STATE, "observation.state": -STATE}, STATE),
        (("observation.ee",), {"observation.state": STATE}, STATE),  # as in a robot's own program
        (
            ("observation.state", "observation.ee"),
            {"observation.ee": torch.tensor([[7.0]]), "observation.state": torch.tensor(STATE)},
            [*STATE, 7.0],
        ),
        (("observation.state", "observation.ee"), {"observation.state": STATE}, STATE),
    ],
)
def test_the_features_that_training_read_are_read_where_all_are_there(
    state: tuple[str, ...], given: dict[str, Any], wanted: Any
) -> None:
    shown = without(lerobots(), "observation.state") | given
    found = observation.read(shown, CAMERAS, None, state)
    np.testing.assert_array_equal(found.positions, np.asarray(wanted, np.float32))
