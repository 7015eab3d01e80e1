"""What a guard begins with: options, an anchor that fits the model, and the method's parts at work."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from aegis_cli import artifacts, methods, sections
from aegis_cli.core.anchor import Anchor
from aegis_cli.errors import AegisError
from aegis_cli.guard import structure
from aegis_cli.guard.structure import plain
from aegis_cli.methods.base import Parts, Setting, weights
from aegis_cli.stages import anchor_file
from aegis_cli.strict_yaml import Problem, build, refuse

_SECTIONS = {"aegis": sections.Aegis, "nullspace": sections.Nullspace}
_NAMED = 4  # modules that an error names of each type


@dataclass(frozen=True)
class Begun:
    """A method at work on the model.

    Attributes:
        parts: what it does.
        widths: of the anchor's layers.
        unprotected: learning modules that the method leaves free.
        sha256: of the anchor's file.
    """

    parts: Parts
    widths: list[int]
    unprotected: tuple[str, ...]
    sha256: str


def start(
    method: str, model: nn.Module, path: Path, layers: Mapping[str, nn.Module], groups: Mapping[str, Sequence[nn.Parameter]],
    vision: Sequence[str], options: Mapping[str, Any],
) -> Begun:  # fmt: skip
    """Check everything against everything, then start the method.

    Raises:
        AegisError: unknown options, an anchor of another model or without the part that the method reads, or what
            learns and cannot be protected.
    """
    chosen = _options(method, options)
    anchor, header = _load(method, path)
    if layers:
        _check_layers(anchor, list(layers), header.meta.get("layers"), path)
    if structure.fingerprint(model) != header.fingerprint:
        raise AegisError(
            f"the weights are not those that anchor '{path}' was measured on",
            "the pre-trained weights",
            "make the guard before fine-tuned weights are loaded into the model, or measure again with Guard.measure",
        )
    sites: Mapping[str, str] = {}
    unprotected: tuple[str, ...] = ()
    if method == "nullspace":
        sites, unprotected, anchor = _protected(model, anchor, header.meta, vision, chosen["protect"], "protect" in options)
    device = next(p for p in model.parameters() if p.requires_grad).device
    setting = Setting(model, groups, sites, chosen, anchor_file.to_device(anchor, device))
    parts = methods.get(method).start(setting)
    if parts.constrain is not None:
        constrained = {site: weights(model, site)[0] for site in sites} or structure.learning(model)
        _check_precision({name: tensor.dtype for name, tensor in constrained.items()})
    widths = [len(moments.mean) for moments in anchor.text]
    return Begun(parts, widths, unprotected, artifacts.sha256_file(path))


def _options(method: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """The recipe's defaults and checks, but `every`: a projection covers one step where nobody promises to settle."""
    problems: list[Problem] = []
    every = {"every": 1} if method == "nullspace" else {}
    raw = {name: list(value) if isinstance(value, tuple) else value for name, value in (every | dict(options)).items()}
    section = build(_SECTIONS[method], raw, problems, f"{method}.")
    refuse(problems, "the guard's options")
    return asdict(section)


def _load(method: str, path: Path) -> tuple[Anchor, artifacts.Header]:
    """The anchor, and what its file says of the model and of how it was measured."""
    artifact = artifacts.load(path, "anchor")
    anchor = anchor_file.from_tensors(artifact.tensors)
    (part,) = sections.NEEDS[method]
    if not {"moments": anchor.image, "inputs": anchor.inputs}[part]:
        raise AegisError(
            f"anchor '{path}' without {part} for method '{method}'",
            f"an anchor with {part}",
            f'measure it with Guard.measure(model, parts=("{part}",))',
        )
    return anchor, artifact.header


def _check_layers(anchor: Anchor, layers: Sequence[str], measured: list[str] | None, path: Path) -> None:
    fix = "give layers= as for the anchor, or measure it again with Guard.measure"
    if len(anchor.image) != len(layers):
        raise AegisError(f"anchor '{path}' of {len(anchor.image)} layers", f"one of the model's {len(layers)} layers", fix)
    if measured is not None and measured != [plain(name) for name in layers]:
        raise AegisError(
            f"anchor '{path}' of the layers {measured[0]} ... {measured[-1]}", f"{layers[0]} ... {layers[-1]}", fix
        )


# --- the null-space method ------------------------------------------------------------------------


def _protected(
    model: nn.Module, anchor: Anchor, meta: Mapping[str, Any], vision: Sequence[str], protect: Sequence[str], explicit: bool
) -> tuple[dict[str, str], tuple[str, ...], Anchor]:
    """The sites to protect with their kinds, what learns and stays free, and the anchor by this model's names."""
    maps = structure.find_maps(model, vision)
    kinds = {site: kind for site, kind in maps.kinds.items() if not structure.frozen(model, site)}
    unknown = {name: why for name, why in maps.unknown.items() if _learns(model.get_submodule(name))}
    if unknown and not explicit:
        raise AegisError(
            f"learning modules that cannot be protected: {_by_reason(unknown)}",
            "linear maps, convolutions, normalisations and embeddings",
            'freeze them, or leave them free by naming what is protected: protect=("maps", "embeddings")',
        )
    chosen = {site: kind for site, kind in kinds.items() if kind in protect}
    if not chosen:
        raise AegisError(
            f"nothing that learns is of the kinds {', '.join(protect)}", "a map to protect", "choose other kinds in protect="
        )
    free = tuple(sorted({*unknown, *(kinds.keys() - chosen.keys())}))
    return chosen, free, _renamed(anchor, chosen, maps.heads, meta.get("unmeasured", {}))


def _learns(module: nn.Module) -> bool:
    return any(p.requires_grad for p in module.parameters(recurse=False))


def _by_reason(unknown: Mapping[str, str]) -> str:
    """a RMSNorm (norm1, norm2, ... 17 in all); ..."""
    grouped: dict[str, list[str]] = {}
    for name, why in unknown.items():
        grouped.setdefault(why, []).append(name or "the model itself")
    return "; ".join(f"{why} ({_few(names)})" for why, names in grouped.items())


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:_NAMED]) + (f", ... {len(names)} in all" if len(names) > _NAMED else "")


def _check_precision(dtypes: Mapping[str, torch.dtype]) -> None:
    """An update projected and rounded to half precision is not orthogonal: the rounding is as large as the update."""
    half = [site for site, dtype in dtypes.items() if dtype not in (torch.float32, torch.float64)]
    if half:
        raise AegisError(
            f"weights in {dtypes[half[0]]}: {_few(half)}",
            "float32 weights",
            "model.float(), and torch.autocast for fast products",
        )


def _renamed(anchor: Anchor, sites: Mapping[str, str], heads: Mapping[str, str], unmeasured: Mapping[str, str]) -> Anchor:
    """The inputs of these sites under the names they have in this model, those of tied heads among them."""
    wanted = {site: plain(site) for site in sites}
    for site in sites:
        scores = f"{plain(site)}.scores"
        if site in heads or scores in anchor.inputs:  # a head that is no module is known from the questions alone
            wanted[f"{site}.scores"] = scores
    if missing := [name for name in wanted.values() if name not in anchor.inputs]:
        reasons = "".join(f"; {unmeasured[name]}" for name in missing[:1] if name in unmeasured)
        raise AegisError(
            f"an anchor without the inputs of {_few(missing)}{reasons}",
            "the inputs of every protected map",
            "freeze it, leave its kind out of protect=, or measure again with questions that use it",
        )
    return Anchor(anchor.image, anchor.text, {name: anchor.inputs[known] for name, known in wanted.items()})
