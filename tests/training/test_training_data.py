"""Demonstrations as batches: split by episode, chunks, padding, order and learning rates."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from samples.training_runs import small_policy

from aegis_cli.data import demonstrations
from aegis_cli.models import backbones
from aegis_cli.training import schedule

# --- splits and chunks ----------------------------------------------------------------------------


def load(demos_file: Path, share: float = 0.3, seed: int = 0) -> demonstrations.Demonstrations:
    return demonstrations.load(demos_file, share, seed)


def test_frames_are_split_by_episode(demos_file: Path) -> None:
    demos = load(demos_file)
    seen, held_out = (
        set(demos.episode_of[frames].tolist()) for frames in (demos.train, demos.validation)
    )
    assert seen and len(held_out) == round(0.3 * 8)
    assert not seen & held_out
    assert sorted([*demos.train.tolist(), *demos.validation.tolist()]) == list(
        range(len(demos.frames[0]))
    )
    splits = {tuple(load(demos_file, seed=seed).validation.tolist()) for seed in range(5)}
    assert len(splits) > 1


@pytest.mark.parametrize("share", [0.001, 0.999])
def test_neither_side_of_the_split_is_ever_empty(demos_file: Path, share: float) -> None:
    demos = load(demos_file, share)
    assert len(demos.train) and len(demos.validation)


def test_scales_come_from_the_training_frames_alone(demos_file: Path) -> None:
    demos = load(demos_file)
    before = demos.scales()
    for name in ("proprio", "actions"):
        demos.tensors[name] = demos.tensors[name].clone()
        demos.tensors[name][demos.validation] += 100
    for x, y in zip(before, demos.scales(), strict=True):
        assert torch.equal(x.mean, y.mean) and torch.equal(x.std, y.std)


def handmade() -> demonstrations.Demonstrations:
    """Episodes of 2 and 5 frames; frame i has action i."""
    starts = torch.tensor([0, 2, 7])
    actions = torch.arange(7.0)[:, None]
    pictures = torch.arange(7, dtype=torch.uint8)[:, None, None, None].expand(7, 64, 64, 3)
    tensors = {
        "proprio": actions.clone(),
        "actions": actions,
        "episode_starts": starts,
    }
    episode_of = torch.tensor([0, 0, 1, 1, 1, 1, 1])
    frames = torch.arange(7), torch.arange(0)
    return demonstrations.Demonstrations(
        "reach",
        (pictures,),
        tensors,
        ["to red", "to blue"],
        1 - episode_of,
        episode_of,
        *frames,
        "",
    )


def test_chunks_end_with_their_episode() -> None:
    batch = handmade().batch(np.array([0, 1, 2, 5]), chunk=3)
    assert batch.is_pad.tolist() == [
        [False, False, True],
        [False, True, True],
        [False] * 3,
        [False, False, True],
    ]
    valid = batch.actions.squeeze(-1)[~batch.is_pad]
    assert valid.tolist() == [0, 1, 1, 2, 3, 4, 5, 6]
    assert batch.instructions == ["to blue", "to blue", "to red", "to red"]
    assert batch.proprio.squeeze(-1).tolist() == batch.images[:, 0, 0, 0].tolist() == [0, 1, 2, 5]


@torch.no_grad()
def test_the_episode_that_follows_in_the_file_never_reaches_the_loss(
    demos_file: Path, tiny_folder: Path
) -> None:
    """Chunks at an episode's last frame are the same, whatever the next episode's actions."""
    demos, losses = load(demos_file), []
    last = int(demos.tensors["episode_starts"][1]) - 1
    backbone = backbones.load(str(tiny_folder))
    torch.manual_seed(0)
    policy = small_policy(backbone, demos)
    for change in (0.0, 100.0, 0.0):
        demos.tensors["actions"] = demos.tensors["actions"].clone()
        demos.tensors["actions"][last + 1 :] += change
        batch = demos.batch(np.array([last, last - 1]), chunk=4)
        assert batch.is_pad.any() and not batch.is_pad.all(1).any()
        encoding = policy.encode(batch.images, batch.instructions)
        losses.append(policy.flow_loss(batch, encoding, 2, torch.Generator().manual_seed(0)))
    assert losses[0] == losses[1] == losses[2]


# --- order and schedule ---------------------------------------------------------------------------


def test_every_frame_comes_once_an_epoch_and_the_rest_is_carried_over() -> None:
    order = schedule.BatchOrder(size=10, batch=4, seed=0)
    dealt = np.concatenate([order.rows(i) for i in range(10)])
    epochs = dealt.reshape(4, 10)
    assert all(sorted(epoch) == list(range(10)) for epoch in epochs.tolist())
    assert len({tuple(epoch) for epoch in epochs.tolist()}) == 4


def test_the_order_is_a_function_of_seed_and_step() -> None:
    order = schedule.BatchOrder(10, 4, seed=0)
    forwards = [order.rows(i).tolist() for i in range(8)]
    for i in (7, 0, 3):
        assert (
            order.rows(i).tolist()
            == schedule.BatchOrder(10, 4, seed=0).rows(i).tolist()
            == forwards[i]
        )
    assert forwards[0] != schedule.BatchOrder(10, 4, seed=1).rows(0).tolist()


def test_a_batch_larger_than_the_data_spans_epochs() -> None:
    rows = schedule.BatchOrder(size=3, batch=8, seed=0).rows(0)
    assert len(rows) == 8 and np.bincount(rows).min() >= 2


SHARES = [((4, 6), (4, 6)), ((4, 6), (7, 3)), ((3, 5, 2), (1, 1, 8))]


def dealt(sizes: tuple[int, ...], counts: tuple[int, ...], batch: int, steps: int) -> np.ndarray:
    order = schedule.BatchOrder(10, batch, 0, list(zip(sizes, counts, strict=True)))
    return np.concatenate([order.rows(i) for i in range(steps)])


@pytest.mark.parametrize(("sizes", "counts"), SHARES)
def test_an_epoch_has_of_each_set_what_its_share_is(
    sizes: tuple[int, ...], counts: tuple[int, ...]
) -> None:
    ends = np.cumsum(sizes)
    for epoch in dealt(sizes, counts, 4, 25).reshape(10, 10):
        assert np.bincount(np.searchsorted(ends, epoch, side="right")).tolist() == list(counts)


@pytest.mark.parametrize(("sizes", "counts"), SHARES)
def test_a_sets_frames_come_equally_often_but_for_one_time(
    sizes: tuple[int, ...], counts: tuple[int, ...]
) -> None:
    rows = dealt(sizes, counts, 4, 25)
    for own in np.split(np.bincount(rows, minlength=10), np.cumsum(sizes)[:-1]):
        assert own.max() - own.min() <= 1


def test_shares_that_are_the_sizes_change_nothing() -> None:
    plain = schedule.BatchOrder(10, 4, 0)
    assert np.array_equal(
        dealt((4, 6), (4, 6), 4, 10), np.concatenate([plain.rows(i) for i in range(10)])
    )


def test_the_order_by_shares_depends_on_no_batch_before_it() -> None:
    whole = dealt((4, 6), (7, 3), 4, 25)
    assert np.array_equal(whole, dealt((4, 6), (7, 3), 10, 10))
    late = schedule.BatchOrder(10, 4, 0, [(4, 7), (6, 3)]).rows(17)
    assert np.array_equal(late, whole[68:72])
    other = schedule.BatchOrder(10, 4, 1, [(4, 7), (6, 3)]).rows(17)
    assert not np.array_equal(late, other)
