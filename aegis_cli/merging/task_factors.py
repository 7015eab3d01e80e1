"""What a policy's maps read on robot frames, and how its task loss depends on their outputs."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from aegis_cli.anchors.curvature import CurvatureRecorder
from aegis_cli.anchors.inputs import InputRecorder
from aegis_cli.common.events import OnEvent, Progress, ignore
from aegis_cli.core.spectrum import DENSE, Spectrum
from aegis_cli.data import spread
from aegis_cli.data.demonstrations import Demonstrations
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.models.policy import Policy
from aegis_cli.models.structure import Maps

FRAMES = 32  # per pass at most
_SEED = 0  # seed of the flow times and noises


def dense_sites(backbone: Backbone) -> list[str]:
    """The backbone's linear maps and convolutions, by their dotted names."""
    modules = backbone.site_modules().items()
    return [site for site, module in modules if isinstance(module, DENSE)]


def inputs(
    policy: Policy, demos: Demonstrations, frames: int, on_event: OnEvent = ignore
) -> dict[str, Spectrum]:
    """The second moment of each map's inputs on training frames, by site."""
    recorder = InputRecorder(policy.backbone, _maps(policy.backbone), follow_uses=False)
    # None: no row is padded (`_passes`), so every token counts.
    with recorder.watch(None), torch.no_grad():
        for rows in _passes(demos, frames, "task inputs", on_event):
            instructions = [demos.instructions[i] for i in demos.instruction_of[rows].tolist()]
            policy.encode(demos.images(rows), instructions)
    return recorder.spectra(1.0)


def curvature(
    policy: Policy,
    demos: Demonstrations,
    frames: int,
    flow_samples: int,
    on_event: OnEvent = ignore,
) -> dict[str, Spectrum]:
    """Both factors of the task loss's curvature at each map, `SITE.inputs` and `SITE.outputs`.

    A map that the loss does not depend on is left out.

    Args:
        flow_samples: flow times, each with its noise, per frame.
    """
    recorder = CurvatureRecorder(policy.backbone, _maps(policy.backbone), _SEED, follow_uses=False)
    generator = torch.Generator().manual_seed(_SEED)
    with recorder.watch(), torch.enable_grad():
        for rows in _passes(demos, frames, "task curvature", on_event):
            batch = demos.batch(rows, policy.expert.shape.chunk)
            encoding = policy.encode(batch.images, batch.instructions)
            loss = policy.flow_loss(batch, encoding, flow_samples, generator)
            # A sum, so that each frame has its own gradient.
            recorder.follow(len(rows) * loss, keep=False)
    return recorder.spectra(1.0)


def _maps(backbone: Backbone) -> Maps:
    # Only linear maps and convolutions have factors in a merge, not tables or tied heads.
    kinds = dict.fromkeys(dense_sites(backbone), "maps")
    return Maps(kinds=kinds, twins={}, heads={}, unknown={})


def _passes(demos: Demonstrations, frames: int, stage: str, on_event: OnEvent) -> Iterator[Tensor]:
    """Frame numbers [B] spread evenly over the training episodes, one instruction per batch.

    So no row is padded, and hooks on the modules see only valid tokens.
    """
    chosen = demos.train[spread.rows(len(demos.train), frames)]
    done = 0
    on_event(Progress(stage, done, len(chosen), "frames"))
    for instruction in demos.instruction_of[chosen].unique():
        for rows in chosen[demos.instruction_of[chosen] == instruction].split(FRAMES):
            yield rows
            done += len(rows)
            on_event(Progress(stage, done, len(chosen), "frames"))
