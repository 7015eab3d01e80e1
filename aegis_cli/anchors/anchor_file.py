"""Save an anchor to a file as named tensors, and load it.

Maps that share a spectrum store it once, under the first map's name; the header's `shared` maps
each of the others to that name. Eigenvectors are in float32. If a model is too large for exact
spectra of all its maps, they are in half precision and are made orthonormal again on loading. The
rounding turns a direction by about 2e-4, so it lets through 4e-8 of its energy.
"""

from __future__ import annotations

import shlex
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from aegis_cli.anchors.second_moments import shared
from aegis_cli.common import artifacts, commands
from aegis_cli.common.errors import AegisError
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.moments import Moments
from aegis_cli.core.spectrum import Spectrum, orthonormal, with_rest
from aegis_cli.models.backbones import preparation

TYPES = ("image", "text")
_SPECTRA = ("inputs", "curvature")
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
        inputs: name -> sha256 of the data it was measured on.
    """
    artifacts.save(
        path,
        "anchor",
        _tensors(anchor),
        seed=seed,
        inputs=inputs,
        fingerprint=fingerprint,
        units=_UNITS,
        meta={**meta, **_followers(anchor)},
    )


def _followers(anchor: Anchor) -> dict[str, dict[str, str]]:
    """The header's `shared`; empty if no map shares a spectrum."""
    followers: dict[str, str] = {}
    for part in _SPECTRA:
        for name, leader in shared(getattr(anchor, part)).items():
            followers[f"{part}.{name}"] = f"{part}.{leader}"
    return {"shared": followers} if followers else {}


def _tensors(anchor: Anchor) -> dict[str, Tensor]:
    tensors: dict[str, Tensor] = {}
    if anchor.image:
        # Every layer sees the same tokens, so the first layer's counts hold for all.
        tensors["count"] = torch.tensor([anchor.image[0].count, anchor.text[0].count], device="cpu")
        for name, layers in zip(TYPES, (anchor.image, anchor.text), strict=True):
            for i, layer in enumerate(layers):
                tensors[f"layers.{i}.{name}.mean"] = layer.mean
                tensors[f"layers.{i}.{name}.var"] = layer.var
    for part in _SPECTRA:
        spectra = getattr(anchor, part)
        followers = shared(spectra)
        # One dtype per part: half precision as soon as one map was too wide to be summed whole, as
        # in large models.
        dtype = torch.float32 if all(s.whole for s in spectra.values()) else torch.float16
        for site, spectrum in spectra.items():
            if site not in followers:
                tensors |= _spectrum_tensors(f"{part}.{site}", spectrum, dtype)
    return tensors | {f"fisher.{name}": information for name, information in anchor.fisher.items()}


def _spectrum_tensors(site: str, spectrum: Spectrum, dtype: torch.dtype) -> dict[str, Tensor]:
    """Eigenvalues and eigenvectors; the latter make up most of the file.

    Args:
        dtype: of the eigenvectors of a dense map.
    """
    values, vectors = spectrum.values, spectrum.vectors
    if vectors is None:  # a table's
        return {f"{site}.values": values}
    if vectors.ndim == 3:  # [D, m, m] of a normalisation, with m of 2 at most: small anyway
        return {f"{site}.values": values, f"{site}.vectors": vectors.float()}
    found = {f"{site}.values": values, f"{site}.vectors": vectors.to(dtype)}
    if not spectrum.whole:
        # The values without an eigenvector are all equal, so one of them is written.
        found[f"{site}.values"] = values[: vectors.shape[1]]
        found[f"{site}.rest"] = spectrum.rest.reshape(1)
    return found


@dataclass(frozen=True)
class Wanted:
    """The backbone that an anchor has to belong to.

    Attributes:
        fingerprint: sha256 of its weights.
        name: what it was loaded from, as the user knows it.
        option: how the command takes another one, as the beginning of words, such as `--base `.
        measuring: the command that measures its anchor; None: with the settings of the anchor that
            was given; empty: its own anchor is of no use here.
        prepares: the settings by which the backbone's inputs are made; an anchor that names none of
            them is read too.
    """

    fingerprint: str
    name: str
    option: str
    measuring: str | None = None
    prepares: Mapping[str, str] = field(default_factory=dict)


def load(path: Path, wanted: Wanted) -> Anchor:
    """Read the anchor of a backbone.

    Raises:
        AegisError: no anchor, a damaged one, that of another backbone, or one of inputs that were
            made by other settings.
    """
    artifact = artifacts.load(path, "anchor", owner=_owner(path, wanted))
    other = preparation.differing(wanted.prepares, artifact.header.meta.get(preparation.META, {}))
    if other is not None:
        raise AegisError(
            f"a backbone that makes its inputs of images and texts differently from when the "
            f"anchor '{path}' was measured: {other}",
            "the same settings of the processor, since the anchor describes what the weights do "
            "with these inputs",
            "measure the anchor again with aegis anchor, or bring the settings back in the "
            "model's folder (e.g. in its preprocessor_config.json)",
        )
    return from_artifact(artifact)


def _owner(path: Path, wanted: Wanted) -> artifacts.Owner:
    header = artifacts.read_header(path, "anchor")
    there = artifacts.made_with(header)
    fix = f"bring back the weights that '{there}' had then"
    if there != wanted.name:
        other = "MODEL" if there is None else shlex.quote(there)
        fix = f"give the backbone that the anchor was measured on: {wanted.option}{other}"
    measuring = _measuring(header, wanted.name) if wanted.measuring is None else wanted.measuring
    if measuring:
        fix += f"; or measure the anchor of '{wanted.name}': {measuring}"
    return artifacts.Owner(wanted.fingerprint, wanted.name, fix)


def _measuring(header: artifacts.Header, backbone: str) -> str:
    """The command that measures a backbone's anchor on the data of another anchor."""
    meta = header.meta
    words = ["anchor", "--backbone", backbone]
    words += [f"--{name}={meta[name]}" for name in ("vqa", "ask", "demos") if name in meta]
    if isinstance(parts := meta.get("parts"), list):
        words += ["--parts", ",".join(map(str, parts))]
    return commands.aegis(*words, "--out", "FILE")


def measured_on(header: artifacts.Header) -> str:
    """A remark on the backbone that an anchor was measured on; empty if it is not recorded."""
    name = artifacts.made_with(header)
    return "" if name is None else f" (it was measured on '{name}')"


def from_artifact(artifact: artifacts.Artifact) -> Anchor:
    """Build an anchor from a valid file."""
    tensors, followers = artifact.tensors, artifact.header.meta.get("shared", {})
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
        inputs=_spectra("inputs.", tensors, followers),
        fisher=information,
        curvature=_spectra("curvature.", tensors, followers),
    )


def _spectra(
    part: str, tensors: artifacts.Tensors, followers: Mapping[str, str]
) -> dict[str, Spectrum]:
    found = {}
    for tensor in tensors:
        if tensor.startswith(part) and tensor.endswith(".values"):  # every spectrum has values
            site = tensor.removesuffix(".values")
            found[site] = _spectrum(site, tensors)
    # All maps that share a spectrum get the same object, so it is in memory once.
    found |= {name: found[leader] for name, leader in followers.items() if leader in found}
    return {name.removeprefix(part): spectrum for name, spectrum in found.items()}


def _spectrum(site: str, tensors: artifacts.Tensors) -> Spectrum:
    values, vectors = tensors[f"{site}.values"], tensors.get(f"{site}.vectors")
    if vectors is not None and vectors.dtype == torch.float16:
        # Rounded columns are no longer orthonormal, and U U^T would be no projection.
        vectors = orthonormal(vectors.float())
    if vectors is None or f"{site}.rest" not in tensors:
        return Spectrum(values, vectors)
    return with_rest(values, vectors, tensors[f"{site}.rest"])


def only(anchor: Anchor, parts: Collection[str]) -> Anchor:
    """Keep only these parts of an anchor, since the others may take gigabytes.

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
        image=[layer.to(device) for layer in anchor.image],
        text=[layer.to(device) for layer in anchor.text],
        inputs=_moved(anchor.inputs, device),
        fisher={name: information.to(device) for name, information in anchor.fisher.items()},
        curvature=_moved(anchor.curvature, device),
    )


def _moved(spectra: Mapping[str, Spectrum], device: torch.device) -> dict[str, Spectrum]:
    moved: dict[int, Spectrum] = {}  # by id, so that maps go on sharing a spectrum
    for spectrum in spectra.values():
        if id(spectrum) not in moved:
            vectors = None if spectrum.vectors is None else spectrum.vectors.to(device)
            values = spectrum.values.to(device)
            moved[id(spectrum)] = Spectrum(values, vectors, spectrum.whole)
    return {site: moved[id(spectrum)] for site, spectrum in spectra.items()}
