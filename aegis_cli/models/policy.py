"""A robot policy: a backbone, an action expert that reads it, and the scales of what goes in and
out.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from aegis_cli.core.attention import KeyValue
from aegis_cli.data.batch import Images, Normalizer, RobotBatch
from aegis_cli.models import flow
from aegis_cli.models.backbones.base import Backbone, Encoding, Suffix
from aegis_cli.models.expert import ActionExpert


class Policy(nn.Module):
    """pi0's split: the backbone sees image and instruction, the expert turns noise into an action
    chunk.

    A robot may have fewer positions or actions than the expert: those that the scales know.
    """

    def __init__(
        self, backbone: Backbone, expert: ActionExpert, proprio: Normalizer, action: Normalizer
    ) -> None:
        super().__init__()
        self.backbone, self.expert = backbone, expert
        self.proprio_scale, self.action_scale = proprio, action

    def encode(self, images: Images, instructions: Sequence[str]) -> Encoding:
        return self.backbone.encode(self.backbone.prepare(images, instructions))

    def flow_loss(
        self,
        batch: RobotBatch,
        encoding: Encoding,
        samples: int,
        generator: torch.Generator,
        detach: bool = False,
    ) -> Tensor:
        """Flow-matching loss over `samples` flow times and noises of each frame.

        Args:
            batch: B frames.
            encoding: the backbone's pass over them.
            samples: K; the backbone, which is the cost, runs once for all of them.
            generator: on the CPU; draws times and noises.
            detach: stop the gradient at the keys and values.
        """
        device = self.backbone.device
        actions = self.action_scale(batch.actions.to(device))[:, None]
        shape = (len(actions), samples, *actions.shape[2:])
        times = flow.draw_times(shape[:2], generator).to(device)
        noise = torch.randn(shape, generator=generator).to(device)
        noisy, target = flow.interpolate(actions, noise, times)
        prefix = (
            [KeyValue(k.detach(), v.detach()) for k, v in encoding.keys_values]
            if detach
            else encoding.keys_values
        )
        proprio = self.proprio_scale(batch.proprio.to(device))
        suffix = self.backbone.suffix(encoding, shape[2])
        velocity = self._velocity(noisy, times, proprio, prefix, suffix)
        return flow.masked_mse(velocity, target, batch.is_pad.to(device))

    @torch.no_grad()
    def act(
        self,
        images: Images,
        instructions: Sequence[str],
        proprio: Tensor,
        generator: torch.Generator,
    ) -> Tensor:
        """One action chunk a frame, [B, H, A] in raw units."""
        encoding = self.encode(images, instructions)
        state = self.proprio_scale(proprio.to(self.backbone.device))
        chunk, size = self.expert.shape.chunk, len(self.action_scale.mean)
        noise = torch.randn(len(images), chunk, size, generator=generator).to(state.device)
        suffix = self.backbone.suffix(encoding, chunk)

        def velocity(x: Tensor, t: Tensor) -> Tensor:
            return self._velocity(x[:, None], t[:, None], state, encoding.keys_values, suffix)[:, 0]

        return self.action_scale.invert(flow.integrate(velocity, noise))

    def _velocity(
        self, x: Tensor, times: Tensor, proprio: Tensor, prefix: Sequence[KeyValue], suffix: Suffix
    ) -> Tensor:
        """The expert's at noisy chunks [B, K, H, A]; what the robot lacks of the expert's positions
        and actions is 0.
        """
        shape = self.expert.shape
        wide = nn.functional.pad(x, (0, shape.actions - x.shape[-1]))
        state = nn.functional.pad(proprio, (0, shape.proprio - proprio.shape[-1]))
        return self.expert(wide, times, state, prefix, suffix.visible, suffix.rotation)[
            ..., : x.shape[-1]
        ]
