"""The setup of a guard: its options, an anchor that fits the model, and the method's parts."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Container, Generator, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from aegis_cli import methods
from aegis_cli.anchors import anchor_file
from aegis_cli.anchors.curvature import SIDES
from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError, few
from aegis_cli.common.ranks import Ranks
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.spectrum import DENSE
from aegis_cli.methods import kfac
from aegis_cli.methods.base import MethodContext, Parts
from aegis_cli.methods.site_weights import weights
from aegis_cli.models import structure, wrappers
from aegis_cli.models.wrappers import PlainNames, plain_names
from aegis_cli.recipes import policy
from aegis_cli.recipes.decoding import build
from aegis_cli.recipes.strict_yaml import Problem, refuse

SECTIONS = {"aegis": policy.Aegis, "nullspace": policy.Nullspace, "kfac": policy.Kfac}
_DENSE_KINDS = ("maps", "stem")  # kinds with linear maps and convolutions that `kfac` can protect
# Options that a guard supports at one value only: its gradients accumulate over any number of
# passes, it knows no schedule, and a method that only pulls leaves the task gradient alone.
_TRAINING_ALONE = {
    "idle": "moved",
    "refresh": 1,
    "fraction": 1.0,
    "growth": 0.0,
    "step": "proximal",
}
_IN_BACKBONE = "vlm."  # prefix of a Hugging Face model's names in an anchor from `aegis anchor`


@dataclass(frozen=True)
class StartedMethod:
    """A method that was started on the model.

    Attributes:
        parts: the parts of the method.
        widths: widths of the anchor's layers.
        unprotected: trainable modules that the method leaves free.
        sha256: hash of the anchor's file.
        fingerprint: that of the weights that the anchor was measured on.
        why_strong: why the model may learn little at a learning rate; None if it does learn.
    """

    parts: Parts
    widths: list[int]
    unprotected: tuple[str, ...]
    sha256: str
    fingerprint: str | None
    why_strong: Callable[[float], str | None]


def start(
    method: str,
    model: nn.Module,
    path: Path,
    layers: Mapping[str, nn.Module],
    groups: Mapping[str, Sequence[nn.Parameter]],
    vision: Sequence[str],
    options: Mapping[str, Any],
    owners: Ranks,
    part: str | None = None,
) -> StartedMethod:
    """Check options, anchor and model against each other, then start the method.

    Args:
        part: the name of the model within a policy, if it was given as a part of one.
        owners: the processes that each have some rows of every weight.

    Raises:
        AegisError: an option is unknown, the anchor is of another model or lacks the part that the
            method reads, or a trainable module cannot be protected.
    """
    chosen = method_options(method, options)
    anchor, header = load_anchor(method, path)
    plain = plain_names(model)
    with naming_its_part(model, path, part):
        if layers:
            _check_layers(anchor, list(map(plain, layers)), header.meta.get("layers"), path)
        plain = _names(model, header, path)
    sites: Mapping[str, str] = {}
    unprotected: tuple[str, ...] = ()
    if not methods.get(method).compares_layers:
        maps, dense = structure.find_maps(model, vision), method == "kfac"
        sites, unprotected = _protected(model, maps, chosen["protect"], "protect" in options, dense)
        unmeasured = header.meta.get("unmeasured", {})
        _check_adapters(model, sites, header, path)
        if dense:
            anchor = _renamed_curvature(anchor, sites, unmeasured, plain)
            unprotected = tuple(sorted({*unprotected, *_without_curvature(anchor, sites)}))
        else:
            anchor = _renamed(anchor, sites, maps.heads, unmeasured, plain)
    # In a model on several GPUs this is the device of the first trainable parameter.
    device = next(p for p in model.parameters() if p.requires_grad).device
    held = anchor_file.to_device(anchor, device)
    context = MethodContext(model, groups, sites, chosen, held, owners=owners)
    parts = methods.get(method).start(context)
    if parts.constrains:
        constrained = {site: weights(model, site)[0] for site in sites} or structure.learning(model)
        check_precision({name: tensor.dtype for name, tensor in constrained.items()})
    widths = [len(moments.mean) for moments in anchor.text]

    def why_strong(rate: float) -> str | None:
        if method != "kfac":
            return None
        return kfac.why_strong(chosen["weight"], rate, "weight")

    sha256 = artifacts.sha256_file(path)
    return StartedMethod(parts, widths, unprotected, sha256, header.fingerprint, why_strong)


def is_pretrained(model: nn.Module, fingerprint: str | None) -> bool:
    """Whether a model has exactly the weights that an anchor was measured on.

    Args:
        fingerprint: that of the anchor.
    """
    return any(structure.fingerprint(model, within=w) == fingerprint for w in ("", _IN_BACKBONE))


def method_options(method: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """The options with a recipe's defaults and checks, except that `every` defaults to 1.

    A constraint covers one step, because a user's loop may never call `settle`. In a recipe `kfac`
    has no key `protect`, as everything else is frozen; under a guard it may leave some maps free.

    Raises:
        AegisError: the method does not have an option, or a value is only for `aegis train`.
    """
    problems: list[Problem] = []
    every = {} if methods.get(method).compares_layers else {"every": 1}
    given: dict[str, Any] = every | dict(options)
    protect = {}
    if method == "kfac":
        protect["protect"] = _dense_kinds(given.pop("protect", _DENSE_KINDS))
    # The checks are made for YAML values, which include lists but no tuples.
    raw = {}
    for name, value in given.items():
        raw[name] = list(value) if isinstance(value, tuple) else value
    section = build(SECTIONS[method], raw, problems, f"{method}.")
    refuse(problems, "the guard's options")
    chosen = asdict(section)
    for name, default in _TRAINING_ALONE.items():
        if chosen.get(name, default) != default:
            raise AegisError(
                f"{name}={chosen[name]!r} of a guard",
                f"{name}={default!r}: other values are for `aegis train`, which takes its steps "
                "itself",
                f"leave {name}= out, or train with --set {method}.{name}={chosen[name]}",
            )
    return chosen | protect


def _dense_kinds(protect: str | Sequence[str]) -> tuple[str, ...]:
    given = structure.names(protect)
    if not given or set(given) - set(_DENSE_KINDS):
        raise AegisError(
            f"protect {', '.join(given) or '(none)'}",
            f"some of {', '.join(_DENSE_KINDS)}",
            f"protect={_DENSE_KINDS}, or leave it out",
        )
    return given


def load_anchor(method: str, path: Path) -> tuple[Anchor, artifacts.Header]:
    """The anchor, and the header of its file about the model and the measurement.

    Raises:
        AegisError: it is not an anchor, or lacks the part that the method reads.
    """
    artifact = artifacts.load(path, "anchor")
    (part,) = methods.get(method).needs
    anchor = anchor_file.only(anchor_file.from_artifact(artifact), [part])
    if not {"moments": anchor.image, "inputs": anchor.inputs, "curvature": anchor.curvature}[part]:
        raise AegisError(
            f"anchor '{path}' without {part} for method '{method}'",
            f"an anchor with {part}",
            f'measure it with Guard.measure(model, parts=("{part}",))',
        )
    return anchor, artifact.header


def _check_layers(
    anchor: Anchor, layers: Sequence[str], measured: list[str] | None, path: Path
) -> None:
    fix = "give layers= as for the anchor, or measure it again with Guard.measure"
    if len(anchor.image) != len(layers):
        raise AegisError(
            f"anchor '{path}' of {len(anchor.image)} layers",
            f"one of the model's {len(layers)} layers",
            fix,
        )
    if measured is not None and measured != list(layers):
        raise AegisError(
            f"anchor '{path}' of the layers {measured[0]} ... {measured[-1]}",
            f"{layers[0]} ... {layers[-1]}",
            fix,
        )


@contextlib.contextmanager
def naming_its_part(model: nn.Module, path: Path, part: str | None) -> Generator[None]:
    """Suggest `part=` if a model does not fit an anchor, but a part of it does.

    Raises:
        AegisError: the error from inside the block, with that advice.
    """
    try:
        yield
    except AegisError as error:
        found = None if part is not None else _measured_part(model, path)
        if found is None:
            raise
        raise AegisError(
            error.found,
            f"the part of the {type(model).__name__} that anchor '{path}' was measured on",
            f'part="{found}", and every other name as it is inside that part',
        ) from error


def _measured_part(model: nn.Module, path: Path) -> str | None:
    """The name of the part whose weights an anchor was measured on; None if there is none."""
    try:
        wanted = artifacts.read_header(path).fingerprint
    except AegisError:  # loading it later reports what is wrong
        return None
    if wanted is None:
        return None
    for name in structure.around_blocks(model):
        inside = structure.part_of(model, name)
        if is_pretrained(inside, wanted):
            return name
    return None


def _names(model: nn.Module, header: artifacts.Header, path: Path) -> PlainNames:
    """A function from the name of a part of the model to the anchor's name for it.

    Raises:
        AegisError: the anchor was measured on other weights.
    """
    plain = plain_names(model)
    if structure.fingerprint(model) == header.fingerprint:
        return plain
    # Names are part of the digest, and `aegis anchor` measures the model as a part `vlm`.
    if structure.fingerprint(model, within=_IN_BACKBONE) == header.fingerprint:
        return lambda name: _IN_BACKBONE + plain(name)
    expected, fix = "the pre-trained weights", "measure again with Guard.measure"
    if wrappers.adapted(model):
        raise AegisError(
            f"the weights and adapters are not those that anchor '{path}' was measured on"
            f"{anchor_file.measured_on(header)}",
            f"{expected}, and adapters that change nothing yet, as a fresh LoRA",
            "make the guard before trained adapters are loaded, and let them begin at zero "
            f"(neither pissa nor olora); or {fix}, with the adapters in place",
        )
    raise AegisError(
        f"the weights are not those that anchor '{path}' was measured on"
        f"{anchor_file.measured_on(header)}",
        f"{expected}, loaded in the type that they are stored in",
        f"make the guard before fine-tuned weights are loaded into the model, or {fix}",
    )


def _check_adapters(
    model: nn.Module, sites: Iterable[str], header: artifacts.Header, path: Path
) -> None:
    """Raise AegisError if adapters would be protected by the inputs of other adapters.

    The inputs of an adapter's maps depend on its own weights, which are random.
    """
    held = wrappers.adapter_weights(model)
    inside = [site for site in sites if any(name.startswith(f"{site}.") for name in held)]
    measured = header.meta.get("adapted")
    if not inside or measured == structure.fingerprint(model, adapters=True):
        return
    if measured is not None:
        raise AegisError(
            f"anchor '{path}' was measured with adapters of other values than these: {few(inside)}",
            "the adapters that were measured: fresh ones begin at random values",
            "save them before you measure (model.save_pretrained(folder)) and load them here "
            "(PeftModel.from_pretrained(base, folder, is_trainable=True)), or measure these",
        )
    raise AegisError(
        f"anchor '{path}' was measured without these adapters: {few(inside)}",
        "an anchor of the model with its adapters, since they are what learns",
        "put the adapters into the model, measure it with Guard.measure, and make the guard of "
        'the same model; or use method="aegis", which takes an anchor of the model alone',
    )


# --- constraints on the applied update ------------------------------------------------------------


def _protected(
    model: nn.Module, maps: structure.Maps, protect: Sequence[str], explicit: bool, dense: bool
) -> tuple[dict[str, str], tuple[str, ...]]:
    """The sites to protect with their kinds, and the names of trainable modules left free.

    Args:
        dense: only linear maps and convolutions can be protected.
    """
    all_kinds = _DENSE_KINDS if dense else policy.SITE_KINDS
    # Frozen sites cannot move and need no protection.
    kinds = {site: kind for site, kind in maps.kinds.items() if not structure.frozen(model, site)}
    unknown = {
        name: why for name, why in maps.unknown.items() if _learns(model.get_submodule(name))
    }
    if dense:
        modules = structure.site_modules(model, kinds)
        for site in kinds:
            module = modules.get(site)
            if not isinstance(module, DENSE):
                why = "a row by itself" if module is None else f"a {type(module).__name__}"
                unknown[site] = why
        kinds = {site: kind for site, kind in kinds.items() if site not in unknown}
    # Naming the kinds to protect is a decision about all others too.
    if unknown and not explicit:
        raise AegisError(
            f"learning modules that cannot be protected: {_by_reason(unknown)}",
            "linear maps and convolutions" + ("" if dense else ", normalisations and embeddings"),
            "freeze them: requires_grad_(False); or leave only them free, by naming every "
            f"kind: protect={all_kinds}",
        )
    chosen = {site: kind for site, kind in kinds.items() if kind in protect}
    if not chosen:
        raise AegisError(
            f"nothing that learns is of the kinds {', '.join(protect)}",
            "a map to protect",
            f"leave protect= out, or name kinds that learn: {', '.join(all_kinds)}",
        )
    return chosen, tuple(sorted({*unknown, *(kinds.keys() - chosen.keys())}))


def _learns(module: nn.Module) -> bool:
    return any(p.requires_grad for p in module.parameters(recurse=False))


def _by_reason(unknown: Mapping[str, str]) -> str:
    """Names by reason, such as "a RMSNorm (norm1, norm2, ... 17 in all); ..."."""
    grouped: dict[str, list[str]] = {}
    for name, why in unknown.items():
        grouped.setdefault(why, []).append(name or "the model itself")
    return "; ".join(f"{why} ({few(names)})" for why, names in grouped.items())


def check_precision(dtypes: Mapping[str, torch.dtype]) -> None:
    """Refuse weights in half precision.

    An update that is projected and then rounded to half precision is no longer orthogonal: the
    rounding error is as large as the update.
    """
    half = [site for site, dtype in dtypes.items() if dtype not in (torch.float32, torch.float64)]
    if half:
        raise AegisError(
            f"weights in {dtypes[half[0]]}: {few(half)}",
            "float32 weights",
            "model.float(), and torch.autocast for fast products",
        )


def _renamed(
    anchor: Anchor,
    sites: Collection[str],
    heads: Container[str],
    unmeasured: Mapping[str, str],
    plain: PlainNames,
) -> Anchor:
    """The inputs of these sites, and of their tied heads, under their names in this model."""
    wanted = {site: plain(site) for site in sites}
    for site in sites:
        scores = f"{plain(site)}.scores"
        # A head that is not a module is known only from the measurement on questions.
        if site in heads or scores in anchor.inputs:
            wanted[f"{site}.scores"] = scores
    _check_measured("inputs", wanted.values(), anchor.inputs, unmeasured)
    inputs = {name: anchor.inputs[known] for name, known in wanted.items()}
    return Anchor(anchor.image, anchor.text, inputs)


def _renamed_curvature(
    anchor: Anchor, sites: Collection[str], unmeasured: Mapping[str, str], plain: PlainNames
) -> Anchor:
    """Both factors of these sites under their names in this model."""
    wanted = {f"{site}.{side}": f"{plain(site)}.{side}" for site in sites for side in SIDES}
    measured = {name.rpartition(".")[0] for name in anchor.curvature}
    _check_measured("curvature", dict.fromkeys(map(plain, sites)), measured, unmeasured)
    return Anchor(curvature={name: anchor.curvature[known] for name, known in wanted.items()})


def _without_curvature(anchor: Anchor, sites: Collection[str]) -> list[str]:
    """The sites on which no answer depended when the anchor was measured; they are unprotected.

    An example is the first map of a fresh LoRA, whose second map is zero.
    """
    side = SIDES[1]
    return [site for site in sites if not torch.any(anchor.curvature[f"{site}.{side}"].values)]


def _check_measured(
    part: str, wanted: Iterable[str], found: Container[str], unmeasured: Mapping[str, str]
) -> None:
    if missing := [name for name in wanted if name not in found]:
        reasons = "".join(f"; {unmeasured[name]}" for name in missing[:1] if name in unmeasured)
        raise AegisError(
            f"an anchor without the {part} of {few(missing)}{reasons}",
            f"the {part} of every protected map",
            "freeze it, or measure again with questions that use it",
        )
