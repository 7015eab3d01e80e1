"""Which tensors of a robot policy are those of the VLM that it was made from, by name and shape.

A policy has its VLM under a prefix, such as `model.vlm_with_expert.vlm.`, and beside it an action
expert whose layers have the same names. Releases of transformers have named a VLM's parts in
several ways; `key` is one name for all of them.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from aegis_cli.common.errors import AegisError, few

# Parts of names that one release of transformers has and another one has not:
# `language_model.model.layers.0`, `model.language_model.layers.0` and `model.layers.0` are one.
_WRAPPERS = ("model", "language_model", "text_model")
_LANGUAGE = ("embed_tokens", "layers", "norm", "lm_head")  # how keys of the language model begin
_LAYER = re.compile(r"layers\.(\d+)\.")
TABLE, HEAD = "embed_tokens.weight", "lm_head.weight"
# Their first axis is the vocabulary. PaliGemma's repositories have 257,216 rows, and pi0, which was
# made from them, 257,152: the rows after these were added for transformers.
_OF_WORDS = (TABLE, HEAD, "lm_head.bias")
_FLOATS = ("F64", "F32", "F16", "BF16")
_BUFFERS = ("position_ids", "inv_freq")


class Spec(NamedTuple):
    """A tensor's shape, and its type by safetensors' name."""

    shape: tuple[int, ...]
    dtype: str

    @property
    def is_float(self) -> bool:
        """Whether its numbers are of a type that weights learn in."""
        return self.dtype in _FLOATS


Specs = Mapping[str, Spec]


@dataclass(frozen=True)
class Kept:
    """The VLM's own tensors of which the policy has none."""

    what: str
    why: str
    names: tuple[str, ...]


@dataclass(frozen=True)
class Match:
    """Where a policy has a VLM's tensors.

    Attributes:
        prefix: what the VLM's names have before them in the policy.
        taken: the VLM's name -> the policy's. Where words are scored by the table that they are
            looked up in, both of a VLM's names may be one of the policy's.
        rows: the VLM's name -> rows that both have, of tables with unequally many.
        kept: what the policy does not have.
        second: the policy's name of a table or head that the VLM ties to its other one, and that
            one's name in the policy; None where it holds one of them at most, or the VLM both.
        more: the policy's names under the prefix which the VLM has not.
    """

    prefix: str
    taken: Mapping[str, str]
    rows: Mapping[str, int]
    kept: tuple[Kept, ...]
    second: tuple[str, str] | None
    more: tuple[str, ...]


def key(name: str) -> str:
    """One name for a tensor of a VLM, whichever release of transformers has named it."""
    found: list[str] = []
    for part in name.split("."):
        # As of CLIP and SigLIP until transformers 5.5.
        of_tower = part == "vision_model" and found[-1:] == ["vision_tower"]
        if part not in _WRAPPERS and not of_tower:
            found.append(part)
    return ".".join(found)


def is_vlm(names: Iterable[str]) -> bool:
    """Whether these are the names of a model with language layers and with something to see by."""
    keys = [key(name) for name in names]
    return any(map(_LAYER.match, keys)) and any(not _is_language(found) for found in keys)


def pair_of_tables(specs: Specs) -> tuple[str, str] | None:
    """The names of a VLM's table and of its head, where the file has both; None: it has not."""
    named = {key(name): name for name in specs}
    return (named[TABLE], named[HEAD]) if TABLE in named and HEAD in named else None


def match(base: Specs, policy: Specs, tied: bool, called: tuple[str, str]) -> Match:
    """Find the VLM's tensors in the policy.

    Args:
        base: those of the VLM, in the file's names.
        policy: all of the policy's.
        tied: whether the VLM's table and head, if it has both, are the same.
        called: what an error calls the policy and the VLM.

    Raises:
        AegisError: the policy has not got them, has them twice, in other shapes, or only some of
            them, where more is missing than the layers behind those that it computes.
    """
    named = {key(name): name for name in base}
    if len(named) < len(base):
        twice = sorted(name for name in base if named[key(name)] != name)
        raise AegisError(
            f"tensors of '{called[1]}' that only their prefixes tell apart: {few(twice)}",
            "a model with one tensor of each name",
            "download or export the model again",
        )
    prefix, found = _under_one_prefix(named, base, policy, called)
    own = {name: found[each] for each, name in named.items() if each in found}
    behind = {key(name.removeprefix(prefix)): name for name in policy if name.startswith(prefix)}
    words = {each: behind[each] for each in (TABLE, HEAD) if each in behind}
    second = _tie(named, own, words, tied)
    _check_shapes(base, policy, own, called)
    kept = _kept(named, base, own, called)
    used = {*own.values(), *(second or ())}
    prefix = _common(used)  # `model.` of what may as well be found behind nothing
    more = tuple(sorted(n for n in policy if n.startswith(prefix) and n not in used))
    _check_depth(prefix, more, named, called)
    rows = {
        name: min(base[name].shape[0], policy[other].shape[0])
        for name, other in own.items()
        if base[name].shape != policy[other].shape
    }
    return Match(prefix, own, rows, kept, second, more)


def _is_language(found: str) -> bool:
    return found.partition(".")[0] in _LANGUAGE


def _layer(found: str) -> int | None:
    number = _LAYER.match(found)
    return None if number is None else int(number[1])


# --- the prefix -----------------------------------------------------------------------------------


def _under_one_prefix(
    named: Mapping[str, str], base: Specs, policy: Specs, called: tuple[str, str]
) -> tuple[str, dict[str, str]]:
    """The prefix of the VLM in the policy, and the policy's names by key."""
    places = _places(named, policy)
    # An action expert has layers of these names too, but nothing to see by.
    whole = {
        prefix: found
        for prefix, found in places.items()
        if any(map(_LAYER.match, found)) and any(not _is_language(each) for each in found)
    }
    if not whole:
        raise _nothing(places, len(base), policy, called)
    # `model.vlm.` and `model.vlm.model.` hold the same; the shorter one holds the head, too.
    found = _without_parts(whole)
    if len(found) > 1:
        alike = [p for p in found if all(_fits(base, policy, named, whole[p], e) for e in whole[p])]
        found = alike if len(alike) == 1 else found
    if len(found) > 1:
        raise AegisError(
            f"{len(found)} VLMs in '{called[0]}' that have the names of '{called[1]}': under "
            f"{few([repr(prefix) for prefix in found])}",
            "a policy with one of them",
            "leave the other one's tensors out of the file, as an average of the weights",
        )
    prefix = found[0]
    chosen = {}
    for each, names in whole[prefix].items():
        fitting = [n for n in names if _alike(base[named[each]], policy[n], each)] or names
        if len(fitting) > 1:
            raise AegisError(
                f"'{named[each]}' of '{called[1]}' more than once in '{called[0]}': {few(fitting)}",
                "one tensor of each name",
                "leave the others out of the file",
            )
        chosen[each] = fitting[0]
    return prefix, chosen


def _common(names: Collection[str]) -> str:
    """The parts that all of these names begin with."""
    parts = zip(*(name.split(".")[:-1] for name in names), strict=False)
    alike = itertools.takewhile(lambda each: len(set(each)) == 1, parts)
    return "".join(f"{each[0]}." for each in alike)


def _places(named: Collection[str], policy: Iterable[str]) -> dict[str, dict[str, list[str]]]:
    """Prefix -> key of the VLM -> the policy's names that are that key behind the prefix."""
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
    """The prefixes but for those that hold no more than a shorter one of them does."""
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
    """Whether a tensor of the policy may take the place of the VLM's."""
    if own.is_float != other.is_float:
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
    """The error for a policy without the VLM, of that many tensors."""
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
    """Give a tied table and head each other's tensor where the policy holds one of them.

    LeRobot and openpi have written pi0 with its head alone, which PaliGemma has not.

    Args:
        own: the VLM's name -> the policy's, which is added to.
        words: the policy's names of its table and its head by their keys, as far as it has them.

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
    """What the policy does not have, where it can do without.

    Raises:
        AegisError: more than that.
    """
    missing = {each: name for each, name in named.items() if name not in own}
    layers = {number for each in named if (number := _layer(each)) is not None}
    there = {number for name in own if (number := _layer(key(name))) is not None}
    # Without a gap: a layer that is there in part is in the middle, as those before it are.
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
    span = f"layers {first} to {max(layers)}" if first < max(layers) else f"layer {first}"
    kinds = (
        (f"language {span}", "the policy does not have them, so they never learned", upper),
        ("behind the layers", "the policy does not have it, so it never learned", after),
        ("buffers", "they do not learn", buffers),
    )
    return tuple(Kept(what, why, tuple(names)) for what, why, names in kinds if names)


def _check_depth(
    prefix: str, more: Iterable[str], named: Collection[str], called: tuple[str, str]
) -> None:
    """Raise AegisError where the policy has more language layers than the VLM."""
    depth = 1 + max(number for each in named if (number := _layer(each)) is not None)
    beyond = [n for n in more if (_layer(key(n.removeprefix(prefix))) or 0) >= depth]
    if beyond:
        raise AegisError(
            f"language layers in '{called[0]}' behind the {depth} of '{called[1]}': {few(beyond)}",
            "the VLM that the policy was made from, with all of its layers",
            "give that one",
        )
