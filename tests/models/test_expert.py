"""The action expert over grouped and rotated keys: properties that hold for any weights."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from aegis_cli.core.attention import KeyValue, Rotation, rotate
from aegis_cli.models.expert import ActionExpert, ExpertShape

HEADS, SIZE, CHUNK, PREFIX, BATCH = 4, 8, 5, 7, 3


def expert(kv_heads: int | None, seed: int = 0) -> ActionExpert:
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        shape = ExpertShape(
            depth=2,
            heads=HEADS,
            head_dim=SIZE,
            proprio=3,
            actions=2,
            chunk=CHUNK,
            width=16,
            kv_heads=kv_heads,
        )
        return ActionExpert(shape).double()


def prefix(kv_heads: int) -> list[KeyValue]:
    generator = torch.Generator().manual_seed(1)
    drawn = torch.randn(
        2, 2, BATCH, kv_heads, PREFIX, SIZE, generator=generator, dtype=torch.float64
    )
    return [KeyValue(*pair) for pair in drawn]


def ask(
    model: ActionExpert, keys: list[KeyValue], mask: object = None, rotation: Rotation | None = None
) -> Tensor:
    generator = torch.Generator().manual_seed(2)
    x = torch.randn(BATCH, 2, CHUNK, 2, generator=generator, dtype=torch.float64)
    times = torch.rand(BATCH, 2, generator=generator, dtype=torch.float64)
    proprio = torch.randn(BATCH, 3, generator=generator, dtype=torch.float64)
    seen = torch.ones(BATCH, PREFIX, dtype=torch.bool) if mask is None else mask
    return model(x, times, proprio, keys, seen, rotation)


def angles(positions: Tensor) -> Rotation:
    """[B, S] -> cosines and sines of every position, as in rotary embeddings."""
    angle = positions[..., None].double() / 100 ** (torch.arange(SIZE // 2) / (SIZE // 2))
    both = torch.cat([angle, angle], dim=-1)
    return Rotation(both.cos(), both.sin())


@pytest.mark.parametrize("kv_heads", [1, 2])
def test_grouped_queries_are_those_over_repeated_keys(kv_heads: int) -> None:
    grouped, plain, groups = expert(kv_heads), expert(None), HEADS // kv_heads
    state = grouped.state_dict()
    for name in [n for n in state if ".qkv." in n]:
        query, key, value = state[name].split([HEADS * SIZE, kv_heads * SIZE, kv_heads * SIZE])
        wide = [
            t.unflatten(0, (kv_heads, SIZE)).repeat_interleave(groups, 0).flatten(0, 1)
            for t in (key, value)
        ]
        state[name] = torch.cat([query, *wide])
    plain.load_state_dict(state)
    keys = prefix(kv_heads)
    repeated = [KeyValue(*(t.repeat_interleave(groups, 1) for t in pair)) for pair in keys]
    rotation = angles(PREFIX + torch.arange(CHUNK).expand(BATCH, -1))
    for turned in (None, rotation):
        torch.testing.assert_close(
            ask(grouped, keys, rotation=turned), ask(plain, repeated, rotation=turned)
        )


def test_only_the_distance_to_the_prefix_counts() -> None:
    """Keys rotated from position s on, followed by actions, give the same result for every s.

    With actions at other positions, the result changes.
    """
    model, plain = expert(2), prefix(2)

    def velocity(start: int, gap: int) -> Tensor:
        place = start + torch.arange(PREFIX).expand(BATCH, -1)
        turned = [KeyValue(rotate(k[:, :, None], angles(place))[:, :, 0], v) for k, v in plain]
        return ask(
            model,
            turned,
            rotation=angles(start + PREFIX + gap + torch.arange(CHUNK).expand(BATCH, -1)),
        )

    torch.testing.assert_close(velocity(0, 0), velocity(37, 0))
    assert (velocity(0, 0) - velocity(0, 1)).abs().max() > 1e-6


def test_a_rotation_turns_pairs_of_channels_by_their_angle() -> None:
    x = torch.randn(
        1, 1, 1, 3, SIZE, generator=torch.Generator().manual_seed(3), dtype=torch.float64
    )
    turned = rotate(x, angles(torch.tensor([[0, 1, 5]])))
    as_complex = torch.complex(*x.chunk(2, -1))
    angle = torch.tensor([0.0, 1.0, 5.0], dtype=torch.float64)[:, None] / 100 ** (
        torch.arange(SIZE // 2) / (SIZE // 2)
    )
    wanted = as_complex * torch.polar(torch.ones_like(angle), angle)
    torch.testing.assert_close(turned, torch.cat([wanted.real, wanted.imag], -1))


def test_each_layer_has_its_own_view_of_the_prefix() -> None:
    """A token that no layer's actions see changes nothing; one that one layer sees does."""
    model, keys = expert(None), prefix(HEADS)
    generator = torch.Generator().manual_seed(4)
    masks = tuple(torch.rand(BATCH, CHUNK, PREFIX, generator=generator) < 0.7 for _ in range(2))
    for mask in masks:
        mask[..., 0] = False
    first = ask(model, keys, masks)

    def changed(layer: int, token: int) -> Tensor:
        other = [KeyValue(k.clone(), v.clone()) for k, v in keys]
        other[layer].value[:, :, token] += 1
        return ask(model, other, masks)

    for layer in range(2):
        torch.testing.assert_close(changed(layer, 0), first, rtol=0, atol=0)
        assert (changed(layer, 3) - first).abs().max() > 1e-6


def test_one_mask_for_all_layers_is_that_mask_for_each() -> None:
    model, keys = expert(2), prefix(2)
    mask = torch.arange(PREFIX) < torch.tensor([[7], [5], [2]])
    torch.testing.assert_close(
        ask(model, keys, mask), ask(model, keys, (mask[:, None].expand(-1, CHUNK, -1),) * 2)
    )
