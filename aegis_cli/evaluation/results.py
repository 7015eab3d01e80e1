"""Results of probes, rollouts and open-loop evaluations of a run, kept in its folder.

`aegis run` writes probe.json and rollout-*.json beside the checkpoints, and knows by their digests
what is up to date. Results of `aegis probe`, `aegis rollout` and `aegis evaluate` are in a separate
folder, `results`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import glob
import hashlib
import itertools
import os
import re
import time
from collections.abc import Generator, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from aegis_cli import recipes
from aegis_cli.common import artifacts, files, locks
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Warned, ignore
from aegis_cli.data.vqa.gate import passes
from aegis_cli.evaluation import kept_figures
from aegis_cli.evaluation.kept_figures import OpenLoopFigures, ProbeFigures, RolloutFigures
from aegis_cli.models import backbones
from aegis_cli.training import checkpoint, folder, inputs, track

FOLDER = "results"
OPEN_LOOP = "evaluate"  # prefix of its files' names
# Which episodes an open-loop evaluation used.
VALIDATION, OTHER, CHOSEN, UNKNOWN = "validation", "other data", "chosen", "unknown"
_PATIENCE_S = 5.0  # for other processes that write there
# How much each kind of measurement is of: the figure that counts it.
_COUNTS = {"probe": "questions", "rollout": "episodes", OPEN_LOOP: "frames"}
_SMALLER = "-of-{count}-{name}"  # added to the name of one that is kept beside a larger one
# Figures that one probe of a checkpoint has and another of the same questions may lack.
_TOLD = {"drop_points": "drop", "passed": "gate", "layers": "drift"}


def keep(
    target: Path,
    name: str,
    figures: Mapping[str, Any],
    settings: Mapping[str, Any],
    on_event: OnEvent = ignore,
) -> Path | None:
    """Write a measurement of a run, or of one of its checkpoints, into the run's folder.

    A later one with the same name replaces it if both used the same question set or demonstrations;
    files in different folders may have the same name. A probe with fewer figures than an earlier
    one, such as no drop, is kept beside it, and so is one of fewer questions, frames or episodes;
    `on_event` receives a message about that.

    Args:
        name: `probe-scenes`, `rollout-seen` or `evaluate-validation-arm`.
        figures: what was measured, as `--json` shows it.
        settings: what was requested, written with the figures; `path` is that of the question set
            or the demonstrations, if they are a file or a folder.

    Returns:
        The file; None if `target` is not a run of one policy, or may not be written to.

    Raises:
        AegisError: another process writes there for longer than some seconds, or the disk is full.
    """
    found = _run_and_step(target)
    if found is None or not os.access(found[0], os.W_OK):
        return None
    run, step = found
    figures, settings = _in_utf8(figures), _in_utf8(settings)
    # A file's name or a dataset's path may contain any character.
    plain = re.sub(r"[^\w.-]+", "_", name).strip("_.")
    # Results of the last checkpoint have the plain name; those of an earlier one add its step.
    of_last = step == _last_step(run)
    with _soon_alone(run / FOLDER):
        path = run / FOLDER / (f"{plain}.json" if of_last else f"{plain}-{step:06d}.json")
        if _is_of_other_data(path, settings):
            told_apart = hashlib.sha256(settings["path"].encode()).hexdigest()[:8]
            path = path.with_name(f"{path.stem}-{told_apart}.json")
        path = _place_for(path, figures, settings, step, on_event)
        files.save_json(path, {**figures, "settings": settings, "step": step})
    recipe = recipe_of(run)
    if recipe.train.track and step is not None:
        track.tell(recipe, run, plain, figures, step)
    return path


def keep_if_possible(
    target: Path,
    name: str,
    figures: Mapping[str, Any],
    settings: Mapping[str, Any],
    on_event: OnEvent,
) -> None:
    """Like `keep`, but if writing fails, warn instead, so that the figures are not lost."""
    try:
        keep(target, name, figures, settings, on_event)
    except AegisError as problem:
        text = f"not kept in '{run_of(target)}': {problem.found}; {problem.fix}"
        on_event(Warned(name.partition("-")[0], text))


def _in_utf8(value: Any) -> Any:
    """A measurement as valid UTF-8: bytes of a path that are not UTF-8 are escaped."""
    if isinstance(value, str):
        return value.encode("utf-8", "backslashreplace").decode()
    if isinstance(value, Mapping):
        return {name: _in_utf8(inner) for name, inner in value.items()}
    return [_in_utf8(inner) for inner in value] if isinstance(value, (list, tuple)) else value


@contextlib.contextmanager
def _soon_alone(place: Path) -> Generator[None]:
    """Be the only process that writes there, waiting some seconds at most for others to finish.

    Raises:
        AegisError: another process is still writing.
    """
    until = time.monotonic() + _PATIENCE_S
    with contextlib.ExitStack() as held:
        while True:
            try:
                held.enter_context(locks.alone(place))
                break
            except AegisError:
                # The folder may be gone by now: a process that leaves it empty removes it.
                if time.monotonic() > until:
                    raise
                time.sleep(0.1)
        yield


def _is_of_other_data(path: Path, settings: Mapping[str, Any]) -> bool:
    """Whether a file's results are for questions or demonstrations at another path."""
    if "path" not in settings:
        return False
    there = _kept(path).get("settings") or {}
    return there.get("path", settings["path"]) != settings["path"]


def _kept(path: Path) -> dict[str, Any]:
    """A file's results with their settings; empty if there is no such file."""
    found = files.load_json(path) if path.is_file() else None
    return found if isinstance(found, dict) else {}


def _place_for(
    path: Path,
    figures: Mapping[str, Any],
    settings: Mapping[str, Any],
    step: int | None,
    on_event: OnEvent,
) -> Path:
    """Where to keep a measurement: in place of an earlier one, unless that one is worth more.

    An earlier one of the same checkpoint is worth more if it is of more questions, frames or
    episodes, or has figures that the new one lacks.
    """
    kind = path.stem.partition("-")[0]
    if kind == "probe":
        path = _beside_what_tells_more(path, figures, step, on_event)
    name = _COUNTS[kind]
    count, earlier = figures.get(name, 0), _kept(path)
    if earlier.get(name, 0) <= count or earlier.get("step", step) != step:
        _remove_smaller(path, kind, figures, settings)
        return path
    text = (
        f"kept beside the earlier '{path}', which is of {earlier[name]:,} {name} and not of "
        f"{count:,}"
    )
    on_event(Warned(kind, text))
    path = path.with_name(f"{path.stem}{_SMALLER.format(count=count, name=name)}.json")
    return _beside_what_tells_more(path, figures, step, on_event) if kind == "probe" else path


def _remove_smaller(
    path: Path, kind: str, figures: Mapping[str, Any], settings: Mapping[str, Any]
) -> None:
    """Remove what `_place_for` kept beside a measurement that a new one makes superfluous."""
    name, new = _COUNTS[kind], Result(path.stem, dict(figures), dict(settings))
    pattern = _SMALLER.format(count="*", name=name)
    for other in path.parent.glob(f"{glob.escape(path.stem)}{pattern}*.json"):
        found = _kept(other)
        small = Result(other.stem, found, found.get("settings") or {})
        if found.get(name, 0) <= figures.get(name, 0) and _is_part(kind, small, new):
            other.unlink(missing_ok=True)


def _is_part(kind: str, small: Result, large: Result) -> bool:
    """Whether a measurement tells nothing that one of more questions, frames or episodes does not.

    Both were asked for the same except for that number.
    """
    vary, told = {_COUNTS[kind]}, _told(small.figures)
    if "drop" not in told:
        vary.add("baseline")
    if "gate" not in told:
        vary |= {"max_drop", "gate"}
    names = (small.settings.keys() | large.settings.keys()) - vary
    same = all(small.settings.get(name) == large.settings.get(name) for name in names)
    return same and told <= _told(large.figures)


def _beside_what_tells_more(
    path: Path, figures: Mapping[str, Any], step: int | None, on_event: OnEvent
) -> Path:
    """Where to keep a probe: beside an earlier one with figures that it lacks, else in its place.

    Earlier ones that have no more figures than the new one, and are of no more questions, are
    removed, as if replaced.
    """
    told = _told(figures)
    # A name for each subset of the optional figures, such as PROBE-with-drop-gate. A probe with all
    # of them has the plain name, so only smaller subsets are listed here.
    by_told: dict[Path, set[str]] = {}
    for size in range(len(_TOLD)):
        for some in itertools.combinations(_TOLD.values(), size):
            words = "-".join(some or ("accuracy",))
            by_told[path.with_name(f"{path.stem}-with-{words}.json")] = set(some)
    name = _COUNTS["probe"]
    for other, theirs in by_told.items():
        if theirs <= told and _kept(other).get(name, 0) <= figures.get(name, 0):
            other.unlink(missing_ok=True)
    earlier = _kept(path)
    more = [word for word in _TOLD.values() if word in _told(earlier) - told]
    if not more or earlier.get("step", step) != step:
        return path
    text = f"kept beside the earlier '{path}', which also tells the {' and the '.join(more)}"
    on_event(Warned("probe", text))
    return next(other for other, theirs in by_told.items() if theirs == told)


def _told(figures: Mapping[str, Any]) -> set[str]:
    """The words of `_TOLD` for the figures that a probe has."""
    return {word for key, word in _TOLD.items() if figures.get(key) not in (None, [])}


def run_of(target: Path) -> Path | None:
    """The run of one policy to which a folder belongs: itself or its checkpoint; else None."""
    found = _run_and_step(target)
    return None if found is None else found[0]


def recipe_of(run: Path) -> recipes.Recipe:
    """The recipe with which a run of one policy was trained."""
    return recipes.load(run / "recipe.yaml")


class Origin(NamedTuple):
    """A model that a run started from.

    Attributes:
        name: as in a recipe.
        digest: digest of its weights; None if no checkpoint of the run records it.
    """

    name: str
    digest: str | None


def origins(run: Path) -> list[Origin]:
    """The models that a run started from: its backbone, and if that is a run, its backbone too.

    The last one is the VLM that no run of Aegis has trained.
    """
    found: list[Origin] = []
    seen: set[Path] = set()
    while True:
        seen.add(run.resolve())
        expert = run / "checkpoints" / checkpoint.LAST / checkpoint.EXPERT
        header = artifacts.read_header(expert) if expert.is_file() else None
        digest = None if header is None else header.inputs.get("backbone")
        found.append(Origin(recipe_of(run).backbone, digest))
        before = run_of(Path(backbones.divided(found[-1].name)[0]))
        # A run that was moved to the path of its own backbone would start from itself.
        if before is None or before.resolve() in seen:
            return found
        run = before


def _run_and_step(target: Path) -> tuple[Path, int | None] | None:
    """The run that a path belongs to, and the step of its weights; None for other paths.

    The step of a run is None if it has no checkpoint.
    """
    if (target / "recipe.yaml").is_file():
        return None if recipes.is_stream_run(target) else (target, _last_step(target))
    if checkpoint.is_one(target) and (run := checkpoint.run_of(target)) is not None:
        return run, checkpoint.step_of(target)
    return None


def _last_step(run: Path) -> int | None:
    """The step of the last checkpoint; None if a study has removed it."""
    link = run / "checkpoints" / checkpoint.LAST
    return checkpoint.step_of(link) if link.is_dir() else None


@dataclasses.dataclass(frozen=True)
class Result:
    """One measurement of a run.

    Attributes:
        name: its file's name without the suffix.
        figures: as `--json` shows them.
        settings: what was requested; empty if `aegis run` measured it by the run's recipe.
    """

    name: str
    figures: dict[str, Any]
    settings: dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Played:
    """How a rollout was played: the seed of its episodes, and how the policy's chunks were used.

    For a rollout by the run's recipe, these values come from the recipe.

    Attributes:
        delay, guided: as given to `aegis rollout`; None without a delay.
    """

    seed: int
    replan: int
    ensemble: float | None
    delay: int | None = None
    guided: bool | None = None


@dataclasses.dataclass(frozen=True)
class PlayedResult(Result):
    """One rollout of a run."""

    played: Played


def probes(run: Path) -> list[Result]:
    """The probes of a run's last checkpoint; those of `aegis run` come first.

    A later probe with the same questions and results is merged into the first one. A probe of fewer
    questions than another of the same set, and with no other figures, is left out.
    """
    recipe, each = recipe_of(run), list[Result]()
    read = [found for _, found in _read(run, "probe", ProbeFigures)]
    for found in _without_smaller("probe", read):
        by_recipe = [i for i, first in enumerate(each) if not first.settings]
        again = [i for i in by_recipe if _is_again(found, each[i], recipe)]
        for i in again[:1]:  # it may have more figures, such as the baseline's drift
            each[i] = dataclasses.replace(each[i], figures={**each[i].figures, **found.figures})
        each += [] if again else [found]
    return each


def _is_again(found: Result, first: Result, recipe: recipes.Recipe) -> bool:
    """Whether a probe had the questions and results of `first`, a probe by the recipe."""
    limits = {"max_drop": recipe.probe.max_drop, "gate": recipe.probe.gate}
    if question_set(found, recipe) != question_set(first, recipe):
        return False
    if found.figures.get("passed") is not None and limits != {
        name: found.settings.get(name, limit) for name, limit in limits.items()
    }:
        return False
    here, there = (_without_baseline(one.figures) for one in (first, found))
    both = here.keys() & there.keys()
    return _told(there) <= _told(here) and all(here[name] == there[name] for name in both)


def _without_baseline(figures: Mapping[str, Any]) -> dict[str, Any]:
    """A probe's figures without the baseline's drift, which `aegis run` does not measure."""
    layers = [{**layer, "baseline_w2": None} for layer in figures.get("layers") or []]
    return {**figures, "layers": layers}


def rollouts(run: Path) -> list[PlayedResult]:
    """The rollouts of a run's last checkpoint; those of `aegis run` come first.

    Held-out colours come after those of training. If several played the same episodes in the same
    way, only the newest is listed; of several by `aegis rollout` that were played in the same way,
    only the one of the most episodes.
    """
    recipe = recipe_of(run)
    newest = dict[tuple[Any, ...], tuple[int, PlayedResult]]()
    read = _read(run, "rollout", RolloutFigures)
    shown = _without_smaller("rollout", [found for _, found in read])
    for path, found in read:
        if not any(found is one for one in shown):
            continue
        played = _played(found, recipe)
        episodes = tuple(found.figures.get(name) for name in ("task", "colors", "episodes"))
        written = path.stat().st_mtime_ns
        before = newest.get((*episodes, played))
        if before is None or before[0] <= written:
            newest[*episodes, played] = written, PlayedResult(**vars(found), played=played)
    each = [found for _, found in newest.values()]
    return sorted(each, key=lambda found: found.figures.get("colors") == "held-out")


def _played(found: Result, recipe: recipes.Recipe) -> Played:
    """How a rollout was played; earlier versions did not record all of it."""
    said, own = found.settings, recipe.rollout
    if not said:
        return Played(own.seed, own.replan, own.ensemble)
    seed, replan = said.get("seed", recipes.Rollout().seed), said.get("replan", own.replan)
    delayed = said.get("delay"), said.get("guided")
    return Played(seed, replan, said.get("ensemble"), *delayed)


def told_apart(played: Sequence[Played]) -> list[str]:
    """Describes each rollout by the settings in which the given rollouts differ."""
    names = [field.name for field in dataclasses.fields(Played)]
    differ = [name for name in names if len({getattr(one, name) for one in played}) > 1]
    found = []
    for one in played:
        words = [_said(name, getattr(one, name)) for name in differ]
        found.append(", ".join(filter(None, words)))  # an unguided rollout has no word for this
    return found


def _said(name: str, value: float | None) -> str:
    if name == "guided":
        return "guided" if value else ""
    return f"no {name}" if value is None else f"{name} {value}"


def open_loops(run: Path) -> list[Result]:
    """The open-loop evaluations of a run's last checkpoint; its validation episodes come first.

    Of several with equal results, such as by `aegis run` and `aegis evaluate`, the first is listed;
    of several by `aegis evaluate` on the same episodes, the one at the most frames.
    """
    found = dict[str, Result]()
    read = [one for _, one in _read(run, OPEN_LOOP, OpenLoopFigures)]
    for one in _without_smaller(OPEN_LOOP, read):
        # The path of the data may be written in several ways, and an earlier version did not record
        # single episodes.
        vary = ("data", "episode_errors")
        told = {name: value for name, value in one.figures.items() if name not in vary}
        found.setdefault(files.canonical(told), one)
    return sorted(found.values(), key=lambda one: one.figures["split"] != VALIDATION)


def _without_smaller(kind: str, read: Sequence[Result]) -> list[Result]:
    """The results without those that are part of a larger one by the same command."""
    name = _COUNTS[kind]

    def is_superfluous(one: Result) -> bool:
        # `aegis run` measures what the recipe asks for; these results always stay.
        return bool(one.settings) and any(
            other.settings
            and other.figures.get(name, 0) > one.figures.get(name, 0)
            and _is_part(kind, one, other)
            for other in read
        )

    return [one for one in read if not is_superfluous(one)]


def _read(
    run: Path, kind: str, figures: type[ProbeFigures | RolloutFigures | OpenLoopFigures]
) -> list[tuple[Path, Result]]:
    """The results for a run's last checkpoint, each with its file."""
    last = _last_step(run)
    # Results from before further training no longer hold. Earlier versions recorded no step for a
    # run.
    return [
        (path, found) for path, found, step in _each(run, kind, figures) if step in (None, last)
    ]


def steps_measured_before(run: Path) -> list[int]:
    """The steps of a run for which there are results, except its last checkpoint's."""
    kinds = (("probe", ProbeFigures), ("rollout", RolloutFigures), (OPEN_LOOP, OpenLoopFigures))
    steps = {step for kind, figures in kinds for *_, step in _each(run, kind, figures)}
    return sorted(step for step in steps - {None, _last_step(run)} if step is not None)


def _each(
    run: Path, kind: str, figures: type[ProbeFigures | RolloutFigures | OpenLoopFigures]
) -> Iterator[tuple[Path, Result, int | None]]:
    """The results for a run's checkpoints: the file, its contents and the step."""
    by_recipe, own = [], folder.measured_in(run)
    listed = [] if own is None else [own.glob(f"{kind}.json"), own.glob(f"{kind}-*.json")]
    for path in [path for found in listed for path in sorted(found)]:
        # A study chooses its settings by figures on validation data, so these are not results.
        if not re.match(rf"{kind}-validation(-|$)", path.stem):
            by_recipe.append(path)
    # A probe with fewer figures than another of the same questions comes after it, since its name
    # is the other's followed by `-with-...`.
    apart = sorted((run / FOLDER).glob(f"{kind}-*.json"), key=lambda path: path.stem)
    recipe = recipe_of(run) if by_recipe else None
    for path in [*by_recipe, *apart]:
        raw = kept_figures.read(path, figures)
        settings, step = raw.pop("settings", None) or {}, raw.pop("step", None)
        found = Result(path.stem, raw, settings)
        if recipe is None or path in apart or _is_asked_for(found, kind, recipe):
            yield path, found, step


def _is_asked_for(found: Result, kind: str, recipe: recipes.Recipe) -> bool:
    """Whether the recipe still asks for what `aegis run` measured.

    The run's earlier recipe may have had more question sets, or other colours.
    """
    if kind == "probe":
        return _number(found, kind) <= len(recipe.probe.of_each_set())
    colors = found.figures.get("colors") if kind == "rollout" else None
    return colors is None or colors in recipe.rollout.colors


def evaluated_on(figures: Mapping[str, Any]) -> str:
    """The episodes of an open-loop evaluation in words, such as `3 held-out episodes of arm`."""
    data, count, trained = Path(figures["data"]), len(figures["episodes"]), figures["trained_on"]
    which = {VALIDATION: "held-out ", CHOSEN: "chosen "}.get(figures["split"], "")
    # A model card should not contain the path of a folder.
    said = f"{count:,} {which}episode{'s' * (count != 1)} of "
    said += data.name if data.is_absolute() else str(data)
    if figures["split"] == OTHER:
        said += ", which is other data than the training's"
    return said + (f", {len(trained):,} of them trained on" if trained else "")


def evaluated_data(run: Path, evaluated: Result) -> str:
    """The demonstrations of an open-loop evaluation: an absolute path, or an id.

    `aegis run` records the recipe's path, which may be relative to the working directory of that
    time; the run has the absolute path.
    """
    if "path" in evaluated.settings:
        return str(evaluated.settings["path"])
    known, number = inputs.of(run), _number(evaluated, OPEN_LOOP)
    if known is not None and number <= len(known.demos):
        return known.demos[number - 1]
    named = Path(evaluated.figures["data"])
    return str(named.absolute() if named.exists() else named)


def question_set(probed: Result, recipe: recipes.Recipe) -> str:
    """The question set of a probe as the user named it: its own, or one of the recipe's."""
    if "vqa" in probed.settings:
        return str(probed.settings["vqa"])
    sets, place = recipe.probe.of_each_set(), _number(probed, "probe") - 1
    return str(sets[place if place < len(sets) else 0].vqa)


def _number(found: Result, kind: str) -> int:
    """The number, from 1, of the recipe's set to which a result of `aegis run` belongs."""
    number = found.name.removeprefix(kind).lstrip("-") or "1"
    return int(number) if number.isdigit() else 1


def gate(probed: Sequence[Result], settings: recipes.Probe) -> bool | None:
    """Whether every probe passes its gate; None if there is none.

    Args:
        settings: the probe settings of the run's recipe, which apply to the probes of `aegis run`.
    """
    max_drop = settings.max_drop
    verdicts = []
    for result in probed:
        passed, drop = result.figures.get("passed"), result.figures.get("drop_points")
        # Measured by `aegis run` when its recipe had no gate; the recipe's present gate applies.
        if passed is None and max_drop is not None and not result.settings and drop is not None:
            interval = result.figures.get("drop_interval")
            passed = passes(drop, interval, max_drop, settings.gate)
        if passed is not None:
            verdicts.append(passed)
    return all(verdicts) if verdicts else None
