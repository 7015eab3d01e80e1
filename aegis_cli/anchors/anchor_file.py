"""An anchor as a file: what it holds as named tensors, and back."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from aegis_cli.common import artifacts
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.moments import Moments
from aegis_cli.core.spectrum import Spectrum

TYPES = ("image", "text")
_UNITS = {"count": "tokens", "layers.*.var": "activation^2", "layers.*.mean": "activation"}


def save(
    path: Path,
    anchor: Anchor,
    *,
    fingerprint: str,
    meta: Mapping[str, Any],
    seed: int | None = None,
    inputs: Mapping[str, str] | None = None,
) -> None:
    """Write the anchor of the backbone with this fingerprint.

    Args:
        fingerprint: sha256 of the backbone's weights.
        meta: what else a reader has to know, such as the parts.
        inputs: sha256 of what it was measured on, by a name for it.
    """
    artifacts.save(
        path,
        "anchor",
        _tensors(anchor),
        seed=seed,
        inputs=inputs,
        fingerprint=fingerprint,
        units=_UNITS,
        meta=meta,
    )


def _tensors(anchor: Anchor) -> dict[str, Tensor]:
    tensors: dict[str, Tensor] = {}
    if anchor.image:
        tensors["count"] = torch.tensor([anchor.image[0].count, anchor.text[0].count])
        for name, layers in zip(TYPES, (anchor.image, anchor.text), strict=True):
            for i, layer in enumerate(layers):
                tensors |= {
                    f"layers.{i}.{name}.mean": layer.mean,
                    f"layers.{i}.{name}.var": layer.var,
                }
    for part, spectra in (("inputs", anchor.inputs), ("curvature", anchor.curvature)):
        for site, spectrum in spectra.items():
            tensors[f"{part}.{site}.values"] = spectrum.values
            if spectrum.vectors is not None:
                # They are most of the file, and what they project is float32 too.
                tensors[f"{part}.{site}.vectors"] = spectrum.vectors.float()
    return tensors | {f"fisher.{name}": information for name, information in anchor.fisher.items()}


def load(path: Path, fingerprint: str) -> Anchor:
    """Read the anchor of the backbone with this fingerprint.

    Raises:
        AegisError: no anchor, a damaged one, or one of another backbone.
    """
    return from_tensors(artifacts.load(path, "anchor", fingerprint=fingerprint).tensors)


def from_tensors(tensors: artifacts.Tensors) -> Anchor:
    """Build an anchor from the tensors of a valid file."""
    layers = sum(name.endswith(".image.mean") for name in tensors)
    counts = tensors["count"].tolist() if layers else (0, 0)
    moments: dict[str, list[Moments]] = {}
    for name, count in zip(TYPES, counts, strict=True):
        moments[name] = []
        for i in range(layers):
            layer = f"layers.{i}.{name}"
            moments[name].append(Moments(count, tensors[f"{layer}.mean"], tensors[f"{layer}.var"]))
    information = {
        name.removeprefix("fisher."): t for name, t in tensors.items() if name.startswith("fisher.")
    }
    return Anchor(
        image=moments["image"],
        text=moments["text"],
        inputs=_spectra("inputs.", tensors),
        fisher=information,
        curvature=_spectra("curvature.", tensors),
    )


def _spectra(part: str, tensors: artifacts.Tensors) -> dict[str, Spectrum]:
    sites = [
        name[len(part) : -len(".values")]
        for name in tensors
        if name.startswith(part) and name.endswith(".values")
    ]
    return {
        site: Spectrum(tensors[f"{part}{site}.values"], tensors.get(f"{part}{site}.vectors"))
        for site in sites
    }


def only(anchor: Anchor, parts: Collection[str]) -> Anchor:
    """Keep of an anchor these parts alone, for the others may take gigabytes.

    Args:
        parts: some of `moments`, `inputs`, `curvature` and `fisher`; what the anchor lacks stays
            empty.
    """
    image, text = (anchor.image, anchor.text) if "moments" in parts else ((), ())
    named = {
        part: getattr(anchor, part) for part in ("inputs", "fisher", "curvature") if part in parts
    }
    return Anchor(image, text, **named)


def to_device(anchor: Anchor, device: torch.device) -> Anchor:
    """Move all of an anchor's tensors to the device on which training runs."""
    return Anchor(
        image=_moved_layers(anchor.image, device),
        text=_moved_layers(anchor.text, device),
        inputs={site: _moved(s, device) for site, s in anchor.inputs.items()},
        fisher={name: information.to(device) for name, information in anchor.fisher.items()},
        curvature={site: _moved(s, device) for site, s in anchor.curvature.items()},
    )


def _moved_layers(layers: Sequence[Moments], device: torch.device) -> list[Moments]:
    return [Moments(m.count, m.mean.to(device), m.var.to(device)) for m in layers]


def _moved(spectrum: Spectrum, device: torch.device) -> Spectrum:
    vectors = None if spectrum.vectors is None else spectrum.vectors.to(device)
    return Spectrum(spectrum.values.to(device), vectors)
