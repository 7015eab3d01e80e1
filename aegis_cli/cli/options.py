"""Arguments that several commands take, and what their values may be."""

from __future__ import annotations

import math
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from aegis_cli.common.errors import AegisError
from aegis_cli.recipes.policy import SEED


class Format(StrEnum):
    safetensors = "safetensors"
    lerobot = "lerobot"


class Colors(StrEnum):
    seen = "seen"
    held_out = "held-out"
    all = "all"


def positive(param: typer.CallbackParam, value: int) -> int:
    if value < 1:
        raise AegisError(
            f"{param.opts[0]} {value}",
            "a whole number, 1 or more",
            f"e.g. {param.opts[0]} {param.default}",
        )
    return value


def not_negative(param: typer.CallbackParam, value: float | None) -> float | None:
    if value is not None and not 0 <= value < math.inf:  # NaN fails both
        raise AegisError(
            f"{param.opts[0]} {value:g}",
            "a number, 0 or more",
            f"e.g. {param.opts[0]} {param.default or 0}",
        )
    return value


def seed_number(param: typer.CallbackParam, value: int) -> int:
    if not SEED.accepts(value):
        raise AegisError(
            f"{param.opts[0]} {value}",
            f"a whole number {SEED.expected}",
            f"e.g. {param.opts[0]} {param.default}",
        )
    return value


def below_one(param: typer.CallbackParam, value: float | None) -> float | None:
    if value is not None and not 0 <= value < 1:  # NaN fails both
        raise AegisError(
            f"{param.opts[0]} {value:g}",
            "a number, 0 or more and below 1",
            f"e.g. {param.opts[0]} 0.25",
        )
    return value


def given(ctx: typer.Context) -> list[str]:
    """The options on the command line, not those at their defaults."""
    params = [p for p in ctx.command.params if p.param_type_name == "option"]
    return [
        p.opts[0]
        for p in params
        if getattr(ctx.get_parameter_source(p.name), "name", "") == "COMMANDLINE"
    ]


RecipeArg = Annotated[
    Path,
    typer.Argument(
        metavar="RECIPE", help="Recipe file, e.g. recipes/quickstart.yaml.", show_default=False
    ),
]
Set = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Override a recipe key, e.g. train.steps=200; repeatable.",
        show_default=False,
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print the report as JSON on stdout.")]
Resume = Annotated[
    bool,
    typer.Option(
        "--resume",
        help="Continue from the last checkpoint in --out; without a run there, start anew.",
    ),
]
Episodes = Annotated[int, typer.Option(help="Number of episodes.", callback=positive)]
DropBelow = Annotated[
    float | None,
    typer.Option(
        metavar="QUANTILE",
        help="Of a suite task, drop episodes below this quantile of the returns; default: 0.25.",
        callback=below_one,
        show_default=False,
    ),
]
Vqa = Annotated[
    str,
    typer.Option(
        metavar="SET",
        help=(
            "'scenes', a .jsonl file, VQAv2's or OK-VQA's questions file, or a Hugging Face "
            "data set's folder."
        ),
    ),
]
SkipBad = Annotated[
    bool, typer.Option("--skip-bad", help="Leave bad questions of files out and count them.")
]
BatchSize = Annotated[
    int,
    typer.Option(
        help="Samples per forward pass at most; changes speed and memory, not what is measured.",
        callback=positive,
    ),
]
AnchorIn = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Anchor file of the backbone.", show_default=False),
]
