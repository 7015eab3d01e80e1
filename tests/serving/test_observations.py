"""The keys of an observation: a policy's cameras by their short names, and the state."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from samples.serving import TEXT, deployed, observation

from aegis_cli.common.errors import AegisError
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
    """That of every policy with one camera, which clients know, and its own."""
    seen = observation()
    picture = seen.pop("observation/image")
    found = Reader(deployed(cameras=("observation.images.wrist",))).read(seen | {key: picture})
    np.testing.assert_array_equal(found.pictures, picture)


@pytest.mark.parametrize("missing", ["observation/wrist", "observation/state", "prompt"])
def test_a_missing_key_is_named_with_those_that_are_there(missing: str) -> None:
    seen = several()
    del seen[missing]
    with pytest.raises(AegisError) as caught:
        Reader(deployed(cameras=CAMERAS)).read(seen)
    assert f"no '{missing}'" in caught.value.found and "observation/top" in caught.value.found
    assert all(f"'{key}'" in caught.value.expected for key in several())


def test_other_keys_are_ignored() -> None:
    seen = observation() | {"observation/wrist_image": 1, "extra": None}
    assert Reader(deployed()).read(seen).prompt == TEXT
