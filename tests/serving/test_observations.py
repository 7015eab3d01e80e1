"""The keys of an observation: a policy's cameras by their short names, and the state."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from samples.serving import TEXT, deployed, observation
from samples.training import make_policy

from aegis_cli.common.errors import AegisError
from aegis_cli.deploy import DeployedPolicy
from aegis_cli.serving.observations import Reader

CAMERAS = ("observation.images.top", "wrist")


def several(**changes: Any) -> dict[str, Any]:
    picture = observation()["observation/image"]
    keys = {
        "observation/top": picture,
        "observation/wrist": picture + 1,
        "observation/state": [1, 2, 3],
        "prompt": TEXT,
    }
    return keys | changes


def test_several_cameras_have_keys_of_their_own() -> None:
    reader = Reader(deployed(cameras=CAMERAS))
    assert reader.greeting()["images"] == ["observation/top", "observation/wrist"]
    found = reader.read(several())
    assert list(found.pictures) == list(CAMERAS) and found.prompt == TEXT
    np.testing.assert_array_equal(found.pictures["wrist"], several()["observation/wrist"])
    assert found.state.dtype == np.float32 and found.state.tolist() == [1, 2, 3]


@pytest.mark.parametrize("key", ["observation/image", "observation/wrist"])
def test_the_picture_of_a_single_camera_has_two_names(key: str) -> None:
    """The one for every policy with one camera, which clients know, and its own."""
    seen = observation()
    picture = seen.pop("observation/image")
    found = Reader(deployed(cameras=("observation.images.wrist",))).read(seen | {key: picture})
    np.testing.assert_array_equal(found.pictures, picture)


def test_a_datasets_own_name_of_a_picture_is_openpis() -> None:
    """As in lerobot/pusht."""
    assert list(Reader(deployed(cameras=("observation.image",))).images) == ["observation/image"]


@pytest.mark.parametrize("first", ["observation/image", "observation/wrist"])
def test_the_only_cameras_own_key_goes_before_the_one_of_every_policy(first: str) -> None:
    """A robot with two cameras sends its scene as `observation/image`, too."""
    seen = observation()
    scene, wrist = seen.pop("observation/image"), np.full((64, 64, 3), 7, np.uint8)
    both = {"observation/image": scene, "observation/wrist": wrist}
    ordered = {first: both[first]} | both
    found = Reader(deployed(cameras=("observation.images.wrist",))).read(ordered | seen)
    np.testing.assert_array_equal(found.pictures, wrist)


def test_the_greeting_names_numbers_and_rate_where_they_are_known() -> None:
    told = {"action_names": ["dx", "dy"], "proprio_names": ["x", "y", "z"], "fps": 12.5}
    policy = DeployedPolicy(make_policy().eval(), "reach", (), replan=2, recorded=told)
    greeting = Reader(policy).greeting()
    assert greeting["action_names"] == ["dx", "dy"] and greeting["fps"] == 12.5
    assert greeting["state_names"] == ["x", "y", "z"]
    unknown = Reader(deployed()).greeting()
    assert [unknown[key] for key in ("action_names", "state_names", "fps")] == [None] * 3


@pytest.mark.parametrize("missing", ["observation/wrist", "observation/state"])
def test_a_missing_key_is_named_with_those_that_are_there(missing: str) -> None:
    seen = several()
    del seen[missing]
    with pytest.raises(AegisError) as caught:
        Reader(deployed(cameras=CAMERAS)).read(seen)
    assert f"no '{missing}'" in caught.value.found and "observation/top" in caught.value.found
    assert all(f"'{key}'" in caught.value.expected for key in several())


@pytest.mark.parametrize("blank", ["", "  ", None])
def test_a_blank_prompt_is_none(blank: str | None) -> None:
    """The server's own prompt is used instead, if there is one."""
    policy = DeployedPolicy(make_policy().eval(), None, CAMERAS, 2, recorded=MOTORS)
    for seen in (several(), LEROBOTS | {"task": ""}, ROBOTS):
        assert Reader(policy, "hold").read(seen | {"prompt": blank}).prompt == "hold"
        with pytest.raises(AegisError, match="a blank '(prompt|task)'|no instruction"):
            Reader(policy).read(seen | {"prompt": blank})


def test_the_error_of_a_missing_key_names_what_was_sent() -> None:
    seen = observation() | {"prompt": ""}
    with pytest.raises(AegisError) as caught:
        Reader(deployed(cameras=("top",))).read(seen)
    assert "with observation/image, observation/state, prompt" in caught.value.found


def test_a_frame_of_features_that_the_policy_names_is_read() -> None:
    """For example LIBERO's datasets, whose names do not begin like LeRobot's."""
    cameras = ("image", "wrist_image")
    recorded = {"state": ["state"]}
    policy = DeployedPolicy(make_policy().eval(), None, cameras, 2, recorded=recorded)
    pictures = dict(zip(cameras, (several()["observation/top"], several()["observation/wrist"])))
    frame = pictures | {"state": [1, 2, 3], "task": TEXT}
    found = Reader(policy).read(frame)
    assert list(found.pictures) == list(cameras) and found.state.tolist() == [1, 2, 3]


def test_other_keys_are_ignored() -> None:
    seen = observation() | {"observation/wrist_image": 1, "extra": None}
    assert Reader(deployed()).read(seen).prompt == TEXT


# --- LeRobot's ------------------------------------------------------------------------------------

MOTORS = {"proprio_names": ["a.pos", "b.pos", "c.pos"]}
LEROBOTS = {
    "observation.images.top": observation()["observation/image"].transpose(2, 0, 1)[None] / 255,
    "observation.images.wrist": observation()["observation/image"] + 1,
    "observation.state": [[1, 2, 3]],
}
ROBOTS = {
    "wrist": observation()["observation/image"] + 1,
    "top": observation()["observation/image"],
} | {"c.pos": 3.0, "b.pos": 2.0, "a.pos": 1.0}


@pytest.mark.parametrize("seen", [LEROBOTS, ROBOTS])
@pytest.mark.parametrize("text", [{"task": TEXT}, {"prompt": TEXT}])
def test_lerobots_observations_and_a_robots_are_read_as_openpis(
    seen: dict[str, Any], text: dict[str, str]
) -> None:
    policy = DeployedPolicy(make_policy().eval(), None, CAMERAS, 2, recorded=MOTORS)
    found, expected = Reader(policy).read(seen | text), Reader(policy).read(several())
    for name in CAMERAS:
        np.testing.assert_array_equal(found.pictures[name], expected.pictures[name])
    assert (found.prompt, found.state.tolist()) == (TEXT, [1, 2, 3])
    assert found.state.dtype == np.float32
    assert Reader(policy, "hold").read(seen).prompt == "hold"
    # So is the observation of a robot that keeps moving meanwhile.
    left = {"previous_actions": np.ones((3, 2)), "delay": 2}
    moving = Reader(policy).read(seen | text | left)
    assert (moving.delay, moving.previous.tolist()) == (2, [[1, 1]] * 3)


def test_what_does_not_fit_is_named_by_its_camera_or_joint() -> None:
    policy = DeployedPolicy(make_policy().eval(), None, CAMERAS, 2, recorded=MOTORS)
    reader = Reader(policy)
    with pytest.raises(AegisError, match=r"a picture of .*wrist of shape \(3, 8, 8\)"):
        seen = reader.read(several() | {"observation/wrist": np.zeros((3, 8, 8), np.uint8)})
        policy.predict_action_chunk(seen.pictures, seen.prompt, seen.state)
    with pytest.raises(AegisError) as caught:
        seen = reader.read(several() | {"observation/state": np.zeros(2)})
        policy.predict_action_chunk(seen.pictures, seen.prompt, seen.state)
    assert caught.value.expected == "(3,): a.pos, b.pos, c.pos"


@pytest.mark.parametrize("seen", [LEROBOTS, ROBOTS])
def test_lerobots_observation_without_a_text_or_a_camera_is_one_error(seen: dict[str, Any]) -> None:
    policy = DeployedPolicy(make_policy().eval(), None, CAMERAS, 2, recorded=MOTORS)
    with pytest.raises(AegisError, match="no instruction"):
        Reader(policy).read(seen)
    one = {name: value for name, value in seen.items() if not name.endswith("top")}
    with pytest.raises(AegisError, match="the cameras wrist"):
        Reader(policy).read(one | {"prompt": TEXT, b"other": 1})
    unknown = {"observation.state": [[np.nan] * 3], "a.pos": np.nan}
    bad = {name: value for name, value in unknown.items() if name in seen}
    with pytest.raises(AegisError, match="positions with nan"):
        Reader(policy).read(seen | bad | {"task": TEXT})
