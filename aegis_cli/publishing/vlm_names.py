"""Find the tensors of the VLM in a robot policy that was made from it, by name and shape.

A policy has its VLM under a prefix, such as `model.vlm_with_expert.vlm.`, and an action expert
whose layers have the same names. Releases of transformers name a VLM's parts in several ways; `key`
gives one name for all of them.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from aegis_cli.common import commands
from aegis_cli.common.errors import AegisError, few

# Parts of names that some releases of transformers have and others do not:
# `language_model.model.layers.0`, `model.language_model.layers.0` and `model.layers.0` are one.
_WRAPPERS = ("model", "language_model", "text_model")
# Parts that torch.compile, checkpointing and sharding put before the names of what they wrap.
_COMPILED = ("_orig_mod", "_checkpoint_wrapped_module", "_fsdp_wrapped_module")
_LANGUAGE = ("embed_tokens", "layers", "norm", "lm_head")  # first parts of the text model's keys
_LAYER = re.compile(r"layers\.(\d+)\.")
TABLE, HEAD = "embed_tokens.weight", "lm_head.weight"
# Tensors whose first axis is the vocabulary. PaliGemma's repositories have 257,216 rows, and pi0,
# which was made from them, 257,152; the remaining rows were added for transformers.
_OF_WORDS = (TABLE, HEAD, "lm_head.bias")
_FLOATS = ("F64", "F32", "F16", "BF16")
_BUFFERS = ("position_ids", "inv_freq")


class Spec(NamedTuple):
    """A tensor's shape, and safetensors' name of its dtype."""

    shape: tuple[int, ...]
    dtype: str

    @property
    def is_float(self) -> bool:
        """Whether its dtype is a floating-point type."""
        return self.dtype in _FLOATS


Specs = Mapping[str, Spec]


@dataclass(frozen=True)
class Kept:
    """Tensors of the VLM that the policy does not have."""

    what: str
    why: str
    names: tuple[str, ...]


@dataclass(frozen=True)
class Match:
    """Where a policy has a VLM's tensors.

    Attributes:
        prefix: the prefix of the VLM's names in the policy.
        taken: the VLM's name -> the policy's. If table and head are tied, both of a VLM's names may
            map to the same name in the policy.
        rows: the VLM's name -> number of common rows, for tables of different lengths.
        kept: what the policy does not have.
        second: the policy's name of the table or head that the VLM lacks, being tied to the other,
            and the policy's name of that other one; None if the policy has at most one of them, or
            the VLM has both.
        more: the policy's names under the prefix that the VLM does not have.
        others: prefixes of further VLMs with the same names and shapes, one of which was chosen.
    """

    prefix: str
    taken: Mapping[str, str]
    rows: Mapping[str, int]
    kept: tuple[Kept, ...]
    second: tuple[str, str] | None
    more: tuple[str, ...]
    others: tuple[str, ...] = ()


@dataclass(frozen=True)
class Asked:
    """What a command was given, for the search and for its errors.

    Attributes:
        policy, vlm: their names, as the user gave them.
        prefix: which of several VLMs to take, by the beginning of its tensors' names; None: the
            only one.
        command: the words of the command, without the prefix.
    """

    policy: str
    vlm: str
    prefix: str | None = None
    command: tuple[str, ...] = ()


def key(name: str) -> str:
    """One name for a tensor of a VLM, whichever release of transformers named it.

    It is the same if the tensor's module was compiled.
    """
    found: list[str] = []
    for part in name.split("."):
        # As in CLIP and SigLIP until transformers 5.5.
        of_tower = part == "vision_model" and found[-1:] == ["vision_tower"]
        if part not in (*_WRAPPERS, *_COMPILED) and not of_tower:
            found.append(part)
    return ".".join(found)


def is_vlm(names: Iterable[str]) -> bool:
    """Whether these are the names of a model with language layers and a vision part."""
    keys = [key(name) for name in names]
    return any(map(_LAYER.match, keys)) and any(not _is_language(found) for found in keys)


def pair_of_tables(specs: Specs) -> tuple[str, str] | None:
    """The names of a VLM's table and head if the file has both, else None."""
    named = {key(name): name for name in specs}
    return (named[TABLE], named[HEAD]) if TABLE in named and HEAD in named else None


def match(base: Specs, policy: Specs, tied: bool, asked: Asked) -> Match:
    """Find the VLM's tensors in the policy.

    Args:
        base: the VLM's tensors, by their names in the file.
        policy: all of the policy's tensors.
        tied: whether the VLM's table and head, if it has both, are the same.

    Raises:
        AegisError: the policy does not have them, has them twice and no prefix was given, has them
            in other shapes or not as plain weights, or lacks more of them than the layers after the
            last one that it computes.
    """
    called = asked.policy, asked.vlm
    named = {key(name): name for name in base}
    if len(named) < len(base):
        twice = sorted(name for name in base if named[key(name)] != name)
        raise AegisError(
            f"tensors of '{called[1]}' that only their prefixes tell apart: {few(twice)}",
            "a model with one tensor of each name",
            "download or export the model again",
        )
    prefix, found, others = _under_one_prefix(named, base, policy, asked)
    own = {name: found[each] for each, name in named.items() if each in found}
    behind = {key(name.removeprefix(prefix)): name for name in policy if name.startswith(prefix)}
    words = {each: behind[each] for each in (TABLE, HEAD) if each in behind}
    second = _tie(named, own, words, tied)
    _check_shapes(base, policy, own, called)
    kept = _kept(named, base, own, called)
    used = {*own.values(), *(second or ())}
    prefix = _common(used)  # includes a `model.` that keys ignore
    beside = tuple(other for other in others if other.startswith(prefix))
    own_names = (n for n in policy if n.startswith(prefix) and not n.startswith(beside))
    more = tuple(sorted(n for n in own_names if n not in used))
    _check_plain(used, more, called)
    _check_depth(prefix, more, named, called)
    rows = {
        name: min(base[name].shape[0], policy[other].shape[0])
        for name, other in own.items()
        if base[name].shape != policy[other].shape
    }
    return Match(prefix, own, rows, kept, second, more, others)


def _is_language(found: str) -> bool:
    return found.partition(".")[0] in _LANGUAGE


def _layer(found: str) -> int | None:
    number = _LAYER.match(found)
    return None if number is None else int(number[1])


# --- the prefix -----------------------------------------------------------------------------------


def _under_one_prefix(
    named: Mapping[str, str], base: Specs, policy: Specs, asked: Asked
) -> tuple[str, dict[str, str], tuple[str, ...]]:
    """The prefix of the VLM in the policy, the policy's names by key, and other VLMs' prefixes."""
    called = asked.policy, asked.vlm
    places = _places(named, policy)
    # An action expert has layers with these names too, but no vision part.
    whole = {
        prefix: found
        for prefix, found in places.items()
        if any(map(_LAYER.match, found)) and any(not _is_language(each) for each in found)
    }
    if not whole:
        raise _nothing(places, len(base), policy, called)
    # `model.vlm.` and `model.vlm.model.` have the same tensors; the shorter one also has the head.
    found = _without_parts(whole)
    # One of other shapes is no candidate, unless there is nothing else: then they are compared.
    fitting = [p for p in found if all(_fits(base, policy, named, whole[p], e) for e in whole[p])]
    candidates = fitting or found
    if asked.prefix is not None:
        prefix = _chosen(asked.prefix, found, candidates, whole, asked)
    elif len(candidates) > 1:
        raise _several(
            f"{len(candidates)} VLMs in '{called[0]}' that have the names of '{called[1]}'",
            candidates,
            asked,
        )
    else:
        prefix = candidates[0]
    chosen = {}
    for each, names in whole[prefix].items():
        alike = [n for n in names if _alike(base[named[each]], policy[n], each)] or names
        if len(alike) > 1:
            raise AegisError(
                f"'{named[each]}' of '{called[1]}' more than once in '{called[0]}': {few(alike)}",
                "one tensor of each name",
                "leave the others out of the file",
            )
        chosen[each] = alike[0]
    others = tuple(other for other in candidates if other != prefix)
    return prefix, chosen, others


def _chosen(
    given: str,
    found: Sequence[str],
    candidates: Sequence[str],
    whole: Collection[str],
    asked: Asked,
) -> str:
    """The prefix of the VLM that a user has chosen, by it or by the beginning of it.

    Args:
        found: the prefixes of all VLMs, of which the candidates have the right shapes.
        whole: these, and the longer ones that have some of the same tensors.
    """
    wanted = f"{given.rstrip('.')}." if given else ""
    if wanted in whole:  # perhaps a longer one, as the report names it
        return max((prefix for prefix in found if wanted.startswith(prefix)), key=len)
    below = [prefix for prefix in candidates if prefix.startswith(wanted)]
    if len(below) == 1:
        return below[0]
    has = f"{len(below)} VLMs" if below else "no VLM"
    what = f"{has} under --prefix '{given}' in '{asked.policy}'"
    raise _several(what, below or candidates, asked)


def _several(found: str, candidates: Sequence[str], asked: Asked) -> AegisError:
    """The error for a policy of whose VLMs one has to be chosen."""
    there = ", ".join(repr(prefix) if prefix else "'' (no prefix)" for prefix in candidates)
    example = commands.aegis(*asked.command, "--prefix", candidates[0].rstrip("."))
    return AegisError(
        f"{found}: under {there}",
        "one of these, such as the weights that the robot acts with, or their average (EMA)",
        f"choose it: {example}",
    )


def _common(names: Collection[str]) -> str:
    """The leading parts that all of these names share."""
    parts = zip(*(name.split(".")[:-1] for name in names), strict=False)
    alike = itertools.takewhile(lambda each: len(set(each)) == 1, parts)
    return "".join(f"{each[0]}." for each in alike)


def _places(named: Collection[str], policy: Iterable[str]) -> dict[str, dict[str, list[str]]]:
    """Prefix -> key of the VLM -> the policy's names that have that key after the prefix."""
    places: dict[str, dict[str, list[str]]] = {}
    for name in policy:
        parts = name.split(".")
        for cut in range(len(parts)):
            behind = key(".".join(parts[cut:]))
            if behind in named:
                prefix = "".join(f"{part}." for part in parts[:cut])
                places.setdefault(prefix, {}).setdefault(behind, []).append(name)
    return places


def _without_parts(whole: Mapping[str, Mapping[str, list[str]]]) -> list[str]:
    """The prefixes, without those whose tensors a shorter prefix also has."""
    found: list[str] = []
    held: list[set[str]] = []
    for prefix in sorted(whole, key=len):
        own = {name for names in whole[prefix].values() for name in names}
        if not any(own <= other for other in held):
            found.append(prefix)
            held.append(own)
    return found


def _fits(
    base: Specs,
    policy: Specs,
    named: Mapping[str, str],
    found: Mapping[str, list[str]],
    each: str,
) -> bool:
    return any(_alike(base[named[each]], policy[name], each) for name in found[each])


def _alike(own: Spec, other: Spec, each: str) -> bool:
    """Whether a tensor of the policy can replace the VLM's."""
    if own.dtype != other.dtype and not (own.is_float and other.is_float):
        return False
    if each in _OF_WORDS and own.shape and other.shape:
        return own.shape[1:] == other.shape[1:]
    return own.shape == other.shape


def _nothing(
    places: Mapping[str, Mapping[str, list[str]]],
    vlm_has: int,
    policy: Specs,
    called: tuple[str, str],
) -> AegisError:
    """The error for a policy without the VLM, which has `vlm_has` tensors."""
    expected = "a policy that was made from this VLM, with its vision and its language layers"
    fix = "give the VLM that the policy was made from"
    most = max(places, key=lambda prefix: len(places[prefix]), default=None)
    if most is not None and len(places[most]) > 1:
        part = "vision" if all(map(_is_language, places[most])) else "language layers"
        under = f", under '{most}'" if most else ""
        found = (
            f"of {vlm_has:,} tensors of '{called[1]}' {len(places[most]):,} have their names in "
            f"'{called[0]}'{under}, and none of its {part}"
        )
        return AegisError(found, expected, fix)
    first = sorted({".".join(name.split(".")[:3]) for name in policy})
    found = f"none of the tensors of '{called[1]}' in '{called[0]}', which has {few(first)}"
    return AegisError(found, expected, fix)


# --- what is missing ------------------------------------------------------------------------------


def _tie(
    named: Mapping[str, str],
    own: dict[str, str],
    words: Mapping[str, str],
    tied: bool,
) -> tuple[str, str] | None:
    """If the policy has only one of a tied table and head, use it for both.

    LeRobot and openpi write pi0 with only its head, which PaliGemma does not have.

    Args:
        own: the VLM's name -> the policy's; entries are added.
        words: the policy's names of its table and head by their keys, as far as it has them.

    Returns:
        As `Match.second`.
    """
    second = None
    for each, twin in ((TABLE, HEAD), (HEAD, TABLE)):
        if each not in named or twin not in words:
            continue
        if each not in words and (tied or twin not in named):
            own[named[each]] = words[twin]
        elif each in words and twin not in named:
            second = words[twin], words[each]
    return second


def _check_shapes(
    base: Specs, policy: Specs, own: Mapping[str, str], called: tuple[str, str]
) -> None:
    packed = [
        f"{other} is {policy[other].dtype}"
        for name, other in own.items()
        if base[name].is_float and not policy[other].is_float
    ]
    if packed:
        raise AegisError(
            f"{len(packed)} of {len(own)} tensors of '{called[0]}' are quantised: {few(packed)}",
            "weights in a floating-point type of 16 bits or more",
            "dequantise the policy first, with the program that quantised it, and save it again",
        )
    wrong = [
        f"{other} is {_said(policy[other])} instead of {_said(base[name])}"
        for name, other in own.items()
        if not _alike(base[name], policy[other], key(name))
    ]
    if wrong:
        raise AegisError(
            f"{len(wrong)} of {len(own)} tensors of '{called[0]}' do not have the shapes of "
            f"'{called[1]}': {few(wrong)}",
            "the VLM that the policy was made from, in the same size",
            "give that one",
        )


def _said(spec: Spec) -> str:
    return f"{spec.dtype} {list(spec.shape)}"


def _kept(
    named: Mapping[str, str], base: Specs, own: Mapping[str, str], called: tuple[str, str]
) -> tuple[Kept, ...]:
    """What the policy does not have and does not need.

    Raises:
        AegisError: a tensor that it needs is missing.
    """
    missing = {each: name for each, name in named.items() if name not in own}
    layers = {number for each in named if (number := _layer(each)) is not None}
    there = {number for name in own if (number := _layer(key(name))) is not None}
    # No gaps: up to the last layer that is present, even in part, no weights may be missing.
    first = max(there, default=-1) + 1
    upper, after, buffers, middle = [], [], [], []
    for each, name in sorted(missing.items()):
        number = _layer(each)
        if number is not None and number >= first and there:
            upper.append(name)
        elif each.split(".")[0] in ("norm", "lm_head"):
            after.append(name)
        elif each.endswith(_BUFFERS) or not base[name].is_float:
            buffers.append(name)
        else:
            middle.append(name)
    if middle:
        raise AegisError(
            f"{len(middle)} tensors of '{called[1]}' that '{called[0]}' does not have, and that "
            f"are not behind its last layer: {few(middle)}",
            "all of the VLM up to the last layer that the policy computes",
            "give the VLM that the policy was made from; of a policy with an adapter, "
            "merge that first",
        )
    span, they = f"layer {first}", "it"
    if first < max(layers):
        span, they = f"layers {first} to {max(layers)}", "them"
    lacks = f"the policy does not have {they}, so {they.replace('them', 'they')} never learned"
    kinds = (
        (f"language {span}", lacks, upper),
        ("behind the layers", "the policy does not have it, so it never learned", after),
        ("buffers", "they do not learn", buffers),
    )
    return tuple(Kept(what, why, tuple(names)) for what, why, names in kinds if names)


def _check_plain(used: Iterable[str], more: Iterable[str], called: tuple[str, str]) -> None:
    """Raise AegisError if the modules of the VLM's weights have further tensors, as adapters do.

    Then the weights alone are not what the policy computes with. A bias is only listed.
    """
    modules = {name.removesuffix("weight") for name in used if name.endswith(".weight")}
    beside = []
    for name in more:
        parts = name.split(".")
        above = ("".join(f"{part}." for part in parts[:end]) for end in range(1, len(parts)))
        if parts[-1] != "bias" and any(each in modules for each in above):
            beside.append(name)
    if beside:
        raise AegisError(
            f"{len(beside)} tensors of adapters or scales beside the VLM's weights in "
            f"'{called[0]}': {few(beside)}",
            "plain weights",
            "merge the adapter into the weights, or apply the scales, and save the policy again",
        )


def _check_depth(
    prefix: str, more: Iterable[str], named: Collection[str], called: tuple[str, str]
) -> None:
    """Raise AegisError if the policy has more language layers than the VLM."""
    depth = 1 + max(number for each in named if (number := _layer(each)) is not None)
    beyond = [n for n in more if (_layer(key(n.removeprefix(prefix))) or 0) >= depth]
    if beyond:
        raise AegisError(
            f"language layers in '{called[0]}' behind the {depth} of '{called[1]}': {few(beyond)}",
            "the VLM that the policy was made from, with all of its layers",
            "give that one",
        )
