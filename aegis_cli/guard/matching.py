"""Identify, by their values, which of an optimizer's unnamed parameters belong to a VLM.

A program that accepts nothing but an optimizer gives it parameters without names. Before any
training, the values of a parameter tell which weight of the VLM it is.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from difflib import SequenceMatcher

import torch
from torch import Tensor

from aegis_cli.common.errors import AegisError, few
from aegis_cli.core.pairs import Pair
from aegis_cli.methods.site_weights import weights
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.models.structure import digest

# The dtypes in which a program may hold a VLM that is stored in float32, in search order.
_TYPES = (torch.float32, torch.bfloat16, torch.float16)
# The largest distance, relative to its norm, that a weight is assumed to move by learning.
# Unrelated weights are farther apart than the norm of either.
_NEAR = 0.5


def ids(found: Mapping[str, Pair]) -> set[int]:
    """The ids of the sites' parameters."""
    return {id(tensor) for pair in found.values() for tensor in pair if tensor is not None}


def match(
    base: Mapping[str, Pair], ordered: Sequence[Tensor], claimed: Collection[int] = ()
) -> dict[str, Pair]:
    """The parameters that have the values of the base model's sites, by site.

    A program may have rounded the VLM, which is stored in float32. So if no parameter has the exact
    values of a site, those with its rounded values match.

    Args:
        claimed: ids of parameters that are known to be something else.

    Raises:
        AegisError: several sites have equal values but the number of matching parameters differs,
            or a weight lacks its bias.
    """
    # Parameters of a shape that the VLM does not have are not read at all.
    shapes = {tensor.shape for pair in base.values() for tensor in pair if tensor is not None}
    places: dict[str, list[int]] = {}
    for place, parameter in enumerate(ordered):
        if parameter.shape in shapes and id(parameter) not in claimed:
            places.setdefault(_values(parameter), []).append(place)
    found: dict[str, Pair] = {}
    # float32 first: if the exact values of a site are found, its rounded ones are not tried.
    for dtype in _TYPES:
        rest = {site: pair for site, pair in base.items() if site not in found}
        found |= _match_in(dtype, rest, ordered, places)
    return found


def _match_in(
    dtype: torch.dtype,
    base: Mapping[str, Pair],
    ordered: Sequence[Tensor],
    places: Mapping[str, Sequence[int]],
) -> dict[str, Pair]:
    """The parameters that have the values of the base model's sites in one dtype, by site.

    Args:
        places: indices of the parameters, by their values.
    """
    alike: dict[str, list[str]] = {}
    for site, (weight, _) in base.items():
        alike.setdefault(_values(weight.to(dtype)), []).append(site)
    found: dict[str, Pair] = {}
    for values, sites in alike.items():
        at = places.get(values, [])
        if at and len(at) != len(sites):
            raise AegisError(
                f"{len(at)} parameters with the values of {few(sites)}",
                f"{len(sites)}, to tell which is which",
                "freeze them in the policy, and leave only their kind out of protect=: what "
                "is left free can undo what the others hold",
            )
        # Without a match, nothing is found: the VLM is truncated, or has already learned. Sites
        # with equal values, such as tied or freshly initialised ones, are identified by order.
        for site, place in zip(sites, at, strict=False):
            found[site] = (ordered[place], _bias(site, base[site][1], place, ordered, places))
    return found


def _bias(
    site: str,
    value: Tensor | None,
    place: int,
    ordered: Sequence[Tensor],
    places: Mapping[str, Sequence[int]],
) -> Tensor | None:
    """The bias of the weight at an index: the next parameter, or the only one with its values."""
    if value is None:
        return None
    at = next((places[v] for v in _in_each_type(value) if v in places), ())
    if place + 1 in at:
        return ordered[place + 1]
    if len(at) == 1:
        return ordered[at[0]]
    raise AegisError(
        f"a parameter with the values of {site}.weight, and {len(at)} that may be its bias",
        "the bias after its weight, as a model has them",
        "give the optimizer the parameters in the model's order, and both or neither of a map",
    )


def refuse_half_frozen(found: Mapping[str, Pair]) -> None:
    """Refuse a map of which only the weight or only the bias learns.

    A frozen half cannot compensate for changes of the other.

    Raises:
        AegisError: there is one.
    """
    for site, (weight, bias) in found.items():
        if bias is not None and weight.requires_grad != bias.requires_grad:
            still = "bias" if weight.requires_grad else "weight"
            raise AegisError(
                f"{site} of the base model in the policy, of which only the {still} is frozen",
                "both frozen, or neither",
                "freeze both or neither",
            )


def refuse_strays(
    base: Mapping[str, Pair], found: Mapping[str, Pair], ordered: Sequence[Tensor]
) -> None:
    """Refuse trainable parameters that belong to a map of the VLM that was not found.

    A map may be missing, as in a VLM with fewer layers. But a map that is there with other values
    would learn unprotected, and so would a table with more rows.

    Raises:
        AegisError: there is a weight that has moved, a table of another size, or a bias without its
            weight.
    """
    free = _free(found, ordered)
    for site in sorted(base.keys() - found.keys()):
        weight, bias = base[site]
        _refuse_resized(site, weight, free)
        if any(_near(parameter, weight) for parameter in free.get(weight.shape, ())):
            raise AegisError(
                f"a parameter {list(weight.shape)} near {site} of the base model, and "
                f"{len(found)} of its {len(base)} maps with their own values",
                "a policy whose VLM still has the base model's weights, in a type that holds them",
                "name the VLM that the policy begins with as the base, and measure its anchor; or "
                "resume with the optimizer's state",
            )
        # Constant biases, such as those initialised to 0, could belong to anything.
        if bias is None or bool((bias == bias[0]).all()):
            continue
        if any(torch.equal(on_cpu(p), bias) for p in free.get(bias.shape, ())):
            raise AegisError(
                f"the bias of {site} of the base model among what learns, but not its weight",
                "both frozen, or neither",
                "freeze both or neither",
            )


def refuse_lost(
    lost: Mapping[str, Tensor],
    base: Mapping[str, Pair],
    found: Mapping[str, Pair],
    ordered: Sequence[Tensor],
) -> None:
    """Refuse trainable parameters that belong to the VLM and that `kfac` could not freeze.

    If no map of a layer was found, the layer is missing, and so are its parameters.

    Args:
        lost: values of the VLM's parameters that belong to no map and were not found, by name.
        base: the VLM's maps, some of which were found.

    Raises:
        AegisError: there is one that has moved, or a table of another size.
    """
    free = _free(found, ordered)
    for name, value in lost.items():
        if not _is_there(name, base.keys(), found.keys()):
            continue
        _refuse_resized(name, value, free)
        if any(_near(parameter, value) for parameter in free.get(value.shape, ())):
            raise AegisError(
                f"a parameter {list(value.shape)} near {name} of the base model, which learns, and "
                "kfac protects only linear maps and convolutions",
                "normalisations and tables with the base model's values, which are frozen, or "
                "frozen ones among the optimizer's parameters",
                "freeze it; aegis_nullspace protects one that has not learned before",
            )


def _is_there(name: str, sites: Collection[str], found: Collection[str]) -> bool:
    """Whether any map was found in the innermost part of the VLM around the parameter with maps."""
    part = name
    while part:
        part = part.rpartition(".")[0]
        inside = [site for site in sites if not part or site.startswith(f"{part}.")]
        if inside:
            return any(site in found for site in inside)
    return False


def _refuse_resized(name: str, table: Tensor, free: Mapping[torch.Size, Sequence[Tensor]]) -> None:
    """Refuse a table with extra rows after those of the VLM's, which would learn unprotected."""
    for shape, parameters in free.items():
        if table.ndim != 2 or shape[1:] != table.shape[1:] or len(shape) != 2:
            continue
        if shape[0] > len(table) and any(_near(p[: len(table)], table) for p in parameters):
            raise AegisError(
                f"a parameter {list(shape)} whose first rows are near {name} {list(table.shape)} "
                "of the base model, as resize_token_embeddings leaves it",
                "a table of the base model's size, or one that is frozen",
                "freeze it; or give the base model's the same rows, save it, measure its anchor, "
                "and name it as the base",
            )


def _free(found: Mapping[str, Pair], ordered: Sequence[Tensor]) -> dict[torch.Size, list[Tensor]]:
    """Trainable parameters that were not identified as the VLM's, by shape."""
    claimed = ids(found)
    free: dict[torch.Size, list[Tensor]] = {}
    for parameter in ordered:
        if parameter.requires_grad and id(parameter) not in claimed:
            free.setdefault(parameter.shape, []).append(parameter)
    return free


def _near(parameter: Tensor, weight: Tensor) -> bool:
    """Whether a parameter may be this weight after training or rounding."""
    now = on_cpu(parameter)
    # A constant tensor is a freshly initialised normalisation.
    if bool((now == now.flatten()[0]).all()):
        return False
    return bool((now - weight).norm() <= _NEAR * weight.norm())


def on_cpu(tensor: Tensor) -> Tensor:
    """The values in float32 on the CPU, comparable across devices and dtypes."""
    return tensor.detach().cpu().float()


def _values(tensor: Tensor) -> str:
    """A digest of shape and values, independent of the dtype."""
    return digest({"": tensor})


def _in_each_type(tensor: Tensor) -> Iterator[str]:
    """Digests of its values in float32 and rounded to each narrower dtype."""
    return (_values(tensor.to(dtype)) for dtype in _TYPES)


def freeze_rest(
    base: Backbone, protected: Iterable[str], groups: Sequence[Mapping[str, Sequence[Tensor]]]
) -> tuple[list[tuple[str, Tensor]], dict[str, Tensor]]:
    """Freeze all parameters of the VLM except those of its protected maps.

    They are identified by their values. An expert may have parameters with equal values, such as
    normalisations in their initial state; among these, the order of the VLM's parameters decides
    which are frozen.

    Args:
        protected: the sites that learn.
        groups: the optimizer's parameter groups.

    Returns:
        The frozen parameters with their names; and by name the VLM's parameters whose values too
        few of the optimizer's parameters have, on the CPU. They may have learned before.
    """
    held = {id(t) for site in protected for t in weights(base, site) if t is not None}
    in_groups = [(group["params"], [_values(p) for p in group["params"]]) for group in groups]
    # `given` counts the optimizer's parameters by their values, `others` those of the VLM that are
    # to be frozen; `sequence` lists all parameters of the VLM in its order.
    given = Counter(value for _, values in in_groups for value in values)
    named, sequence = list(base.named_parameters()), []
    for _, parameter in named:
        known = next((v for v in _in_each_type(parameter) if v in given), "")
        sequence.append((known or _values(parameter), id(parameter) in held))
    others = Counter(value for value, is_held in sequence if not is_held)
    held_values = {value for value, is_held in sequence if is_held}
    lost: dict[str, Tensor] = {}
    for (name, parameter), (value, is_held) in zip(named, sequence, strict=True):
        if not is_held and given[value] < others[value]:
            lost[name] = on_cpu(parameter)
    # Ambiguous values: more parameters have them than the VLM has to freeze, or a protected one has
    # them too. Then the order in the group decides.
    unclear = {v for v, count in others.items() if given[v] > count or v in held_values}
    names = {value: name for (name, _), (value, _) in zip(named, sequence, strict=True)}
    frozen: list[tuple[str, Tensor]] = []
    for parameters, values in in_groups:
        others_here = _in_order(sequence, values) if unclear & set(values) else set()
        for place, (parameter, value) in enumerate(zip(parameters, values, strict=True)):
            is_other = place in others_here if value in unclear else value in others
            if is_other:
                parameter.requires_grad_(False)
                parameter.grad = None  # AdamW would still apply an existing gradient
                frozen.append((names[value], parameter))
    return frozen, lost


def _in_order(sequence: Sequence[tuple[str, bool]], values: Sequence[str]) -> set[int]:
    """The indices of the VLM's unprotected parameters in one of the optimizer's groups.

    Args:
        sequence: the values of the VLM's parameters, and whether each is protected.
        values: the values of the group's parameters, which may include only some of the VLM's, and
            others.
    """
    # Both sequences have the VLM's parameters in its order; the group's other parameters lie in
    # between. The matching blocks are the VLM's.
    here = set(values)
    expected = [pair for pair in sequence if pair[0] in here]
    matcher = SequenceMatcher(None, [value for value, _ in expected], values, autojunk=False)
    found = set()
    for start, place, length in matcher.get_matching_blocks():
        for i in range(length):
            _, is_held = expected[start + i]
            if not is_held:
                found.add(place + i)
    return found
