"""Variants of a study: how they are written, and how their keys change the shared ones."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

from aegis_cli.common.files import canonical
from aegis_cli.recipes import FOLDER_NAME, LEARNERS, METHODS, Variant
from aegis_cli.recipes.decoding import build
from aegis_cli.recipes.streams import UNREAD_RATES
from aegis_cli.recipes.strict_yaml import Problem, line_of, put

V = TypeVar("V", bound=Variant)
# A key that no variant may set -> the study's own key for it; None if it belongs in 'shared'.
Places = Mapping[str, str | None]


def merged(
    shared: dict[str, Any],
    variant: Variant,
    value: Any = None,
    lines: Mapping[str, int | None] | None = None,
) -> dict[str, Any]:
    """The raw keys of a cell's recipe.

    A key is left out if its section has a value that is not a mapping; `build` reports that value.

    Args:
        lines: the lines of the variant's dotted keys in the study's file.
    """
    raw = copy.deepcopy(shared)  # variants change its sections
    for dotted, its_value in {**variant.set, **variant.chosen(value)}.items():
        put(raw, dotted, copy.deepcopy(its_value), (lines or {}).get(dotted))
    put(raw, "train.method", variant.method)
    return raw


def _lines(keys: Any) -> dict[str, int | None]:
    """The lines in the file of a variant's dotted keys in 'set' and 'tune'."""
    found: dict[str, int | None] = {}
    for part in ("set", "tune"):
        section = keys.get(part)
        if isinstance(section, dict):
            found |= {dotted: line_of(section, dotted) for dotted in section}
    return found


def read(
    raw: Any, kind: type[V], places: Places, anchors: Mapping[str, str], problems: list[Problem]
) -> dict[str, V]:
    """The variants that can be read; the problems of the others are appended.

    Args:
        anchors: name -> the method that a variant of that name must have, since others are
            compared with it.
    """
    found = {}
    # `build` has reported a value that is not a mapping.
    for name, keys in (raw if isinstance(raw, dict) else {}).items():
        where, own = f"variants.{name}", []  # the problems of this variant
        if not isinstance(name, str) or not FOLDER_NAME.accepts(name):
            own.append(
                Problem(f"the variant '{name}'", f"a name of {FOLDER_NAME.expected}", "rename it")
            )
        variant: V | None = None
        if isinstance(keys, dict):
            variant = build(kind, keys, own, f"{where}.")
        else:
            own.append(
                Problem(
                    f"{where}: {keys}",
                    "a section with keys of: method, set, tune",
                    f"indent them below '{name}:'",
                )
            )
        if variant is not None:
            own += _problems(where, variant, places, _lines(keys))
            if anchors.get(name, variant.method) != variant.method:
                wrong = f"{where}.method: {variant.method}"
                expected = f"{anchors[name]}: the others are measured against it"
                own.append(Problem(wrong, expected, "rename the variant"))
        if variant is not None and not own:
            found[name] = variant
        line = line_of(raw, name)  # the variant's line, for problems without a line of their own
        problems += [p if p.line else p._replace(line=line) for p in own]
    return found


# The sections that only one method or learner reads.
SECTIONS = frozenset(name.replace("-", "_") for name in (*METHODS, *LEARNERS))


def _problems(
    where: str, variant: Variant, places: Places, lines: Mapping[str, int | None]
) -> Iterator[Problem]:
    """Problems of a variant's keys, beyond the recipe's own checks of their values."""
    for part, keys in (("set", variant.set), ("tune", variant.tune)):
        for dotted, value in keys.items():
            for problem in _key_problems(f"{where}.{part}", dotted, value, variant.method, places):
                yield problem._replace(line=lines.get(dotted))
    for knob, values in variant.tune.items():
        line = lines.get(knob)
        if not _distinct(values):
            expected, fix = "a list of different values", "write e.g. [0.1, 1, 10]"
            yield Problem(f"{where}.tune.{knob}: {values}", expected, fix, line)
        if knob in variant.set:
            expected, fix = "each key once", "delete it in one of them"
            yield Problem(f"{where}: {knob} in set and in tune", expected, fix, line)


def _key_problems(
    where: str, dotted: str, value: Any, method: str, places: Places
) -> Iterator[Problem]:
    """Problems of one key of a variant of this method."""
    if not all(dotted.split(".")) or isinstance(value, dict):
        expected, fix = "dotted recipe keys", "write e.g. train.backbone_lr: 1e-4"
        yield Problem(f"{where}: {dotted}", expected, fix)
    yield from _reserved(where, dotted, places)
    expected = f"keys that method '{method}' reads"
    section = dotted.partition(".")[0]
    if section in SECTIONS and section != method.replace("-", "_"):
        fix = f"delete it, or set method: {section.replace('_', '-')}"
        yield Problem(f"{where}: {dotted}", expected, fix)
    unread = UNREAD_RATES.get(method, {})
    if dotted in unread:
        instead = unread[dotted]
        fix = "delete it" if instead is None else f"set {instead} instead"
        yield Problem(f"{where}: {dotted}", expected, fix)


def _distinct(values: Any) -> bool:
    """Whether it is a list of different values, and not empty."""
    if not isinstance(values, list):
        return False
    try:
        texts = {canonical(value) for value in values}  # lists could not be in a set
    except (TypeError, ValueError):  # NaN, or values that only YAML can express
        return False
    return 0 < len(texts) == len(values)


def _reserved(where: str, dotted: str, places: Places) -> Iterator[Problem]:
    """The problem of a key that is not allowed here."""
    if not any(dotted == key or dotted.startswith(f"{key}.") for key in places):
        return
    place = places.get(dotted)
    if place:
        yield Problem(f"{where}: {dotted}", f"the study's '{place}'", f"use '{place}'")
    else:
        yield Problem(f"{where}: {dotted}", "the same for all", "move it to 'shared'")


def cell_problems(
    kind: type,
    shared: Any,
    variants: Mapping[str, Variant],
    raw: Mapping[str, Any],
    places: Places,
    given: Sequence[dict[str, Any]],
    together: Callable[[Any], Iterable[Problem]],
) -> Iterator[Problem]:
    """Problems that the ordinary checks find in each cell's recipe; those of `shared` come once.

    Args:
        raw: the variants as in the file, with their lines.
        places: places of the keys that the study itself sets in every cell.
        given: raw keys that the study sets, one mapping per cell of a variant and value.
        together: checks across the keys of a recipe.
    """
    if not isinstance(shared, dict):
        return
    for dotted in _dotted(shared):
        yield from _reserved("shared", dotted, places)
    common: list[Problem] = []  # problems that every cell has again
    build(kind, {**shared, **given[0]}, common)
    yield from _within("shared", common)
    for name, variant in variants.items():
        lines = _lines(raw[name])
        for value, keys in itertools.product(variant.values, given):
            found: list[Problem] = []
            made = build(kind, merged(shared, variant, value, lines) | keys, found)
            own: Iterable[Problem] = [problem for problem in found if problem not in common]
            if not own and made is not None:  # only a complete recipe can be checked as a whole
                own = together(made)
            own = [p if p.line else p._replace(line=line_of(raw, name)) for p in own]
            yield from _within(f"variants.{name}", own)


def _dotted(raw: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    for name, value in raw.items():
        yield f"{prefix}{name}"
        if isinstance(value, dict):
            yield from _dotted(value, f"{prefix}{name}.")


def tuning_problems(
    raw: Mapping[str, Any], variants: Mapping[str, Variant], default: int, fix: str
) -> Iterator[Problem]:
    """Problems of tuning, such as knobs without a section 'tuning' or a seed of the comparison.

    Args:
        default: the default of the tuning's seed.
        fix: what to do if the section is missing.
    """
    tuned = {name: variant for name, variant in variants.items() if variant.tune}
    tuning, seeds = raw.get("tuning"), raw.get("seeds")
    if tuned and tuning is None:
        yield Problem(f"{', '.join(tuned)} with 'tune'", "the section 'tuning'", fix)
    if not isinstance(tuning, dict):
        return
    seed, runs = tuning.get("seed", default), tuning.get("runs")
    # Otherwise a knob would be chosen by a run that is also compared. `build` reports wrong types.
    if isinstance(seed, int) and isinstance(seeds, list) and seed in seeds:
        said = f"set tuning.seed to {max(s for s in seeds if isinstance(s, int)) + 1000}"
        yield Problem(
            f"tuning.seed: {seed} is also one of seeds", "a seed that no compared run has", said
        )
    for name, variant in tuned.items():
        count = len(variant.values)
        if isinstance(runs, int) and count != runs:
            found = f"variants.{name}.tune: {count} values"
            line = line_of(raw["variants"], name)
            yield Problem(found, f"{runs}, which is tuning.runs", "give each its share", line)


def _within(where: str, found: Iterable[Problem]) -> list[Problem]:
    """The problems with the place where they were found."""
    return [p._replace(found=f"{where}: {p.found}") for p in found]
