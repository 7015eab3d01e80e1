"""Studies of streams: one recipe file for learners x streams x seeds, and the stream recipe of each
of its cells.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from aegis_cli.recipes import (
    StreamRecipe,
    StreamStudyRecipe,
    StreamTuning,
    StreamVariant,
    cross_checks,
)
from aegis_cli.recipes import variants as spelled
from aegis_cli.recipes.decoding import build
from aegis_cli.recipes.strict_yaml import Problem, refuse

ISOLATED, ZERO_SHOT = "isolated-lora", "zero-shot"  # the variants that the bar measures against
# one of half the rank, if there is one: what iGSP's smaller experts reach without sharing
HALF = "isolated-lora-half"
THE_STUDYS = {
    "name": "name",
    "stream": "streams",
    "order": "streams",
    "seed": "seeds",
    "train.method": "variants",
    "split": "tuning",
}
_FOR_ALL = ("path", "encoder", "inference")


def cell(
    study: StreamStudyRecipe, variant: str, stream: str, seed: int, value: Any = None
) -> StreamRecipe:
    """The recipe of one run; `value` is what the variant's knob is set to, if it has one.

    Raises:
        AegisError: keys or values that make no recipe.
    """
    problems: list[Problem] = []
    raw = spelled.merged(study.shared, study.variants[variant], value)
    made = build(StreamRecipe, raw | {"name": study.name, "stream": stream, "seed": seed}, problems)
    refuse(problems or list(cross_checks(made)), f"variant {variant} of {study.name}")
    return made


def check(raw: Mapping[str, Any], problems: list[Problem]) -> dict[str, StreamVariant]:
    """The variants that can be read; everything wrong in any cell is appended."""
    places, against = (
        {**THE_STUDYS, **dict.fromkeys(_FOR_ALL)},
        {ISOLATED: ISOLATED, ZERO_SHOT: ZERO_SHOT, HALF: ISOLATED},
    )
    variants = spelled.read(raw.get("variants"), StreamVariant, places, against, problems)
    given = [{"name": "cell", "stream": "any"}]
    problems += spelled.cell_problems(
        StreamRecipe, raw.get("shared", {}), variants, THE_STUDYS, given, cross_checks
    )
    problems += spelled.tuning_problems(
        raw, variants, StreamTuning("any").seed, "add it: stream, seed, within"
    )
    problems += _twice(raw)
    return variants


def _twice(raw: Mapping[str, Any]) -> Iterator[Problem]:
    """A pair that is also a stream of the main table, or the other pair."""
    pairs, streams = raw.get("pairs"), raw.get("streams")
    named = (
        [pairs[k] for k in ("a", "b") if isinstance(pairs.get(k), str)]
        if isinstance(pairs, dict)
        else []
    )
    for name in {
        n for n in named if named.count(n) > 1 or (isinstance(streams, list) and n in streams)
    }:
        yield Problem(
            f"the stream '{name}' twice, in pairs and streams",
            "each stream once",
            "delete it in one of them",
        )
