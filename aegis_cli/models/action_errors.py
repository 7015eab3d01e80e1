"""Errors of a policy's predicted actions against the recorded ones (open loop).

Each prediction starts from a recorded frame, and nothing is executed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from aegis_cli.common import devices, kept_lines, prefetch
from aegis_cli.common.estimates import t_quantile
from aegis_cli.common.events import OnEvent, Progress, ignore
from aegis_cli.common.kept_lines import KeptLines
from aegis_cli.data.batch import RobotBatch
from aegis_cli.data.demonstrations import Demonstrations
from aegis_cli.data.vqa.metrics import clustered_error
from aegis_cli.models.backbones.base import Batch
from aegis_cli.models.policy import Policy
from aegis_cli.models.policy_meta import PolicyMeta


def predict(
    policy: Policy,
    shown: Demonstrations,
    at: torch.Tensor,
    seed: int,
    batch_size: int,
    stage: str,
    on_event: OnEvent = ignore,
    kept: KeptLines | None = None,
) -> torch.Tensor:
    """Chunks [N, H, A] at frames [N], in raw units; `seed` seeds the flow's noise.

    For a GPU, threads read and process the next batches meanwhile.

    Args:
        kept: what was predicted before at these frames under the same circumstances, batch by
            batch, and is not predicted again; what is predicted is added. None keeps nothing.
    """
    # All noise is drawn at once: drawn by parts, it would depend on the size of the parts.
    noise = policy.draw_noise(len(at), torch.Generator().manual_seed(seed))
    found = {} if kept is None else dict(_kept(kept))  # chunks by their first frame's place
    done = sum(map(len, found.values()))
    on_event(Progress(stage, done, len(at), "frames"))
    backbone = policy.backbone
    waits = devices.reading_stalls(backbone.device)

    def prepare(first: int) -> tuple[RobotBatch, Batch | None]:
        batch = shown.batch(at[first : first + batch_size], 1)
        return batch, backbone.process(batch.images, batch.instructions) if waits else None

    left = [first for first in range(0, len(at), batch_size) if first not in found]
    with prefetch.for_device(prepare, left, backbone.device) as ready:
        for first, (batch, inputs) in zip(left, ready, strict=True):
            part = noise[first : first + batch_size]
            seen = batch.images, batch.instructions, batch.proprio
            found[first] = policy.act_from(*seen, part, None, inputs).cpu()
            if kept is not None:
                line = {"first": first, "predicted": kept_lines.packed(found[first].numpy())}
                kept.add([kept_lines.sealed(line)])
            done += len(batch)
            on_event(Progress(stage, done, len(at), "frames"))
    return torch.cat([found[first] for first in sorted(found)])


def _kept(kept: KeptLines) -> Iterator[tuple[int, torch.Tensor]]:
    """The batches that are kept whole, by the place of the first frame; others are left out."""
    for line in kept.read():
        said = kept_lines.unsealed(line)
        if said is not None and "predicted" in said:  # earlier versions wrote other keys
            yield said["first"], torch.from_numpy(kept_lines.unpacked(said["predicted"]))


def training_std(policy: Policy, meta: PolicyMeta) -> np.ndarray:
    """Each action's standard deviation [A] over the frames that the policy was trained on.

    It is the policy's scale, unless that is a scale of relative actions or of quantiles: then
    `meta` has the deviations.
    """
    told = meta.get("action_std")
    if told is not None:
        return np.array(told, np.float64)
    return policy.action_scale.std.double().cpu().numpy()


@dataclass(frozen=True, eq=False)
class ActionErrors:
    """Errors of chunks that were predicted at N frames.

    Attributes:
        recorded: [N, H, A], the recorded actions, in raw units.
        error: [N, H, A], prediction minus recording.
        hold: [N, H, A], the position at the frame minus the recording; None if actions are not
            positions.
        valid: [N, H], whether the step lies within the frame's episode, not past its end.
        episode_of: [N].
        training_std: [A], the standard deviations that errors are relative to; 0 for an action that
            never varied in training.
    """

    recorded: np.ndarray
    error: np.ndarray
    hold: np.ndarray | None
    valid: np.ndarray
    episode_of: np.ndarray
    training_std: np.ndarray

    @classmethod
    def of(
        cls,
        shown: Demonstrations,
        at: torch.Tensor,
        predicted: torch.Tensor,
        training_std: np.ndarray,
    ) -> ActionErrors:
        """The errors of chunks [N, H, A] that were predicted at frames [N]."""
        actions, is_pad = shown.chunks(at, predicted.shape[1])
        recorded = actions.double().numpy()  # [N, H, A]
        error = predicted.double().numpy() - recorded
        hold, places = None, _places(shown)
        if places is not None:
            # The position at the frame, for every step of the chunk: [N, 1, A] minus [N, H, A].
            hold = shown.tensors["proprio"][at][:, places].double().numpy()[:, None] - recorded
        episode_of = shown.episode_of[at].numpy()
        return cls(recorded, error, hold, ~is_pad.numpy(), episode_of, training_std)

    @property
    def relative(self) -> np.ndarray | None:
        """Squared error over the training's variance [N, H]; None if nothing varied in training.

        It is the mean over the dimensions that varied.
        """
        return self._relative(self.error)

    @property
    def held(self) -> np.ndarray | None:
        """The same for repeating the current position; None if actions are not positions."""
        return None if self.hold is None else self._relative(self.hold)

    def _relative(self, error: np.ndarray) -> np.ndarray | None:
        varies = self.training_std > 0
        if not varies.any():
            return None
        return np.square(error[..., varies] / self.training_std[varies]).mean(axis=-1)

    def interval(self) -> tuple[float, float] | None:
        """95 % interval of the mean relative error over all steps; None for a single episode."""
        relative = self.relative
        if relative is None:
            return None
        # The episode of each valid step, in the order of `relative[valid]`.
        episode_of = np.broadcast_to(self.episode_of[:, None], self.valid.shape)[self.valid]
        return interval(relative[self.valid], episode_of)


def no_better_than_standing_still(error: float | None, hold: float | None) -> str | None:
    """A sentence on a policy whose error is not below that of holding the position; else None."""
    if error is None or hold is None or error < hold:
        return None
    return (
        f"the policy's error of {error:.3f} is not below {hold:.3f}, which the current position "
        "has if it is repeated: it predicts the motion no better than standing still"
    )


def mean(values: np.ndarray | None, valid: np.ndarray) -> float | None:
    """The mean of the valid entries; None if there are none."""
    return None if values is None or not valid.any() else float(values[valid].mean())


def interval(errors: np.ndarray, episode_of: np.ndarray) -> tuple[float, float] | None:
    """95 % interval of the mean of errors [n], by Student's t over episodes; None for one episode.

    The steps of an episode are correlated, and episodes are few.
    """
    error, episodes = clustered_error(errors, episode_of.tolist())
    if episodes == 1:
        return None
    middle, half = float(errors.mean()), t_quantile(episodes - 1) * error
    return max(0.0, middle - half), middle + half  # no squared error is below 0


def _places(shown: Demonstrations) -> list[int] | None:
    """The index of the position of the same name as each action; None if one is missing.

    A robot may report more than it is commanded, such as velocities or efforts.
    """
    names, positions = shown.action_names, shown.proprio_names
    named = any(names) and len(names) == shown.tensors["actions"].shape[1]
    if not named or len(positions) != shown.tensors["proprio"].shape[1]:
        return None
    if names == positions:  # in the same order, even if two arms share a name
        return list(range(len(names)))
    if any(names.count(name) != 1 or positions.count(name) != 1 for name in names):
        return None
    return [positions.index(name) for name in names]
