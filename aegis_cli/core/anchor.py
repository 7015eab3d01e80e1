"""The anchor: statistics of the pre-trained backbone on VQA, measured once before training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from torch import Tensor

from aegis_cli.core.moments import Moments
from aegis_cli.core.spectrum import Spectrum


@dataclass(frozen=True)
class Anchor:
    """The parts of an anchor that were measured; the others are empty.

    Attributes:
        image, text: Gaussians of the hidden states at image and at text tokens, one per layer.
        inputs: second moment of each map's inputs, by site (the map's dotted name).
        curvature: two Kronecker factors of the answers' Fisher information for each dense map,
            under `site.inputs` and `site.outputs`.
        fisher: E[(d log p(answer) / d theta)^2] for each parameter, by name.
    """

    image: Sequence[Moments] = ()
    text: Sequence[Moments] = ()
    inputs: Mapping[str, Spectrum] = field(default_factory=dict)
    fisher: Mapping[str, Tensor] = field(default_factory=dict)
    curvature: Mapping[str, Spectrum] = field(default_factory=dict)
