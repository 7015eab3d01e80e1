"""Several sets of demonstrations as one: their frames, their scale, and what has to agree."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from samples.lerobot import edit_info, episodes, save
from samples.own_robots import robot
from samples.sets import halves, part

from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, Warned
from aegis_cli.data import demonstrations, mixture, record
from aegis_cli.data.demonstrations import Demonstrations
from aegis_cli.data.lerobot.on_demand import FramesOnDemand
from aegis_cli.data.selection import Selection

EPISODES = 8  # of the file that these tests have
pytestmark = pytest.mark.usefixtures("frame_cache")


def refused(
    paths: tuple[Path, ...], selection: Selection = Selection(), share: float = 0.3
) -> AegisError:
    with pytest.raises(AegisError) as caught:
        mixture.load(paths, share, 0, selection)
    return caught.value


def assert_alike(one: Demonstrations, other: Demonstrations, frames: torch.Tensor) -> None:
    """Batches of these frames are equal, bit for bit."""
    here, there = one.batch(frames, 4), other.batch(frames, 4)
    assert torch.equal(torch.as_tensor(here.images), torch.as_tensor(there.images))
    assert here.instructions == there.instructions
    for name in ("proprio", "actions", "is_pad"):
        assert torch.equal(getattr(here, name), getattr(there, name))


# --- what they are together -----------------------------------------------------------------------


def test_one_set_alone_is_that_set(demos_file: Path) -> None:
    one, other = mixture.load((demos_file,), 0.3, 0), demonstrations.load(demos_file, 0.3, 0)
    assert one.sha256 == other.sha256 and one.members == ()
    assert torch.equal(one.train, other.train) and torch.equal(one.validation, other.validation)
    assert mixture.digest(demos_file) == demonstrations.digest(demos_file)
    assert mixture.inputs(one) == {"demos": other.sha256}


def test_two_halves_are_the_whole(demos_file: Path, tmp_path: Path) -> None:
    both = mixture.load(halves(demos_file, tmp_path, EPISODES), None, 0)
    whole = demonstrations.load(demos_file, None, 0)
    assert torch.equal(both.validation, whole.validation)
    assert torch.equal(both.episode_of, whole.episode_of)
    assert both.texts == whole.texts and both.recorded == whole.recorded
    assert (both.task, both.fps) == (whole.task, whole.fps)
    shuffled = torch.randperm(len(whole.episode_of), generator=torch.Generator().manual_seed(0))
    assert_alike(both, whole, shuffled)


def test_the_scale_is_that_of_all_training_frames(demos_file: Path, tmp_path: Path) -> None:
    parts = halves(demos_file, tmp_path, EPISODES)
    both, apart = mixture.load(parts, 0.3, 0), [demonstrations.load(p, 0.3, 0) for p in parts]
    rows = torch.cat([own.tensors["actions"][own.train] for own in apart]).double()
    _, action = both.scales()
    torch.testing.assert_close(action.mean.double(), rows.mean(0))
    torch.testing.assert_close(action.std.double(), rows.std(0, correction=0))


@pytest.mark.parametrize("seed", range(3))
def test_each_set_holds_out_what_it_would_alone(
    demos_file: Path, tmp_path: Path, seed: int
) -> None:
    parts = halves(demos_file, tmp_path, EPISODES)
    both, apart = mixture.load(parts, 0.3, seed), [demonstrations.load(p, 0.3, seed) for p in parts]
    begins = (0, len(apart[0].episode_of))
    for kind in ("train", "validation"):
        frames = [getattr(own, kind) + first for own, first in zip(apart, begins, strict=True)]
        assert torch.equal(getattr(both, kind), torch.cat(frames))
    assert [member.train for member in both.members] == [len(own.train) for own in apart]


def test_texts_that_sets_share_are_one(tmp_path: Path, demos_file: Path) -> None:
    parts = halves(demos_file, tmp_path, EPISODES)
    both = mixture.load(parts, 0.3, 0)
    assert len(both.instructions) == len(set(both.instructions))
    assert both.texts == list(dict.fromkeys(both.texts))


def test_the_digest_tells_sets_and_their_order_apart(demos_file: Path, tmp_path: Path) -> None:
    first, second = halves(demos_file, tmp_path, EPISODES)
    both, turned = mixture.load((first, second), 0.3, 0), mixture.load((second, first), 0.3, 0)
    assert both.sha256 == mixture.digest((first, second)) != turned.sha256
    each = [demonstrations.digest(path) for path in (first, second)]
    assert mixture.inputs(both) == {"demos": both.sha256, "demos 1": each[0], "demos 2": each[1]}
    assert mixture.digests({**mixture.inputs(both), "backbone": "x"}) == {both.sha256, *each}


def test_a_file_and_a_folder_go_together(demos_file: Path, tmp_path: Path) -> None:
    folder = tmp_path / "reach"
    record.run("reach", 3, 1, folder, form="lerobot", workers=1)
    both = mixture.load((demos_file, folder), 0.3, 0, image_size=64)
    assert both.cameras and both.task == "reach"
    alone = demonstrations.load(folder, 0.3, 0, image_size=64)
    begins = len(demonstrations.load(demos_file, 0.3, 0).episode_of)
    frames = torch.arange(len(alone.episode_of))
    here, there = both.images(frames + begins), alone.images(frames)
    assert torch.equal(torch.as_tensor(here), torch.as_tensor(there))


def test_pictures_of_another_size_are_fitted_into_the_first_sets(tmp_path: Path) -> None:
    cameras = ("top", "side")  # with the same sizes, so one warning covers all
    small = save(tmp_path / "small", episodes(3, cameras))
    large = save(tmp_path / "large", episodes(3, cameras, size=(32, 40), seed=1))
    said = list[Event]()
    both = mixture.load((small, large), 0.3, 0, Selection(cameras), on_event=said.append)
    assert both.frames[0].shape[1:] == (16, 24, 3)
    fitted = demonstrations.load(large, 0.3, 0, Selection("top")).fitted([(16, 24)])
    frames = torch.arange(len(fitted.episode_of))
    begins = len(both.episode_of) - len(frames)
    assert torch.equal(both.frames[0][frames + begins], fitted.frames[0][frames])
    warned = [event.text for event in said if isinstance(event, Warned)]
    assert len(warned) == 1 and "32 x 40" in warned[0] and str(large) in warned[0]


@pytest.mark.parametrize(("factor", "warned"), [(3.0, False), (57.3, True), (1 / 57.3, True)])
def test_sets_in_other_units_are_told(factor: float, warned: bool, tmp_path: Path) -> None:
    degrees = robot(tmp_path / "degrees")
    other = robot(tmp_path / "other", scale=factor)
    told: list[Event] = []
    mixture.load((degrees, other), 0.3, 0, on_event=told.append)
    said = [event.text for event in told if isinstance(event, Warned)]
    assert any("may be in other units" in text for text in said) == warned


def test_frames_that_stay_in_videos_are_joined(tmp_path: Path) -> None:
    # One camera with plain frames of noise, and a video of colours.
    film = save(tmp_path / "film", episodes(3, smooth=True), as_video=True)
    other = save(tmp_path / "other", episodes(3, seed=1))
    both = mixture.load((film, other), 0.3, 0, cache=False)
    assert isinstance(both.frames[0].parts[0], FramesOnDemand)
    kept = mixture.load((film, other), 0.3, 0)
    assert torch.equal(both.frames[0][both.read], kept.frames[0][kept.read])


# --- what has to agree ----------------------------------------------------------------------------


def test_the_same_set_twice_is_refused(demos_file: Path) -> None:
    assert "twice" in refused((demos_file, demos_file)).found
    again = demos_file.parent / "." / ".." / demos_file.parent.name / demos_file.name
    assert "twice" in refused((demos_file, again)).found


def test_episodes_are_chosen_of_one_set(demos_file: Path, tmp_path: Path) -> None:
    error = refused(halves(demos_file, tmp_path, EPISODES), Selection(only="0-2"))
    assert error.found == "demos.only: 0-2 with 2 sets of demonstrations"


def test_a_set_too_small_to_hold_one_out_is_named(demos_file: Path, tmp_path: Path) -> None:
    one = part(demos_file, tmp_path / "one.safetensors", 3, 4)
    assert str(one) in refused((demos_file, one)).found


def renamed(feature: str, names: Sequence[str]) -> Callable[[dict], None]:
    def edit(info: dict) -> None:
        info["features"][feature]["names"] = list(names)

    return edit


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (renamed("action", ["dy", "dx"]), ("'dx' in another place", "dx, dy, in this order")),
        (renamed("action", ["dx", "grip"]), ("actions named dx, grip", "dx, dy, as in")),
        (
            renamed("observation.state", ["x", "z", "y"]),
            ("'y' in another place", "x, y, z, in this order"),
        ),
        (lambda info: info.update(fps=25), ("25 frames a second", "10, as in")),
    ],
)
def test_a_set_of_another_robot_is_named_with_what_was_expected(
    edit: Callable[[dict], None], said: tuple[str, str], tmp_path: Path
) -> None:
    known, other = (save(tmp_path / name, episodes(3)) for name in ("known", "other"))
    edit_info(other, edit)
    error = refused((known, other))
    assert said[0] in error.found and str(other) in error.found
    assert said[1] in error.expected and str(known) in error.expected


def test_another_camera_is_refused_unless_one_is_chosen(tmp_path: Path) -> None:
    known = save(tmp_path / "known", episodes(3))
    other = save(tmp_path / "other", episodes(3, cameras=("side",)))
    two = save(tmp_path / "two", episodes(3, cameras=("side", "top"), seed=1))
    error = refused((known, other))
    assert "the camera side" in error.found and "top, as in" in error.expected
    assert str(two) in refused((known, two)).found
    assert f"no camera 'top' in '{other}'" in refused((known, other), Selection("top")).found
    both = mixture.load((known, two), 0.3, 0, Selection("top"))
    assert both.cameras == ("observation.images.top",)


def test_another_number_of_actions_is_refused(demos_file: Path, tmp_path: Path) -> None:
    other = save(tmp_path / "other", episodes(3))
    error = refused((demos_file, other))
    assert "positions and 2 actions" in error.found and str(demos_file) in error.expected


def test_what_a_set_does_not_say_is_not_compared(tmp_path: Path) -> None:
    silent, spoken = (save(tmp_path / name, episodes(3)) for name in ("silent", "spoken"))
    edit_info(silent, lambda info: info["features"]["action"].update(names=None))
    both = mixture.load((silent, spoken), 0.3, 0)
    assert both.action_names == ("dx", "dy")


# --- shares ---------------------------------------------------------------------------------------


def test_joints_that_a_set_lacks_or_has_besides_are_named(tmp_path: Path) -> None:
    made = episodes(3)
    known = save(tmp_path / "known", made)
    less = [replace(e, actions=e.actions[:, :1]) for e in made]
    other = save(tmp_path / "other", less, action_names=("dx",))
    assert "1 actions in" in refused((known, other)).found
    assert refused((known, other)).found.endswith(", without the actions dy")
    assert refused((other, known)).found.endswith(", with the actions dy besides")


def of_sizes(made: Demonstrations, sizes: Sequence[int]) -> Demonstrations:
    members = tuple(demonstrations.Member(f"set {size}", "", size) for size in sizes)
    return replace(made, members=members)


@pytest.mark.parametrize(
    ("sizes", "weights", "counts"),
    [
        ((10, 20), None, [10, 20]),
        ((10, 20), (10, 20), [10, 20]),
        ((10, 20), (2, 1), [20, 10]),
        ((10, 21), (1, 1), [16, 15]),
        ((5, 5, 5), (1, 1, 5), [2, 2, 11]),
        ((10, 20), (1e308, 1e308), [15, 15]),
    ],
)
def test_weights_are_shares_of_the_frames(
    sizes: tuple[int, ...],
    weights: tuple[float, ...] | None,
    counts: list[int],
    demos_file: Path,
) -> None:
    made = of_sizes(demonstrations.load(demos_file, 0.3, 0), sizes)
    assert mixture.drawn(made, weights) == counts
    assert sum(counts) == sum(sizes)


def test_a_weight_of_less_than_a_frame_is_refused(demos_file: Path) -> None:
    made = of_sizes(demonstrations.load(demos_file, 0.3, 0), (4, 6))
    with pytest.raises(AegisError, match="leave 'set 6' none of an epoch's 10 frames"):
        mixture.drawn(made, (100, 1))


@pytest.mark.parametrize(("weights", "sets"), [((1, 2), 3), ((1,), 1), ((1, 2), 1)])
def test_weights_are_one_for_each_of_several_sets(weights: tuple[float, ...], sets: int) -> None:
    with pytest.raises(AegisError, match=rf"demos.weights: .* with {sets} set"):
        mixture.check_weights(weights, sets)


def test_frames_are_found_by_their_numbers_in_any_order() -> None:
    parts = [
        torch.arange(n, dtype=torch.uint8)[:, None, None, None] + s for n, s in ((3, 0), (4, 50))
    ]
    both = mixture.JoinedFrames([part.expand(-1, 2, 2, 3) for part in parts])
    numbers = torch.tensor([6, 0, 3, 2, 3])
    assert both[numbers][:, 0, 0, 0].tolist() == [53, 0, 50, 2, 50]
    assert len(both) == 7 and both.shape == (7, 2, 2, 3)
    assert both[torch.tensor([], dtype=torch.int64)].shape == (0, 2, 2, 3)
    assert np.array_equal(both[numbers[::2]], both[numbers][::2])
