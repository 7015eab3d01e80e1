"""Demonstrations as training batches."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from aegis_cli import artifacts
from aegis_cli.errors import AegisError
from aegis_cli.policy import Normalizer, RobotBatch


@dataclass(frozen=True)
class Demonstrations:
    """A demonstration file; frames stay memory-mapped until a batch asks for them.

    Attributes:
        task: the task's name.
        tensors: as the file holds them (see `artifacts.KINDS`).
        instructions: the instruction texts that `tensors["instruction"]` points to.
        episode_of: [N] int64, the episode of each frame.
        train, validation: [*] int64 frame numbers, split by episode.
    """

    task: str
    tensors: dict[str, Tensor]
    instructions: list[str]
    episode_of: Tensor
    train: Tensor
    validation: Tensor

    def batch(self, frames: np.ndarray | Tensor, chunk: int) -> RobotBatch:
        """Frames [B] with the `chunk` expert actions that follow; a chunk that runs past its episode is padded."""
        frame = torch.as_tensor(frames)
        episode = self.episode_of[frame]
        end = self.tensors["episode_starts"][episode + 1]
        ahead = frame[:, None] + torch.arange(chunk)
        is_pad = ahead >= end[:, None]
        return RobotBatch(
            images=self.tensors["frames"][frame],
            instructions=[self.instructions[i] for i in self.tensors["instruction"][episode].tolist()],
            proprio=self.tensors["proprio"][frame],
            actions=self.tensors["actions"][torch.minimum(ahead, end[:, None] - 1)],
            is_pad=is_pad,
        )

    def scales(self) -> tuple[Normalizer, Normalizer]:
        """Normalizers of proprioception and actions, from the training episodes alone."""
        return Normalizer.fit(self.tensors["proprio"][self.train]), Normalizer.fit(self.tensors["actions"][self.train])


def load(path: Path, validation_share: float, seed: int) -> Demonstrations:
    """Read demonstrations and split them by episode.

    Raises:
        AegisError: a file that is not sound, or too few episodes to hold one out.
    """
    artifact = artifacts.load(path, "demos")
    tensors, meta = artifact.tensors, artifact.header.meta
    starts = tensors["episode_starts"]
    episodes = len(starts) - 1
    if episodes < 2:
        raise AegisError(f"{episodes} episode in '{path}'", "2 or more: one is held out", "record more with aegis demos")
    held_out = min(episodes - 1, max(1, round(validation_share * episodes)))
    order = np.random.default_rng(seed).permutation(episodes)
    episode_of = torch.repeat_interleave(torch.arange(episodes), starts.diff())
    is_validation = torch.isin(episode_of, torch.from_numpy(order[:held_out]))
    return Demonstrations(
        meta["task"], tensors, meta["instructions"], episode_of,
        (~is_validation).nonzero().squeeze(1), is_validation.nonzero().squeeze(1),
    )
