"""What was measured, once, of the pre-trained backbone on VQA."""

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
        image, text: Gaussian of each layer's hidden states at image and at text tokens, L each.
        inputs: second moment of each map's inputs, by site (the map's dotted name).
        curvature: of each dense map the two factors of its answers' Fisher information,
            `site.inputs` and `site.outputs`.
        fisher: E[(d log p(answer) / d theta)^2] of each parameter, by name.
    """

    image: Sequence[Moments] = ()
    text: Sequence[Moments] = ()
    inputs: Mapping[str, Spectrum] = field(default_factory=dict)
    fisher: Mapping[str, Tensor] = field(default_factory=dict)
    curvature: Mapping[str, Spectrum] = field(default_factory=dict)
