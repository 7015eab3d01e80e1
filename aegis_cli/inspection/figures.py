"""The figures of anchors and ledgers, from their tensors."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

from torch import Tensor

from aegis_cli.anchors import anchor_file
from aegis_cli.anchors.second_moments import shared
from aegis_cli.common import artifacts
from aegis_cli.core import ledger
from aegis_cli.core.spectrum import Spectrum, rank
from aegis_cli.inspection.report import BINS, ENERGIES, Bin, LayerEnergy, LayerMoments, SiteSpectrum


def of_file(path: Path, kind: str) -> dict[str, Any]:
    """The report fields for an anchor or a ledger."""
    return of_anchor(path) if kind == "anchor" else of_ledger(path)


def of_anchor(path: Path) -> dict[str, Any]:
    """Moments per layer, and the spectra of inputs and curvature per map."""
    anchor = anchor_file.from_artifact(artifacts.load(path, "anchor"))
    moments = []
    for i in range(len(anchor.image)):
        for kind, layers in (("image", anchor.image), ("text", anchor.text)):
            if layers[i].count:  # a model without images has no image tokens
                moments.append(_moments(f"layers.{i} {kind}", layers[i].mean, layers[i].var))
    inputs, curvature = _sites(anchor.inputs), _sites(anchor.curvature)
    return {"moments": tuple(moments), "inputs": inputs, "curvature": curvature}


def _sites(spectra: Mapping[str, Spectrum]) -> tuple[SiteSpectrum, ...]:
    """One entry per map; maps that share a spectrum follow the one that it is stored with."""
    followers = shared(spectra)
    found = []
    for leader, spectrum in spectra.items():
        if leader in followers:
            continue
        first = _site(leader, spectrum)
        others = [name for name, own in followers.items() if own == leader]
        found += [first, *(dataclasses.replace(first, name=x, same_as=leader) for x in others)]
    return tuple(found)


def _site(name: str, spectrum: Spectrum) -> SiteSpectrum:
    values, vectors = spectrum.values, spectrum.vectors
    if vectors is None:  # an embedding table: its directions are its rows
        read = int((values > 0).sum())
        return SiteSpectrum(name, spectrum.kind, len(values), (read,) * len(ENERGIES), None)
    # Dense [d, k]; elementwise [D, m, m], which keeps all.
    stored = vectors.shape[1] if vectors.ndim == 2 else values.numel()
    kept = tuple(rank(values, share) for share in ENERGIES)
    return SiteSpectrum(name, spectrum.kind, values.numel(), kept, stored)


def _moments(name: str, mean: Tensor, var: Tensor) -> LayerMoments:
    return LayerMoments(name, float(mean.double().norm()), float(var.double().sum()))


def of_ledger(path: Path, until: int | None = None) -> dict[str, Any]:
    """The energies of a ledger over all steps, or up to step `until`."""
    artifact = artifacts.load(path, "ledger")
    tensors, groups = artifact.tensors, artifact.header.meta["groups"]
    if until is not None:
        tensors = {name: rows[tensors["step"] <= until] for name, rows in tensors.items()}
    if not tensors["aa"].any():  # no anchor gradient was ever taken: nothing could be shed
        return {}
    layers = (
        LayerEnergy(g.name, g.energy_shed_mean, g.energy_shed_max, g.conflict)
        for g in ledger.summarize_groups(groups, tensors)
    )
    mean = ledger.energy_shed_mean(tensors)
    # A ledger has W2^2 of every layer, but inner products only of trainable groups.
    frozen = tuple(name for name in artifact.header.meta["layers"] if name not in groups)
    return {
        "layers": tuple(layers),
        "frozen": frozen,
        "over_time": _over_time(groups, tensors),
        "energy_shed_mean": mean,
    }


def _over_time(groups: list[str], tensors: Mapping[str, Tensor]) -> tuple[Bin, ...]:
    """The rows in at most `BINS` bins of (almost) equal length."""
    count = len(tensors["step"])
    edges = sorted({round(i * count / BINS) for i in range(BINS + 1)})  # fewer for a short run
    bins = []
    for first, end in pairwise(edges):
        bins.append(_bin(groups, {name: rows[first:end] for name, rows in tensors.items()}))
    return tuple(bins)


def _bin(groups: list[str], rows: Mapping[str, Tensor]) -> Bin:
    layers = tuple(g.energy_shed_mean for g in ledger.summarize_groups(groups, rows))
    return Bin(int(rows["step"][0]), int(rows["step"][-1]), ledger.energy_shed_mean(rows), layers)
