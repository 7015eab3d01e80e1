"""The action expert of pi0 (arXiv 2410.24164): a narrow transformer beside the backbone's layers.

Each expert layer attends to its own action tokens and to the keys and values of the backbone layer
at the same depth. The K flow samples of one frame are K blocks over the same prefix: the backbone,
which is the cost, runs once. If the backbone rotates its keys by position, the action tokens take
the positions after the prefix, with the same rotary embedding. If the backbone has fewer key heads
than query heads, so does the expert.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from aegis_cli.core.activation import squared_relu
from aegis_cli.core.attention import KeyValue, Rotation, additive, block_attention, rotate
from aegis_cli.models.backbones import compiling

# Shortest and longest period of the flow time's sine features, as in openpi.
_PERIODS = (4e-3, 4.0)


@dataclass(frozen=True)
class ExpertShape:
    """Sizes of an expert.

    Attributes:
        depth, heads, head_dim, kv_heads: those of the backbone that it reads; kv_heads None means
            the same as `heads`.
        proprio, actions: P and A, or the largest of them if it serves several robots.
        chunk: H, the number of actions in one prediction.
        width: size of the residual stream.
        mlp_ratio: hidden units of an MLP per unit of width.
    """

    depth: int
    heads: int
    head_dim: int
    proprio: int
    actions: int
    chunk: int
    width: int = 128
    mlp_ratio: int = 4
    kv_heads: int | None = None

    def to_json(self) -> dict[str, int | None]:
        """The sizes as values that JSON can hold."""
        return asdict(self)


def check_fit(shape: ExpertShape, depth: int, heads: int, head_dim: int) -> None:
    """Raise ValueError unless an expert of this shape can read a backbone of these sizes."""
    found, wanted = (shape.depth, shape.heads, shape.head_dim), (depth, heads, head_dim)
    if found != wanted:
        raise ValueError(f"an expert of depth, heads and head width {found} instead of {wanted}")
    if shape.heads % (shape.kv_heads or shape.heads):
        raise ValueError(f"{shape.heads} heads of queries for {shape.kv_heads} of keys")


class ExpertLayer(nn.Module):
    """Pre-norm attention to (backbone prefix, own block) and an MLP."""

    def __init__(self, shape: ExpertShape) -> None:
        super().__init__()
        self.heads, self.kv_heads = shape.heads, shape.kv_heads or shape.heads
        self.norm1 = nn.LayerNorm(shape.width)
        self.qkv = nn.Linear(shape.width, (self.heads + 2 * self.kv_heads) * shape.head_dim)
        self.out = nn.Linear(shape.heads * shape.head_dim, shape.width)
        self.norm2 = nn.LayerNorm(shape.width)
        self.up = nn.Linear(shape.width, shape.mlp_ratio * shape.width)
        self.down = nn.Linear(shape.mlp_ratio * shape.width, shape.width)

    def forward(
        self, x: Tensor, prefix: KeyValue, prefix_mask: Tensor, rotation: Rotation | None = None
    ) -> Tensor:
        """The layer's output for tokens x [B, K, H, W], in the same shape.

        Args:
            prefix: the backbone layer's keys and values, [B, kv_heads, T, head_dim] each.
            prefix_mask: additive, broadcastable to scores [B, h, K, H, T].
            rotation: the rotary embedding of the action tokens, [B, H, head_dim].
        """
        qkv = self.qkv(self.norm1(x)).unflatten(-1, (self.heads + 2 * self.kv_heads, -1))
        qkv = qkv.permute(0, 3, 1, 2, 4)  # [B, heads + 2 kv_heads, K, H, head_dim]
        query, key, value = qkv.split([self.heads, self.kv_heads, self.kv_heads], dim=1)
        # The backbone's keys are already rotated, for the positions before these.
        if rotation is not None:
            query, key = rotate(query, rotation), rotate(key, rotation)
        mixed = self._grouped(query, KeyValue(key, value), prefix, prefix_mask)
        x = x + self.out(mixed.permute(0, 2, 3, 1, 4).flatten(3))  # of [B, K, H, heads * head_dim]
        return x + self.down(squared_relu(self.up(self.norm2(x))))

    def _grouped(
        self, query: Tensor, own: KeyValue, prefix: KeyValue, prefix_mask: Tensor
    ) -> Tensor:
        """Grouped-query attention: each key head serves `heads / kv_heads` query heads.

        The query heads of a group are treated as further blocks of their key head.
        """
        # The backbone may use another dtype than the expert, whose queries decide here.
        prefix = KeyValue(prefix.key.to(query.dtype), prefix.value.to(query.dtype))
        groups, blocks = self.heads // self.kv_heads, query.shape[2]
        if groups == 1:
            return block_attention(query, own, None, prefix, prefix_mask)
        query = query.unflatten(1, (self.kv_heads, groups)).flatten(2, 3)  # [B, kv, groups*K, H, d]
        # The prefix is shared by all blocks; only a block's own keys have to be repeated.
        own = KeyValue(*(t.repeat(1, 1, groups, 1, 1) for t in own))
        mixed = block_attention(query, own, None, prefix, prefix_mask)
        return mixed.unflatten(2, (groups, blocks)).flatten(1, 2)  # [B, heads, K, H, d]


class ActionExpert(nn.Module):
    """Velocity field over action chunks.

    It is conditioned on proprioception, the flow time and a backbone's keys and values.

    Attributes:
        recomputes: whether a layer's activations are recomputed in the backward pass instead of
            kept. They grow with flow samples x chunk x (chunk + the backbone's tokens).
    """

    def __init__(self, shape: ExpertShape) -> None:
        """Initialize the weights in float32, whatever the default dtype is."""
        super().__init__()
        self.shape, self.recomputes = shape, False
        width = shape.width
        self.action_in = nn.Linear(shape.actions, width)
        self.position = nn.Parameter(torch.randn(shape.chunk, width) * 0.02)
        self.proprio_in = nn.Linear(shape.proprio, width)
        self.condition = nn.Sequential(
            nn.Linear(2 * width, width), nn.SiLU(), nn.Linear(width, width)
        )
        self.layers = nn.ModuleList(ExpertLayer(shape) for _ in range(shape.depth))
        self.final_norm = nn.LayerNorm(width)
        self.action_out = nn.Linear(width, shape.actions)
        self.float()

    @torch.no_grad()
    def of_robot(self, proprio: int, actions: int) -> ActionExpert:
        """The expert for a robot that has only the first `proprio` positions and `actions` actions.

        It predicts what this expert does if the others are 0.
        """
        found = ActionExpert(replace(self.shape, proprio=proprio, actions=actions))
        tensors = self.state_dict()
        for name, count in (("proprio_in", proprio), ("action_in", actions)):
            tensors[f"{name}.weight"] = tensors[f"{name}.weight"][:, :count]
        for name in ("action_out.weight", "action_out.bias"):
            tensors[name] = tensors[name][:actions]
        found.load_state_dict(tensors)
        return found

    def compile_layers(self, backend: str = "inductor") -> None:
        """Compile the layers, which share the compiled code of the first one."""
        compiling.compile_layers(self.layers, backend, keeps_keys=False)

    def forward(
        self,
        x: Tensor,
        times: Tensor,
        proprio: Tensor,
        prefix: Sequence[KeyValue],
        prefix_mask: Tensor | Sequence[Tensor],
        rotation: Rotation | Sequence[Rotation] | None = None,
    ) -> Tensor:
        """Velocity at noisy chunks.

        Args:
            x: [B, K, H, A] noisy normalised actions.
            times: [B, K] flow times.
            proprio: [B, P] normalised proprioception.
            prefix: the backbone's keys and values of each layer.
            prefix_mask: [B, T] bool, False at padding; or one [B, H, T] per layer that says what
                each action token sees.
            rotation: the rotary embedding of the action tokens, [B, H, head_dim], for all layers
                or one per layer; None for a backbone without one.

        Returns:
            [B, K, H, A] float32.
        """
        state = self.proprio_in(proprio)[:, None].expand(-1, times.shape[1], -1)  # [B, K, W]
        features = torch.cat([_time_features(times, self.shape.width), state], dim=-1)
        condition = self.condition(features)  # [B, K, W], the same for all tokens of a chunk
        tokens = self.action_in(x) + self.position + condition[:, :, None]  # [B, K, H, W]
        masks = self._masks(prefix_mask)
        for_all = rotation is None or isinstance(rotation, Rotation)
        rotations = [rotation] * len(self.layers) if for_all else rotation
        for layer, keys_values, mask, own in zip(
            self.layers, prefix, masks, rotations, strict=True
        ):
            if self.recomputes and torch.is_grad_enabled():
                tokens = checkpoint(layer, tokens, keys_values, mask, own, use_reentrant=False)
            else:
                tokens = layer(tokens, keys_values, mask, own)
        # Loss and integration use the velocity in float32, even under autocast.
        return self.action_out(self.final_norm(tokens)).float()

    def _masks(self, prefix_mask: Tensor | Sequence[Tensor]) -> list[Tensor]:
        """Each layer's mask in additive form, for scores [B, h, K, H, T]."""
        if isinstance(prefix_mask, Tensor):
            for_all = additive(prefix_mask)[:, None, None, None]  # [B, 1, 1, 1, T]
            return [for_all] * len(self.layers)
        return [additive(mask)[:, None, None] for mask in prefix_mask]  # [B, 1, 1, H, T] each


def _time_features(times: Tensor, width: int) -> Tensor:
    """Sines and cosines [B, K, width] of the flow time [B, K], at geometrically spaced periods."""
    low, high = _PERIODS
    share = torch.linspace(0, 1, width // 2, dtype=times.dtype, device=times.device)
    period = low * (high / low) ** share  # [width / 2]
    angle = times[..., None] * (2 * math.pi / period)  # [B, K, width / 2]
    return torch.cat([angle.sin(), angle.cos()], dim=-1)
