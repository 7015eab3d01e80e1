"""The four methods of deciding what a map keeps of its displacement."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch

from aegis_cli.anchors import anchor_file, curvature, inputs
from aegis_cli.anchors.curvature import SIDES
from aegis_cli.common import devices
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.curvature import curvatures
from aegis_cli.core.merging import TwoSided, basis, damped
from aegis_cli.core.pairs import Pair, minus, present
from aegis_cli.core.spectrum import Spectrum
from aegis_cli.data.vqa import sets
from aegis_cli.merging.displacement import Keep
from aegis_cli.merging.settings import MergeSettings
from aegis_cli.merging.sources import Source, has_moved
from aegis_cli.merging.task_factors import dense_sites
from aegis_cli.methods.site_weights import weights
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.recipes import MERGE_NEEDS

_CPU = torch.device("cpu")  # eigenvectors are computed there, one map at a time


def keep(source: Source, settings: MergeSettings, on_event: OnEvent) -> Keep:
    """The method's rule, after measuring everything that it reads.

    Raises:
        AegisError: no map has moved, an anchor of another model or without the method's part, or
            nothing that shows what the task needs.
    """
    if settings.method == "linear":
        return lambda _, moved, strength: _scaled(moved, 1 - strength)
    part = MERGE_NEEDS[settings.method]
    # Maps that the user froze have no displacement, and the anchor may lack them.
    sites = [site for site in dense_sites(source.backbone) if _moved(source, site)]
    if not sites:
        raise AegisError(
            f"no linear map or convolution that has moved, of which '{settings.method}' says what "
            "is kept",
            "some that have: normalisations, tables and lone rows alone do not tell",
            "--method linear, which moves all parameters back alike",
        )
    given = None if settings.anchor is None else _given(settings.anchor, source, settings, part)
    if settings.method == "kfac-shrink":
        anchor = given or _measured(source.base, settings, part, on_event)
        return _shrink(source, anchor, sites, settings.damping)
    task = source.task_spectra(part)  # at the fine-tuned weights, before they are changed
    anchor = given or _measured(source.base, settings, part, on_event)
    sides = SIDES if settings.method == "factors" else None
    return _two_sided(task, getattr(anchor, part), sites, sides, settings.damping)


def _moved(source: Source, site: str) -> bool:
    now = present(weights(source.backbone, site))
    before = present(weights(source.base, site))
    return any(has_moved(source, *pair) for pair in zip(now, before, strict=True))


def _given(path: Path, source: Source, settings: MergeSettings, part: str) -> Anchor:
    """The part of an anchor in a file.

    Raises:
        AegisError: no anchor, an anchor of another model, or one without the part.
    """
    base = source.base
    wanted = anchor_file.Wanted(
        base.fingerprint(), source.base_name, "--base ", prepares=base.preparation()
    )
    found = anchor_file.load(path, wanted)
    if not getattr(found, part):
        raise AegisError(
            f"an anchor without {part} for method '{settings.method}'",
            f"an anchor of the pre-trained backbone with its {part}",
            f"measure it: aegis anchor --parts {part}; or leave --anchor out",
        )
    return anchor_file.only(found, {part})


def _measured(base: Backbone, settings: MergeSettings, part: str, on_event: OnEvent) -> Anchor:
    """The part of an anchor, measured on questions."""
    source = sets.read(settings.vqa, settings.skip_bad, on_event, settings.ask)
    asked = source.choose("anchor", settings.samples, 0, [base.check_text], on_event)
    asked = asked.sized(base.image_size)
    if part == "inputs":
        return Anchor(inputs=inputs.measure(base, asked, 1.0, settings.batch_size, on_event))
    entropy = curvature.AnswerEntropy()
    measured = curvature.measure(
        base,
        asked,
        1.0,
        0,
        settings.batch_size,
        on_event,
        temperature=settings.temperature,
        entropy=entropy,
    )
    curvature.warn_of_sure_answers(
        entropy.mean(),
        settings.temperature,
        "merge",
        "a merge may return less of what others ask: merge with --temperature 4, which takes "
        "smaller strengths, or with harder questions",
        on_event,
    )
    return Anchor(curvature=measured)


# --- one side -------------------------------------------------------------------------------------


def _scaled(moved: Pair, share: float) -> Pair:
    weight, bias = moved
    return share * weight, None if bias is None else share * bias


def _shrink(source: Source, anchor: Anchor, sites: list[str], damping: float) -> Keep:
    """One proximal step of the method `kfac` from the fine-tuned weights."""
    likes = {site: weights(source.base, site)[0] for site in sites}
    found = curvatures(anchor, likes, damping)

    def kept(site: str, moved: Pair, strength: float) -> Pair:
        if site not in found:  # it has not moved
            return moved
        return minus(moved, found[site].excess(*moved, strength))

    return kept


# --- two sides ------------------------------------------------------------------------------------


def _two_sided(
    task: dict[str, Spectrum],
    questions: Mapping[str, Spectrum],
    sites: list[str],
    sides: tuple[str, str] | None,
    damping: float,
) -> Keep:
    """What `core.merging.TwoSided` keeps of each map.

    Args:
        task: the task's spectra; each is dropped once its map's bases are made.
        sites: the maps that have moved.
        sides: names of both factors; None: inputs only, by the map's own name.
    """
    names = {}  # the names of each map's spectra: one, or one per side
    for site in sites:
        names[site] = [f"{site}.{side}" for side in sides] if sides else [site]
    wanted = {name for own in names.values() for name in own}
    missing = sorted(wanted - questions.keys())
    if missing:
        raise AegisError(
            f"an anchor without {', '.join(missing)}",
            "that of every map that has moved",
            "measure it again with aegis anchor, or leave --anchor out",
        )
    bases: dict[str, TwoSided] = {}
    with devices.single_threaded():  # the eigensolver waits for its own threads
        for site, own in names.items():
            if not all(name in task for name in own):
                continue  # the task does not depend on the map
            pairs = [(task.pop(name), questions[name]) for name in own]
            if not any(_directions(spectrum) for spectrum in pairs[-1]):
                pairs = pairs[:1]  # only the outputs' traces are known: all directions are alike
            found = []
            for of_task, of_questions in pairs:
                found.append(basis(damped(of_task, damping), damped(of_questions, damping)))
            bases[site] = TwoSided(*found)
    moving = frozenset(sites)

    def kept(site: str, moved: Pair, strength: float) -> Pair:
        if site not in moving:
            return moved
        if site not in bases:  # the task does not need it: back to the pre-trained weights
            return _scaled(moved, 0)
        # The bases are on the CPU, where they were found.
        weight, _ = moved
        kept_there = bases[site].kept(_sent(moved, _CPU), strength)
        return _sent(kept_there, weight.device)

    return kept


def _directions(spectrum: Spectrum) -> int:
    return 0 if spectrum.vectors is None else spectrum.vectors.shape[1]


def _sent(pair: Pair, device: torch.device) -> Pair:
    weight, bias = pair
    return weight.to(device), None if bias is None else bias.to(device)
