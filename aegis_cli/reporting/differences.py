"""Settings other than the method in which compared runs differ, so their figures mean less."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from aegis_cli.common import artifacts
from aegis_cli.data.vqa import easy, sets
from aegis_cli.evaluation import results
from aegis_cli.evaluation.results import PlayedResult, Result
from aegis_cli.training.up_to_date import digest

Value = str | int | float | None
_DIGITS = 12  # digits of a digest that suffice to distinguish two files
# The settings that determine the frames and actions of a validation loss.
_OF_VALIDATION = {"demonstrations", "seed", "episodes", "share held out", "chunk"}


def of_run(
    path: Path,
    steps: int | None,
    asked: tuple[str, Result] | None,
    played: Mapping[str | None, PlayedResult],
) -> dict[str, Value]:
    """The settings that must be equal for two runs to differ only in their methods, by name.

    Args:
        asked: the question set whose figures are compared, and its probe; None without any.
        played: the rollouts whose figures are compared, by their colours.
    """
    recipe = results.recipe_of(path)
    inputs = artifacts.read_header(path / "ledger.safetensors").inputs
    return {
        "backbone": inputs.get("backbone", "")[:_DIGITS] or None,
        "demonstrations": inputs.get("demos", "")[:_DIGITS] or None,
        "episodes": recipe.demos.only or "all",
        "share held out": recipe.train.validation_share,
        "seed": recipe.seed,
        "chunk": recipe.train.chunk,
        "steps": steps,
        "batch size": recipe.train.batch_size,
        "questions": None if asked is None else _questions(path, *asked),
        "rollout": _rollout(played.get("seen", played.get(None))),
        "held-out rollout": _rollout(played.get("held-out")),
    }


def _rollout(found: PlayedResult | None) -> str | None:
    """The episodes of a rollout and its settings; None without a rollout."""
    if found is None:
        return None
    words = [f"{found.figures['episodes']} episodes of {found.figures.get('task')}"]
    for name, value in vars(found.played).items():
        if value is not None and value is not False:  # a delay of 0 counts as a setting
            words.append(f"{name} {value}")
    return ", ".join(words)


def _questions(path: Path, vqa: str, probed: Result) -> str:
    """The questions of a probe and how they were asked, by its own settings or the run's recipe.

    A name does not distinguish two files: any folder may have a `questions.jsonl`, and a file may
    have been changed. The number of questions in each family and the share of the family's most
    common answer depend only on the questions, not on the model.
    """
    own = results.recipe_of(path).probe
    words = [f"{probed.figures.get('questions', 0):,} of {vqa}"]
    families = probed.figures.get("families")
    # For the shipped sets, the name and the seed below suffice.
    if vqa not in (sets.SCENES, easy.NAME) and families:
        told = {name: [one["questions"], one["majority"]] for name, one in families.items()}
        words.append(f"families of digest {digest(told)[:_DIGITS]}")
    # A probe of `aegis run` has no settings of its own and uses those of the recipe.
    seed, ask = probed.settings.get("seed", own.seed), probed.settings.get("ask", own.ask)
    if seed != 0:
        words.append(f"seed {seed}")
    if ask != "{}":
        words.append(f"asked as '{ask}'")
    return ", ".join(words)


def between(facts: Sequence[dict[str, Value]]) -> dict[str, list[Value]]:
    """Each setting in which runs differ, with its value for every run.

    A run for which a setting is unknown does not count as different.
    """
    found = {}
    for name in facts[0] if facts else ():
        values = [own[name] for own in facts]
        if len({value for value in values if value is not None}) > 1:
            found[name] = values
    return found


def same_validation(found: dict[str, list[Value]]) -> bool:
    """Whether the runs' validation losses are on the same frames and actions."""
    return not found.keys() & _OF_VALIDATION


def said(found: dict[str, list[Value]]) -> str:
    """The differences in words, without digests, which mean nothing to a reader."""
    words = []
    for name, values in found.items():
        listed = "; ".join("-" if value is None else str(value) for value in values)
        words.append(name if name in ("backbone", "demonstrations") else f"{name} ({listed})")
    return ", ".join(words)
