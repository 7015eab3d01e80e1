"""Arguments that several commands take, and their allowed values."""

from __future__ import annotations

import math
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from aegis_cli.common import hub
from aegis_cli.common.errors import AegisError
from aegis_cli.data import episodes
from aegis_cli.data.renaming import Renaming
from aegis_cli.recipes import shipped
from aegis_cli.recipes.keys import MADE, SEED, WITH_PLACE

# Each of these lists the choices of an option. Typer takes the choices from an enumeration and
# checks them. A stage gets the value as text.


class Format(StrEnum):
    safetensors = "safetensors"
    lerobot = "lerobot"


class PolicyFormat(StrEnum):
    aegis = "aegis"
    lerobot = "lerobot"


class Precision(StrEnum):
    auto = "auto"
    bf16 = "bf16"
    float32 = "float32"


class Dtype(StrEnum):
    source = "source"
    float32 = "float32"
    bfloat16 = "bfloat16"


class RecipeAction(StrEnum):
    ls = "ls"
    show = "show"
    cp = "cp"


class Gate(StrEnum):
    mean = "mean"
    upper_end = "upper"


class Colors(StrEnum):
    seen = "seen"
    held_out = "held-out"
    all = "all"


# --- allowed values -------------------------------------------------------------------------------
# click calls these with the given value, or with the option's default.


def positive(param: typer.CallbackParam, value: int | None) -> int | None:
    """A whole number, 1 or more; None if the option was not given."""
    if value is not None and value < 1:
        raise _refused(param, f"{value}", "a whole number, 1 or more", param.default or 9)
    return value


def made(param: typer.CallbackParam, value: int | None) -> int | None:
    """How many items Aegis should make; None if the option was not given."""
    if value is not None and not MADE.accepts(value):
        raise _refused(param, f"{value}", f"a whole number {MADE.expected}", param.default or 9)
    return value


def not_negative(param: typer.CallbackParam, value: float | None) -> float | None:
    """A number, 0 or more; None if the option was not given."""
    if value is not None and not 0 <= value < math.inf:  # NaN fails both
        raise _refused(param, f"{value:g}", "a number, 0 or more", param.default or 0)
    return value


def above_zero(param: typer.CallbackParam, value: float) -> float:
    """A number above 0."""
    if not 0 < value < math.inf:  # NaN fails both
        raise _refused(param, f"{value:g}", "a number above 0", param.default)
    return value


def seed_number(param: typer.CallbackParam, value: int | None) -> int | None:
    """A seed that NumPy accepts; None if the option was not given."""
    if value is not None and not SEED.accepts(value):
        raise _refused(param, f"{value}", f"a whole number {SEED.expected}", param.default or 0)
    return value


def below_one(param: typer.CallbackParam, value: float | None) -> float | None:
    """A number, 0 or more and below 1; None if the option was not given."""
    if value is not None and not 0 <= value < 1:  # NaN fails both
        raise _refused(param, f"{value:g}", "a number, 0 or more and below 1", 0.25)
    return value


def share_or_one(param: typer.CallbackParam, value: float) -> float:
    """A number above 0 and up to 1."""
    if not 0 < value <= 1:  # NaN fails both
        raise _refused(param, f"{value:g}", "a number above 0 and up to 1", param.default)
    return value


def strengths(param: typer.CallbackParam, value: str | None) -> str | None:
    """Numbers, 0 or more, separated by commas; None if the option was not given."""
    if value is not None:
        try:
            fine = all(0 <= number < math.inf for number in numbers(value))
        except ValueError:  # a word that is not a number
            fine = False
        if not fine:
            raise _refused(param, value, "numbers, 0 or more, with commas between", "1,10,100")
    return value


def with_place(param: typer.CallbackParam, value: str | None) -> str | None:
    """A text with one {}; None if the option was not given."""
    if value is not None and not WITH_PLACE.accepts(value):
        example = "'{} Answer with a single word or phrase.'"
        raise _refused(param, f"'{value}'", WITH_PLACE.expected, example)
    return value


def demonstrations_path(text: str) -> Path:
    """A path or a hub id; `./a/b` must exist, because as a Path it would look like an id."""
    path = Path(text)
    # pathlib drops the `./`, with which a user excludes the hub.
    if hub.is_id(text) or not hub.is_id(str(path)):
        return path
    from aegis_cli.data import demonstrations

    return demonstrations.at(text)


def port_number(param: typer.CallbackParam, value: int) -> int:
    """A TCP port, or 0 for any free one."""
    if not 0 <= value <= 65535:
        raise _refused(param, f"{value}", "a port, 0 to 65535", param.default)
    return value


def episode_numbers(param: typer.CallbackParam, value: str | None) -> str | None:
    """Numbers from 0 and ranges, separated by commas; None if the option was not given."""
    if value is not None:
        try:
            fine = bool(listed_episodes(value))
        except ValueError:
            fine = False
        if not fine:
            raise _refused(
                param, value, "numbers from 0 and ranges, with commas between", "0,4,7-9"
            )
    return value


def listed_episodes(listed: str | None) -> list[int] | None:
    """The numbers of a list such as `0,4,7-9`; None for None.

    Raises:
        ValueError: anything else, a range that runs backwards, or one of a million numbers.
    """
    return None if listed is None else episodes.listed(listed)


def renamed(param: typer.CallbackParam, value: list[str] | None) -> list[str] | None:
    """Pairs NAME=NAME, each name once; None if the option was not given."""
    pairs = renaming(value)
    named = [old for old, _ in pairs]
    for written, (old, new) in zip(value or (), pairs, strict=True):
        if not old or not new:
            expected = "a name of the demonstrations, '=' and the policy's"
            raise _refused(param, written, expected, "overhead=top")
        if named.count(old) > 1:
            found = f"{written}, and '{old}' again"
            raise _refused(param, found, "each name once", "overhead=top")
    return value


def renaming(pairs: list[str] | None) -> Renaming:
    """Pairs OLD=NEW as the stages take them; `renamed` has checked them."""
    parts = (pair.partition("=") for pair in pairs or ())
    return tuple((old.strip(), new.strip()) for old, _, new in parts)


def names(listed: str | None) -> list[str]:
    """The names in a list with commas; empty for None."""
    return [] if listed is None else [part.strip() for part in listed.split(",")]


def numbers(listed: str | None) -> list[float]:
    """The numbers in a list with commas; empty for None."""
    return [] if listed is None else [float(part) for part in listed.split(",")]


def _refused(param: typer.CallbackParam, value: str, expected: str, example: object) -> AegisError:
    name = param.opts[0]
    return AegisError(f"{name} {value}", expected, f"e.g. {name} {example}")


def given(ctx: typer.Context) -> list[str]:
    """The options on the command line, not those at their defaults."""
    found = []
    for param in ctx.command.params:
        # Compared by name, since the enumeration is click's or that of the click typer bundles.
        source = getattr(ctx.get_parameter_source(param.name), "name", "")
        if param.param_type_name == "option" and source == "COMMANDLINE":
            found.append(param.opts[0])
    return found


def recipe_file(value: Path) -> Path:
    """The file of a recipe, given by its path or by the name of a shipped recipe."""
    return shipped.find(value)


# --- shared options -------------------------------------------------------------------------------

RecipeArg = Annotated[
    Path,
    Argument(
        metavar="RECIPE",
        help="Recipe file, e.g. recipes/quickstart.yaml, or the name of one that ships, e.g. "
        "quickstart.",
        callback=recipe_file,
    ),
]
RecipeOrRunArg = Annotated[
    Path,
    Argument(
        metavar="RECIPE_OR_RUN",
        help="Recipe file, or the name of one that ships, e.g. quickstart; or the folder of a run, "
        "to resume it with its own recipe, demonstrations and anchor.",
        callback=recipe_file,
    ),
]
Set = Annotated[
    list[str] | None,
    Option(
        "--set",
        metavar="KEY=VALUE",
        help="Override a recipe key, e.g. train.steps=200; repeatable.",
    ),
]
StoredIn = Annotated[
    Dtype,
    Option(
        "--dtype",
        help="Type of a Hugging Face backbone's weights: what it was stored in before it was "
        "trained, or another.",
    ),
]
VlmPrefix = Annotated[
    str | None,
    Option(
        metavar="NAME",
        help="Which of a policy's several VLMs is meant, as beside an average of the weights "
        "(EMA): the beginning of its tensors' names.",
    ),
]
Json = Annotated[bool, Option("--json", help="Print the report as JSON on stdout.")]
Wide = Annotated[
    bool,
    Option(
        "--wide",
        help="Print each row on one line, however narrow the terminal, for | less -S. Otherwise a "
        "table that is too wide continues below with its next columns.",
    ),
]
Against = Annotated[
    str | None,
    Option(
        "--against",
        metavar="RUN",
        help="Run that the others are compared with in pairs: its folder or its method; default: "
        "the first run or, if a folder of several comes first, its naive one.",
    ),
]
_RESUMED = "Continue from the last checkpoint in --out; without a run there, start one."
Resume = Annotated[
    bool,
    Option(
        "--resume",
        help=f"{_RESUMED} A finished run of a policy continues if train.steps is larger than "
        "before.",
    ),
]
ResumePretraining = Annotated[bool, Option("--resume", help=_RESUMED)]
Overwrite = Annotated[
    bool,
    Option(
        "--overwrite",
        help="Start over where Aegis has written before, and replace what it wrote there.",
    ),
]
Episodes = Annotated[int, Option(help="Number of episodes.", callback=positive)]
DropBelow = Annotated[
    float | None,
    Option(
        metavar="QUANTILE",
        help="For a suite task, drop episodes below this quantile of the returns; default: 0.25.",
        callback=below_one,
    ),
]
BackboneName = Annotated[
    str,
    Option(
        help="'embedded', 'embedded-easy', a checkpoint's folder or file, or a Hugging Face "
        "model's folder or id."
    ),
]
_SETS = (
    "'scenes', 'easy-vqa', a .jsonl or .json file, VQAv2's or OK-VQA's questions file, or a "
    "Hugging Face data set's folder or hub id, its split after a #"
)
Vqa = Annotated[str, Option(metavar="SET", help=f"{_SETS}.")]
OwnVqa = Annotated[
    str | None,
    Option(metavar="SET", help=f"{_SETS}; default: a run's own probe.vqa, else 'scenes'."),
]
_ASKED = (
    "What a question becomes before the model reads it, with {} for it, e.g. '{} Answer with a "
    "single word or phrase.'"
)
Ask = Annotated[str, Option(metavar="TEXT", help=_ASKED, callback=with_place)]
OwnAsk = Annotated[
    str | None,
    Option(
        metavar="TEXT",
        help=f"{_ASKED}; default: a run's own probe.ask, else as it is.",
        callback=with_place,
    ),
]
SkipBad = Annotated[
    bool, Option("--skip-bad", help="Leave out bad questions in files and count them.")
]
Device = Annotated[
    str | None,
    Option(
        "--device",
        metavar="DEVICE",
        envvar="AEGIS_DEVICE",  # read here, so that a missing device is refused before any work
        show_envvar=False,
        help="Where to compute: cpu, cuda, cuda:N or auto; default: AEGIS_DEVICE, else a GPU if "
        "there is one.",
    ),
]
_SAMPLES = "Samples per forward pass at most; changes speed and memory, not what is measured"
BatchSize = Annotated[int, Option(help=f"{_SAMPLES}.", callback=positive)]
OwnBatchSize = Annotated[
    int | None,
    Option(help=f"{_SAMPLES}; default: a run's own probe.batch_size, else 64.", callback=positive),
]
Ensemble = Annotated[
    float | None,
    Option(
        "--ensemble",
        metavar="DECAY",
        help="Temporal ensembling with this decay, as in a recipe's rollout.ensemble; default: as "
        "the policy was trained.",
    ),
]
Rename = Annotated[
    list[str] | None,
    Option(
        "--rename",
        metavar="NAME=NAME",
        help="Name of a camera, feature or joint in --demos, and the policy's name for it, as in "
        "demos.rename; repeatable.",
        callback=renamed,
    ),
]
PolicyArg = Annotated[
    Path,
    Argument(
        metavar="RUN",
        help="A run's folder, one of its checkpoints', an exported policy's, or a policy's id on "
        "the hub.",
    ),
]
OfStream = Annotated[
    str | None,
    Option("--task", metavar="NAME", help="Which policy, if RUN is a stream of robot tasks."),
]
MovedBackbone = Annotated[
    str | None,
    Option(
        "--backbone",
        metavar="MODEL",
        help="New place of the backbone that a stream of robot tasks was learned with, if it has "
        "moved.",
    ),
]
AnchorIn = Annotated[Path | None, Option(metavar="FILE", help="Anchor file of the backbone.")]
