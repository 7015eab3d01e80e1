"""Augmented frames: torchvision's arithmetic, LeRobot's ranges, and draws that follow a seed."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from aegis_cli.data import augment
from aegis_cli.recipes.policy import AUGMENTATIONS

# The pixel in row 2, column 3 after torchvision 0.28's changes.
REFERENCE = {
    "brightness": ((1.2,), (0.80309, 0.97051, 0.60076)),
    "contrast": ((0.8,), (0.66194, 0.77356, 0.52706)),
    "saturation": ((1.5,), (0.63794, 0.84721, 0.38503)),
    "hue": ((-0.05,), (0.76168, 0.80876, 0.50064)),
    "sharpness": ((0.5,), (0.65563, 0.75200, 0.53445)),
    "affine": ((5.0, 1, -1), (0.89871, 0.34248, 0.97011)),
}
NEUTRAL = {"hue": (0.0,), "affine": (0.0, 0, 0)}


def image(height: int = 5, width: int = 6) -> Tensor:
    return (torch.arange(3 * height * width).float() * 0.37).sin().abs().view(3, height, width)


def frames(count: int) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.randint(0, 256, (count, 40, 40, 3), dtype=torch.uint8, generator=generator)


def test_a_recipe_may_name_every_transformation() -> None:
    assert tuple(augment.TRANSFORMATIONS) == AUGMENTATIONS


@pytest.mark.parametrize("name", AUGMENTATIONS)
def test_a_transformation_is_torchvisions(name: str) -> None:
    arguments, expected = REFERENCE[name]
    found = getattr(augment, name)(image(), *arguments)[:, 2, 3]
    assert found.tolist() == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("name", AUGMENTATIONS)
def test_the_neutral_value_changes_nothing(name: str) -> None:
    for tried in (image(), torch.zeros(3, 4, 4), torch.full((3, 2, 2), 0.3)):
        found = getattr(augment, name)(tried, *NEUTRAL.get(name, (1.0,)))
        assert torch.allclose(found, tried, atol=1e-6)


@pytest.mark.parametrize("name", AUGMENTATIONS)
def test_what_is_drawn_stays_an_image_and_varies(name: str) -> None:
    given = frames(8)
    found = augment.augmented(given, range(8), [name], 1, seed=0, step=0)
    assert found.shape == given.shape and found.dtype == torch.uint8
    # A small turn without a shift may leave a small picture as it is.
    assert sum(not torch.equal(*pair) for pair in zip(given, found, strict=True)) >= 7
    same = given[:1].expand(8, -1, -1, -1)
    each = augment.augmented(same, range(8), [name], 1, seed=0, step=0)
    assert len({one.numpy().tobytes() for one in each}) > 4


def test_draws_follow_from_seed_step_and_frame_alone() -> None:
    given, names = frames(6), AUGMENTATIONS
    whole = augment.augmented(given, range(6), names, 3, seed=1, step=2)
    half = augment.augmented(given[3:], range(3, 6), names, 3, seed=1, step=2)
    assert torch.equal(whole[3:], half)
    for seed, step in ((2, 2), (1, 3)):
        assert not torch.equal(whole, augment.augmented(given, range(6), names, 3, seed, step))


def test_a_frame_that_comes_again_in_a_step_is_drawn_for_anew() -> None:
    given, numbers = frames(1).expand(3, -1, -1, -1), [7, 7, 7]
    alone = augment.augmented(given[:1], [7], AUGMENTATIONS, 3, seed=1, step=2)
    found = augment.augmented(given, numbers, AUGMENTATIONS, 3, 1, 2, augment.earlier(numbers))
    assert torch.equal(found[:1], alone)
    assert len({one.numpy().tobytes() for one in found}) == 3
    assert augment.earlier([4, 5, 4, 4, 5]) == [0, 0, 1, 2, 1]


def test_cameras_are_drawn_for_by_themselves() -> None:
    given = frames(2)
    several = [(given[0], given[0]), (given[1], given[1])]
    found = augment.augmented(several, [4, 5], AUGMENTATIONS, 3, seed=0, step=0)
    assert all(isinstance(one, tuple) and not torch.equal(*one) for one in found)


def test_no_more_are_applied_than_are_named() -> None:
    found = augment.augmented(frames(2), [0, 1], ["brightness"], 3, seed=0, step=0)
    assert torch.equal(found, augment.augmented(frames(2), [0, 1], ["brightness"], 1, 0, 0))


def test_the_global_generator_is_left_alone() -> None:
    before = torch.get_rng_state()
    augment.augmented(frames(2), [0, 1], AUGMENTATIONS, 3, seed=0, step=0)
    assert torch.equal(before, torch.get_rng_state())
