"""Variants of a study: how they are written, and what their keys make of the shared ones."""

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
# A key that no variant may set -> the study's own key for it; None where it is in 'shared'.
Places = Mapping[str, str | None]


def merged(
    shared: dict[str, Any],
    variant: Variant,
    value: Any = None,
    lines: Mapping[str, int | None] | None = None,
) -> dict[str, Any]:
    """The raw keys of a cell's recipe.

    Where something else than a section is in a key's way, it is left out: `build` complains of
    what is in the way.

    Args:
        lines: where the variant's dotted keys stand in the study's file.
    """
    raw = copy.deepcopy(shared)
    for dotted, its_value in {**variant.set, **variant.chosen(value)}.items():
        put(raw, dotted, copy.deepcopy(its_value), (lines or {}).get(dotted))
    put(raw, "train.method", variant.method)
    return raw


def _lines(keys: Any) -> dict[str, int | None]:
    """Where the dotted keys of a variant stand in the file: those of its 'set' and its 'tune'."""
    found: dict[str, int | None] = {}
    for part in ("set", "tune"):
        section = keys.get(part)
        if isinstance(section, dict):
            found |= {dotted: line_of(section, dotted) for dotted in section}
    return found


def read(
    raw: Any, kind: type[V], places: Places, anchors: Mapping[str, str], problems: list[Problem]
) -> dict[str, V]:
    """The variants that can be read; the others' problems are appended.

    Args:
        anchors: name -> the method that a variant of that name has to have, since others are
            measured against it.
    """
    found = {}
    for name, keys in (raw if isinstance(raw, dict) else {}).items():
        where, own = f"variants.{name}", []
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
                expected = f"{anchors[name]}: the others are measured against it"
                own.append(
                    Problem(f"{where}.method: {variant.method}", expected, "rename the variant")
                )
        if variant is not None and not own:
            found[name] = variant
        line = line_of(raw, name)  # that of the variant, where no key of its own is to blame
        problems += [p if p.line else p._replace(line=line) for p in own]
    return found


# The sections that one method or learner alone reads.
SECTIONS = frozenset(name.replace("-", "_") for name in (*METHODS, *LEARNERS))


def _problems(
    where: str, variant: Variant, places: Places, lines: Mapping[str, int | None]
) -> Iterator[Problem]:
    for part, keys in (("set", variant.set), ("tune", variant.tune)):
        for dotted, value in keys.items():
            found = list(_reserved(f"{where}.{part}", dotted, places))
            if not all(dotted.split(".")) or isinstance(value, dict):
                expected, fix = "dotted recipe keys", "write e.g. train.backbone_lr: 1e-4"
                found.insert(0, Problem(f"{where}.{part}: {dotted}", expected, fix))
            section = dotted.partition(".")[0]
            if section in SECTIONS and section != variant.method.replace("-", "_"):
                expected = f"keys that method '{variant.method}' reads"
                fix = f"delete it, or set method: {section.replace('_', '-')}"
                found.append(Problem(f"{where}.{part}: {dotted}", expected, fix))
            unread = UNREAD_RATES.get(variant.method, {})
            if dotted in unread:
                instead = unread[dotted]
                fix = "delete it" if instead is None else f"set {instead} instead"
                expected = f"keys that method '{variant.method}' reads"
                found.append(Problem(f"{where}.{part}: {dotted}", expected, fix))
            for problem in found:
                yield problem._replace(line=lines.get(dotted))
    for knob, values in variant.tune.items():
        line = lines.get(knob)
        if not _distinct(values):
            expected, fix = "a list of different values", "write e.g. [0.1, 1, 10]"
            yield Problem(f"{where}.tune.{knob}: {values}", expected, fix, line)
        if knob in variant.set:
            expected, fix = "each key once", "delete it in one of them"
            yield Problem(f"{where}: {knob} in set and in tune", expected, fix, line)


def _distinct(values: Any) -> bool:
    """Whether it is a list of values, each another one."""
    try:
        return isinstance(values, list) and 0 < len({canonical(v) for v in values}) == len(values)
    except (TypeError, ValueError):  # NaN, or what only YAML can write
        return False


def _reserved(where: str, dotted: str, places: Places) -> Iterator[Problem]:
    """A key that may not stand there."""
    if any(dotted == key or dotted.startswith(f"{key}.") for key in places):
        place = places.get(dotted)
        said, fix = (
            (f"the study's '{place}'", f"use '{place}'")
            if place
            else ("the same for all", "move it to 'shared'")
        )
        yield Problem(f"{where}: {dotted}", said, fix)


def cell_problems(
    kind: type,
    shared: Any,
    variants: Mapping[str, Variant],
    raw: Mapping[str, Any],
    places: Places,
    given: Sequence[dict[str, Any]],
    together: Callable[[Any], Iterable[Problem]],
) -> Iterator[Problem]:
    """What the ordinary checks say of each cell's recipe; what is wrong in `shared` is said once.

    Args:
        raw: the variants as the file has them, which knows their lines.
        places: of the keys that the study itself gives every cell.
        given: raw keys of what the study gives, of each cell of a variant and value.
        together: what a single key of a recipe cannot tell.
    """
    if not isinstance(shared, dict):
        return
    for dotted in _dotted(shared):
        yield from _reserved("shared", dotted, places)
    common: list[Problem] = []
    build(kind, {**shared, **given[0]}, common)
    yield from _within("shared", common)
    for name, variant in variants.items():
        lines = _lines(raw[name])
        for value, keys in itertools.product(variant.values, given):
            found: list[Problem] = []
            made = build(kind, merged(shared, variant, value, lines) | keys, found)
            own = [p for p in found if p not in common] or ([] if made is None else together(made))
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
    """Knobs without a section 'tuning', and a tuning seed that is one of the study's.

    Args:
        default: of the tuning's seed.
        fix: what to do where the section is missing.
    """
    tuned = {name: variant for name, variant in variants.items() if variant.tune}
    tuning, seeds = raw.get("tuning"), raw.get("seeds")
    if tuned and tuning is None:
        yield Problem(f"{', '.join(tuned)} with 'tune'", "the section 'tuning'", fix)
    if not isinstance(tuning, dict):
        return
    seed, runs = tuning.get("seed", default), tuning.get("runs")
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
    """The problems, with where they were found."""
    return [p._replace(found=f"{where}: {p.found}") for p in found]
