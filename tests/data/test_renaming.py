"""Demonstrations with other names equal those with the policy's names once they are renamed."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from samples.lerobot import STATE, episodes, otherwise, save
from samples.sets import part

from aegis_cli.common.errors import AegisError
from aegis_cli.data import demonstrations, mixture, renaming
from aegis_cli.data.demonstrations import Demonstrations
from aegis_cli.data.renaming import Renaming
from aegis_cli.data.selection import Selection

pytestmark = pytest.mark.usefixtures("frame_cache")

TOP, OVERHEAD = "observation.images.top", "observation.images.overhead"
# Every kind of name: a camera, a feature of numbers, joints of positions and of actions.
OTHERS = {TOP: OVERHEAD, "action": "target", "x": "main_x", "dy": "main_dy"}
BACK = tuple((new, old) for old, new in OTHERS.items())


@pytest.fixture
def known(tmp_path: Path) -> Path:
    return save(tmp_path / "known", episodes(4, ("top", "wrist")))


@pytest.fixture
def other(known: Path, tmp_path: Path) -> Path:
    """The same frames under other names."""
    return otherwise(known, tmp_path / "other", OTHERS)


def load(path: Path | tuple[Path, ...], rename: Renaming, **chosen: str) -> Demonstrations:
    return mixture.load(path, 0.3, 0, Selection(**{"camera": "top", **chosen}, rename=rename))


def assert_alike(one: Demonstrations, two: Demonstrations) -> None:
    frames = torch.arange(len(one.episode_of))
    here, there = one.batch(frames, 3), two.batch(frames, 3)
    for name in ("images", "proprio", "actions", "is_pad"):
        assert torch.equal(torch.as_tensor(getattr(here, name)), getattr(there, name))
    assert (one.cameras, one.recorded) == (two.cameras, two.recorded)
    assert one.cameras == (TOP,) and one.proprio_names == STATE


def refused(path: Path | tuple[Path, ...], rename: Renaming, **chosen: str) -> AegisError:
    with pytest.raises(AegisError) as caught:
        load(path, rename, **chosen)
    return caught.value


@pytest.mark.parametrize("name", [OVERHEAD, "overhead"])
@pytest.mark.parametrize("new", [TOP, "top"])
@pytest.mark.parametrize("chosen", [TOP, "top"])
def test_renamed_names_are_read_as_the_policys_are(
    known: Path, other: Path, name: str, new: str, chosen: str
) -> None:
    rename = ((name, new), *BACK[1:])
    assert_alike(load(other, rename, camera=chosen), load(known, (), camera=chosen))


def test_a_renamed_camera_keeps_the_name_that_lerobot_gives_it(other: Path) -> None:
    found = load(other, (("overhead", "observation.image"), *BACK[1:]), camera="observation.image")
    assert found.cameras == ("observation.image",)


def test_a_set_of_other_names_joins_the_first_by_a_renaming(known: Path, other: Path) -> None:
    assert "no camera 'top'" in refused((known, other), ()).found
    both, twice = load((known, other), BACK), load(known, ())
    assert both.cameras == twice.cameras and both.recorded == twice.recorded
    count = len(twice.episode_of)
    for frame in (0, count - 1):
        one, two = (both.batch(torch.tensor([frame + at]), 3) for at in (0, count))
        assert torch.equal(torch.as_tensor(one.images), torch.as_tensor(two.images))
        assert torch.equal(one.actions, two.actions)


def test_names_change_places_at_once(known: Path) -> None:
    swapped = load(known, (("top", "wrist"), ("wrist", "top"), ("x", "y"), ("y", "x")))
    assert swapped.proprio_names == ("y", "x", "z")
    wrist = load(known, (), camera="wrist")
    assert torch.equal(torch.as_tensor(swapped.frames[0][:]), torch.as_tensor(wrist.frames[0][:]))
    assert swapped.cameras == (TOP,)


def test_the_digest_is_that_of_the_files(known: Path, other: Path) -> None:
    """A run recognises its data whatever names a later command gives it."""
    plain = Selection(OVERHEAD, action="target")
    assert load(other, BACK).sha256 == mixture.digest(other, plain)
    assert mixture.digest(other, Selection("top", rename=BACK)) == mixture.digest(other, plain)


def test_joints_of_a_file_are_renamed(demos_file: Path, tmp_path: Path) -> None:
    parts = tuple(part(demos_file, tmp_path / f"{n}.safetensors", n, n + 2) for n in (0, 2))
    own = demonstrations.load(demos_file, 0.3, 0)
    first = own.action_names[0]
    both = mixture.load(parts, 0.5, 0, Selection(rename=((first, "main"),)))
    assert both.action_names == ("main", *own.action_names[1:])
    assert both.proprio_names == own.proprio_names


@pytest.mark.parametrize(
    ("rename", "told"),
    [
        ((("wrist", "top"),), ("observation.images.top' and 'observation.images.wrist'", TOP)),
        ((("observation.state", "action"),), ("'observation.state' and 'action'", "action")),
        ((("x", "y"),), ("'x' and 'y'", "which both become 'y'")),
        ((("dx", "dy"),), ("'dx' and 'dy'", "which both become 'dy'")),
    ],
)
def test_two_of_one_name_are_refused(known: Path, rename: Renaming, told: tuple[str, str]) -> None:
    error = refused(known, rename)
    assert all(text in error.found for text in (*told, str(known)))
    assert rename[0][0] in error.fix


def test_a_name_that_no_set_has_is_refused(known: Path, other: Path, demos_file: Path) -> None:
    error = refused((known, other), (*BACK, ("cam_0", "top")))
    assert "'cam_0'" in error.found and f"'{known}' and '{other}'" in error.found
    for name in ("overhead", OVERHEAD, "wrist", "target", "main_x", "dx", "z"):
        assert name in error.expected
    with pytest.raises(AegisError, match="'cam_0' in demos.rename"):
        mixture.load(demos_file, 0.3, 0, Selection(rename=(("cam_0", "top"),)))


def test_a_camera_that_was_renamed_is_asked_for_by_the_policys_name(other: Path) -> None:
    error = refused(other, BACK, camera="overhead")
    assert "no camera 'overhead'" in error.found and TOP in error.expected
    assert OVERHEAD not in error.expected
    with pytest.raises(AegisError, match=r"2 cameras: .*images\.top"):
        mixture.load(other, 0.3, 0, Selection(rename=BACK))


def test_sets_that_do_not_agree_are_told_how_to(known: Path, other: Path) -> None:
    """This applies to cameras and to joints."""
    rename = tuple(pair for pair in BACK if pair[1] != "x")
    assert "demos.rename" in refused((known, other), rename).fix
    one = save(known.parent / "one", episodes(3, ("side",)))
    two = save(known.parent / "two", episodes(3, ("top",)))
    with pytest.raises(AegisError) as caught:
        mixture.load((two, one), 0.3, 0)
    assert "demos.rename={ITS NAME: NAME}" in caught.value.fix
    assert mixture.load((two, one), 0.3, 0, Selection(rename=(("side", "top"),))).cameras == (TOP,)


def test_a_recipes_mapping_is_a_renaming() -> None:
    assert renaming.of({"a": "b", "c": "d"}) == (("a", "b"), ("c", "d"))
    assert renaming.of(None) == renaming.of({}) == ()
