"""A robot policy: a backbone, an action expert that reads it, and a robot's scales."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from aegis_cli.common.devices import autocast, send
from aegis_cli.common.errors import AegisError
from aegis_cli.common.files import sha256_value
from aegis_cli.core import continuation
from aegis_cli.core.attention import KeyValue
from aegis_cli.core.continuation import Continued
from aegis_cli.data.batch import Images, Normalizer, RobotBatch, WholeBatch
from aegis_cli.data.relative import Origins, Places
from aegis_cli.models import flow
from aegis_cli.models.backbones.base import Backbone, Batch, Encoding, Suffix
from aegis_cli.models.expert import ActionExpert
from aegis_cli.models.structure import digest


def check_actions(actions: Tensor) -> Tensor:
    """Return actions of any shape, once they are checked to be safe to send to a robot.

    Raises:
        AegisError: some actions are not finite.
    """
    if not (finite := actions.isfinite()).all():
        raise AegisError(
            f"{int((~finite).sum())} of {actions.numel()} predicted numbers that are not finite",
            "actions of finite numbers",
            "check that the positions are in the units of the demonstrations; if they are, use "
            "an earlier checkpoint",
        )
    return actions


class Policy(nn.Module):
    """A backbone that reads image and instruction, and an expert that turns noise into actions.

    The split is that of pi0 (arXiv 2410.24164). A robot may have fewer positions and actions than
    the expert; the normalizers have the robot's sizes.

    Attributes:
        acts_in: the precision of `act`, as passed to `devices.autocast`.
    """

    def __init__(
        self,
        backbone: Backbone,
        expert: ActionExpert,
        proprio: Normalizer,
        action: Normalizer,
        relative: Places = (),
    ) -> None:
        """Assemble the policy.

        Args:
            proprio: scale of the robot's positions.
            action: scale of its actions minus what they are relative to.
            relative: for each action, the index of the position that it is predicted relative to,
                or None if it is absolute; empty if all are absolute.
        """
        super().__init__()
        self.backbone, self.expert = backbone, expert
        self.proprio_scale, self.action_scale = proprio, action
        self.origins = Origins(relative)
        self.acts_in = "float32"

    def encode(self, images: Images, instructions: Sequence[str]) -> Encoding:
        """Encode B images (or B tuples of several cameras' images) and instructions."""
        return self.backbone.encode(self.backbone.prepare(images, instructions))

    def targets(self, batch: RobotBatch) -> Tensor:
        """The expert's targets for a batch's actions: [B, H, A], in normalised units."""
        device = self.backbone.device
        origins = self.origins(send(batch.proprio, device))
        return self.action_scale(send(batch.actions, device) - origins)

    def targets_on_cpu(self) -> Callable[[RobotBatch], Tensor]:
        """A function like `targets` that runs on the CPU, for threads that prepare batches."""
        scale, origins = (copy.deepcopy(m).cpu() for m in (self.action_scale, self.origins))
        return lambda batch: scale(batch.actions - origins(batch.proprio))

    def flow_loss(
        self,
        batch: RobotBatch,
        encoding: Encoding,
        samples: int,
        generator: torch.Generator,
        detach: bool = False,
        of: WholeBatch | None = None,
    ) -> Tensor:
        """Flow-matching loss over `samples` flow times and noises of each frame.

        Args:
            batch: B frames.
            encoding: the backbone's pass over them.
            samples: K; the backbone, which is the cost, runs once for all of them.
            generator: draws times and noises, on the CPU.
            detach: whether the gradient stops at the keys and values.
            of: the batch that this one is a share of.

        Returns:
            A scalar, in normalised units; for a share, its contribution to the whole batch's loss.
        """
        of = of or WholeBatch(len(batch), int((~batch.is_pad).sum()))
        shape = (of.frames, samples, *batch.actions.shape[1:])  # (B, K, H, A)
        # Both are drawn on the CPU, so that they do not depend on the device, and for the whole
        # batch, so that they do not depend on the shares.
        rows = of.share.rows(of.frames)
        times = flow.draw_times(shape[:2], generator)[rows]
        noise = flow.draw_noise(shape, generator)[rows]
        return self.flow_loss_at(batch, encoding, times, noise, of.shown, detach)

    def flow_loss_at(
        self,
        batch: RobotBatch,
        encoding: Encoding,
        times: Tensor,
        noise: Tensor,
        shown: int | None = None,
        detach: bool = False,
    ) -> Tensor:
        """The loss of `flow_loss` at these flow times [B, K] and noises [B, K, H, A].

        Args:
            shown: number of steps in the chunks that are not padding, counted over the batch that
                this one is a share of; None: over this one.
        """
        device = self.backbone.device
        actions = self.targets(batch)[:, None]  # [B, 1, H, A]
        times, noise = send(times, device), send(noise, device)
        noisy, target = flow.interpolate(actions, noise, times)
        prefix: Sequence[KeyValue] = encoding.keys_values
        if detach:
            # The expert reads only keys and values of the backbone: if they are detached, no
            # gradient of the loss reaches it.
            prefix = [KeyValue(key.detach(), value.detach()) for key, value in prefix]
        proprio = self.proprio_scale(send(batch.proprio, device))
        suffix = self.backbone.suffix(encoding, noise.shape[2])
        velocity = self._velocity(noisy, times, proprio, prefix, suffix)
        return flow.masked_mse(velocity, target, send(batch.is_pad, device), shown)

    def fingerprint(self) -> str:
        """sha256 of all weights and of the settings that affect how the policy acts."""
        settings = {
            "acts_in": self.acts_in,
            "expert": repr(self.expert.shape),
            "relative_to": repr(self.origins.places),
            **self.backbone.settings(),
        }
        return sha256_value({"weights": digest(self.state_dict()), **settings})

    def act(
        self,
        images: Images,
        instructions: Sequence[str],
        proprio: Tensor,
        generator: torch.Generator,
        continued: Continued | None = None,
    ) -> Tensor:
        """One action chunk per frame, [B, H, A] in raw units.

        Args:
            images: the images of B frames.
            instructions: B texts.
            proprio: [B, P] in raw units.
            generator: draws the initial noise of the flow, on the CPU.
            continued: the actions that the chunks continue, in raw units; None: nothing.
        """
        noise = self.draw_noise(len(images), generator)
        return self.act_from(images, instructions, proprio, noise, continued)

    def draw_noise(self, frames: int, generator: torch.Generator) -> Tensor:
        """The initial noise [frames, H, A] of the flow, on the CPU."""
        size = len(self.action_scale.mean)
        return flow.draw_noise((frames, self.expert.shape.chunk, size), generator)

    @torch.no_grad()
    def act_from(
        self,
        images: Images,
        instructions: Sequence[str],
        proprio: Tensor,
        noise: Tensor,
        continued: Continued | None = None,
        inputs: Batch | None = None,
    ) -> Tensor:
        """The result of `act` for this noise [B, H, A].

        Args:
            inputs: images and instructions as the backbone has processed them ahead; None: it
                processes them now.
        """
        device = self.backbone.device
        with autocast(device, self.acts_in):
            if inputs is None:
                encoding = self.encode(images, instructions)
            else:
                encoding = self.backbone.encode(inputs.to(device))
            return self._acted(encoding, proprio, noise, continued)

    def _acted(
        self,
        encoding: Encoding,
        proprio: Tensor,
        noise: Tensor,
        continued: Continued | None,
    ) -> Tensor:
        proprio = proprio.to(self.backbone.device)
        state = self.proprio_scale(proprio)
        suffix = self.backbone.suffix(encoding, noise.shape[1])

        def velocity(x: Tensor, t: Tensor) -> Tensor:
            one_sample, time = x[:, None], t[:, None]  # [B, 1, H, A], [B, 1]
            found = self._velocity(one_sample, time, state, encoding.keys_values, suffix)
            return found[:, 0]

        field: continuation.Velocity = velocity
        origins = self.origins(proprio)
        if continued is not None:
            # In the flow's units, which are relative to the robot's current positions.
            old = self.action_scale(continued.actions.to(state.device) - origins)
            field = continuation.guided(velocity, Continued(old, continued.delay), noise.shape[1])
        predicted = flow.integrate(field, noise.to(state.device))
        # The inverse of `targets`.
        return self.action_scale.invert(predicted) + origins

    def _velocity(
        self, x: Tensor, times: Tensor, proprio: Tensor, prefix: Sequence[KeyValue], suffix: Suffix
    ) -> Tensor:
        """The expert's velocity at noisy chunks [B, K, H, A], in the same shape.

        Positions and actions that the robot lacks are set to 0.
        """
        shape, actions = self.expert.shape, x.shape[-1]
        wide = nn.functional.pad(x, (0, shape.actions - actions))
        state = nn.functional.pad(proprio, (0, shape.proprio - proprio.shape[-1]))
        found = self.expert(wide, times, state, prefix, suffix.visible, suffix.rotation)
        return found[..., :actions]
