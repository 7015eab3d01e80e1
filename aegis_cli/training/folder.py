"""A run folder's `recipe.yaml` and `metrics.jsonl`, and whether a run may be resumed in it."""

from __future__ import annotations

import dataclasses
import itertools
import json
import shutil
import sys
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from fnmatch import fnmatch
from pathlib import Path
from shlex import quote
from typing import Any, TypeVar

from aegis_cli import recipes
from aegis_cli.common import commands, files, locks, machine
from aegis_cli.common.errors import AegisError
from aegis_cli.models import backbones
from aegis_cli.recipes import Recipe, RobotStreamRecipe, StreamRecipe
from aegis_cli.training import checkpoint, inputs

METRICS = "metrics.jsonl"
JOBS_REPORT = "train.json"  # in a run that `aegis run` trained
MERGED = "merged"  # in such a run: the run that `aegis run` made from it by a merge
MERGE_REPORT = "merge.json"  # in the merged run; an earlier Aegis wrote it into the enclosing run
# What Aegis writes into a run's folder, beside its checkpoints.
_FILES = (
    "recipe.yaml",
    METRICS,
    *(f"{name}.safetensors" for name in ("ledger", "state", "expert", "experts", "routing")),
    *(JOBS_REPORT, MERGE_REPORT, "probe*.json", "rollout*.json", "evaluate*.json"),
    *(machine.NAME, inputs.NAME, "report.html"),
    *("*_matrix.json", "parameters.json", "stream.json"),
)
_FOLDERS = ("encoder", "backbone", "results", "tensorboard", "wandb")

Trained = Recipe | StreamRecipe | RobotStreamRecipe
T = TypeVar("T", bound=Trained)


def check(
    out: Path,
    recipe: Trained,
    resume: bool,
    overwrite: bool = False,
    read: Iterable[str | Path | None] = (),
) -> None:
    """Refuse an existing run unless it is to be resumed with the recipe it began with.

    With `overwrite` any run may be there, if it holds only files that Aegis has written, and none
    that the new run reads.

    Args:
        read: models and data that the new run reads.
    """
    saved = out / "recipe.yaml"
    if not saved.exists():
        if not files.is_vacant(out):
            raise AegisError(
                f"'{out}' is not empty and not a run",
                "a new or empty folder",
                "choose another --out",
            )
        return
    if overwrite:
        _check_read(out, read)
        _check_own(out)
        return
    if not resume:
        raise AegisError(
            f"an existing run in '{out}'",
            "a new folder",
            f"continue it: {commands.aegis('train', out)}, or the same command with --resume; "
            "begin anew with --overwrite, or choose another --out",
        )
    if not continues(out, recipe):
        raise AegisError(
            f"the run in '{out}' was started with other settings: "
            f"{_differences(_adjusted(_begun(out, recipe), recipe), recipe)}",
            "the recipe and overrides it began with",
            f"go on with its own: {commands.aegis('train', out)}; compare with '{saved}', or start "
            f"anew in another --out{_or_go_on_from(out, recipe)}",
        )


def learned(out: Path) -> str:
    """The options of a run that starts from what the policy run `out` has learned."""
    return f"--set {quote(f'backbone={out}')} --set {quote(f'expert.start={out}')}"


def _or_go_on_from(out: Path, recipe: Trained) -> str:
    """How to train a policy further with other settings, such as another learning rate."""
    is_policy = isinstance(recipe, Recipe) and checkpoint.begun(out)
    return f", from what this run has learned: {learned(out)}" if is_policy else ""


def goes_on(out: Path, recipe: Trained) -> bool:
    """Whether an existing run was begun with the same training settings as `recipe`."""
    return recipes.training_part(_begun(out, recipe)) == recipes.training_part(recipe)


def continues(out: Path, recipe: Trained) -> bool:
    """Whether a run may be resumed with `recipe`.

    Its backbone may have another path there: the checkpoints of a policy's run, and the state of a
    stream of robot tasks, hold the backbone's digest, which is compared later.
    Keys of `recipes.adjustable` may have other values.
    """
    begun = _begun(out, recipe)
    of_policy = isinstance(begun, Recipe) and checkpoint.begun(out)
    of_stream = isinstance(begun, RobotStreamRecipe) and is_learning(out)
    if (of_policy or of_stream) and not isinstance(recipe, StreamRecipe):
        assert not isinstance(begun, StreamRecipe)
        # A backbone is PATH#LAYERS. Only the path may differ: other layers of one model have the
        # same weights and the same digest, but train differently.
        _, layers_there = backbones.divided(begun.backbone)
        _, layers_here = backbones.divided(recipe.backbone)
        if layers_there == layers_here:
            begun = dataclasses.replace(begun, backbone=recipe.backbone)
    return recipes.training_part(_adjusted(begun, recipe)) == recipes.training_part(recipe)


def is_learning(out: Path) -> bool:
    """Whether a stream of robot tasks in `out` has files with the digest of its backbone."""
    return any((out / name).is_file() for name in ("state.safetensors", "expert.safetensors"))


def _adjusted(recipe: T, like: T) -> T:
    """The recipe with another's values of the keys that may change when a run is resumed."""
    if isinstance(recipe, StreamRecipe) or isinstance(like, StreamRecipe):
        return recipe  # a stream of images has none
    names = recipes.adjustable(recipe) & recipes.adjustable(like)
    values = {name: getattr(like.train, name) for name in names}
    return dataclasses.replace(recipe, train=dataclasses.replace(recipe.train, **values))


def as_begun(out: Path, recipe: T) -> T:
    """The recipe with the run's values of the keys that may change when it is resumed."""
    return _adjusted(recipe, recipes.load(out / "recipe.yaml", kind=type(recipe)))


def adjustments(out: Path, recipe: Recipe | RobotStreamRecipe) -> str:
    """The keys of `recipe` that change when the run is resumed with it; empty if none does."""
    there, here = as_begun(out, recipe).train, recipe.train
    names = {n for n in recipes.adjustable(recipe) if f"train.{n}" not in recipes.retired()}
    found = []
    for name in sorted(names):
        old, new = getattr(there, name), getattr(here, name)
        if old != new:
            found.append(f"train.{name}: {_said(new)} instead of {_said(old)}")
    return ", ".join(found)


def _begun(out: Path, recipe: Trained) -> Trained:
    """The recipe that a run began with, of the same kind as `recipe`."""
    return recipes.load(out / "recipe.yaml", kind=type(recipe))


def _differences(there: Trained, here: Trained) -> str:
    """The training settings that differ.

    Two methods' options are not listed, since neither run reads the other's.
    """
    shared = recipes.training_part(there).keys() & recipes.training_part(here).keys()
    # A stream's split is part of its training only if it is not the default.
    shared |= {"split"}
    names = {name.replace("-", "_") for name in shared}  # a method's options are a section
    return differences(_shaping(there, names), _shaping(here, names))


def _shaping(recipe: Trained, names: Collection[str]) -> dict[str, Any]:
    """These sections, and of a policy's `demos` only the keys that affect training."""
    found = {k: v for k, v in dataclasses.asdict(recipe).items() if k in names}
    return found | ({"demos": recipes.drawn(recipe)} if isinstance(recipe, Recipe) else {})


def differences(there: Mapping[str, Any], here: Mapping[str, Any]) -> str:
    """The keys of nested mappings that differ, with both values.

    For example: `train.steps: 450 there, 460 here`.
    """
    old, new = dict(_flat(there)), dict(_flat(here))
    found = []
    for key in old | new:
        if old.get(key) != new.get(key):
            found.append(f"{key}: {_said(old.get(key))} there, {_said(new.get(key))} here")
    return "; ".join(found)


def _flat(nested: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in nested.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _said(value: Any) -> str:
    """A value on one line, as a recipe writes it."""
    if value is None:
        return "nothing"
    if isinstance(value, bool | list | tuple):
        return json.dumps(value).replace('"', "")  # true instead of True, and lists as in YAML
    return str(value)


def clear(out: Path, ours: bool) -> Path | None:
    """Remove a run that can be made again, unless it holds files that Aegis has not written.

    Args:
        ours: whether it is on record that `aegis run` began it.

    Returns:
        Where the run was moved, because it holds other files; None if it was removed.

    Raises:
        AegisError: there are somebody else's files, or a process is at work there.
    """
    with locks.alone(out):
        return _clear(out, ours)


def check_ours(out: Path, ours: bool) -> None:
    """Raise AegisError if `clear` would not remove the folder: it holds somebody else's files."""
    if not ours and not files.is_vacant(out):
        fix = (
            f"move it: mv '{out}' ELSEWHERE; or choose another --out, or another name in the recipe"
        )
        raise AegisError(
            f"'{out}' is not empty, and `aegis run` did not begin it", "a new or empty folder", fix
        )


def _clear(out: Path, ours: bool) -> Path | None:
    check_ours(out, ours)
    if not any(_is_foreign(path, out) for path in out.rglob("*")):
        shutil.rmtree(out, ignore_errors=True)
        return None
    # A user's own files are never removed: the whole folder is renamed instead.
    aside = _free(out.with_name(f"{out.name}.{time.strftime('%Y-%m-%d_%H%M%S')}"))
    with checkpoint.writing(out):
        out.rename(aside)
    return aside


def _free(path: Path) -> Path:
    """This path, numbered if it already exists: a clock that was set back repeats a time."""
    numbered = (path.with_name(f"{path.name}-{number}") for number in itertools.count(2))
    return next(one for one in itertools.chain([path], numbered) if not one.exists())


def _check_own(out: Path) -> None:
    """Raise AegisError for a run with somebody else's files."""
    foreign = next((path for path in sorted(out.rglob("*")) if _is_foreign(path, out)), None)
    if foreign is not None:
        raise AegisError(
            f"'{foreign}', which Aegis did not write, in a run to be overwritten",
            "a run with no files but its own",
            f"move it: mv '{foreign}' ELSEWHERE; or choose another --out",
        )


def _check_read(out: Path, read: Iterable[str | Path | None]) -> None:
    """Raise AegisError if something that is read lies in the run that is to be overwritten."""
    for place in read:
        if place is not None and files.lies_in(Path(place), out):
            raise AegisError(
                f"'{place}' in the run '{out}', which is to be overwritten",
                "models and data that lie elsewhere",
                "choose another --out; or copy it to another place first, and name that",
            )


def remove(out: Path) -> None:
    """Remove a run that `check` has accepted; its folder stays, since it is locked.

    The recipe goes last: if this is interrupted, the rest is still recognized as a run.
    """
    for path in sorted(out.iterdir(), key=lambda path: path.name == "recipe.yaml"):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def _is_foreign(path: Path, out: Path) -> bool:
    """Whether a file or folder in a run is foreign: not one that Aegis writes there."""
    parts = path.relative_to(out).parts
    if files.is_left(out / parts[0]):  # a temporary file of a process that was killed
        return False
    if parts[0] in _FOLDERS:
        return False  # a model's folder holds what its family writes
    if parts[0] == MERGED and (len(parts) > 1 or (path / "recipe.yaml").is_file()):
        return len(parts) > 1 and _is_foreign(path, out / MERGED)  # a run within the run
    if parts[0] != "checkpoints":
        # No other folder is written by Aegis, so anything inside one is somebody else's.
        return len(parts) > 1 or not any(fnmatch(parts[0], name) for name in _FILES)
    step = parts[1] if len(parts) > 1 else checkpoint.LAST
    if not (step.isdecimal() or step == checkpoint.LAST or step.startswith(".")):
        return True
    return len(parts) > 2 and parts[2] not in checkpoint.PARTS


def merged_in(run: Path) -> Path | None:
    """The merged run that `aegis run` made from a run and measured in its place.

    Returns:
        None if there is none, or if the recipe of its job no longer asks for a merge.
    """
    asks = _holds_merged(run) and recipes.load(run / "recipe.yaml").merge.method is not None
    return run / MERGED if asks else None


def _holds_merged(run: Path) -> bool:
    return (run / MERGED / "recipe.yaml").is_file()


def trained_in(run: Path) -> Path:
    """The run that was trained: the enclosing run if `aegis run` made this one by a merge."""
    inside = run.name == MERGED and (run.parent / JOBS_REPORT).is_file()
    return run.parent if inside else run


def measured_in(run: Path) -> Path | None:
    """Where the figures that `aegis run` measured of a run lie, with its report of the merge.

    An earlier Aegis left those of a merged run in the enclosing run.

    Returns:
        The folder; None for a run that `aegis run` did not measure itself, since it measured the
        merged run made from it.
    """
    around = run.parent
    if run.name == MERGED and (around / MERGE_REPORT).is_file():
        return around
    # The recipe in a run of an earlier Aegis may not say that it was merged.
    return None if (run / MERGE_REPORT).is_file() and _holds_merged(run) else run


def begin(out: Path, recipe: Trained) -> None:
    """Start a run, its recipe first: it marks the folder as a run that may be begun again."""
    files.make_folder(out)
    write_recipe(out, recipe)
    files.write_text(out / METRICS, "")


def write_recipe(out: Path, recipe: Trained) -> None:
    """Write the recipe that a run is trained with."""
    files.write_text(out / "recipe.yaml", recipes.to_yaml(recipe))


def renew_recipe(out: Path, recipe: Trained) -> None:
    """Write a job's present recipe into a run that was not trained again.

    Its questions, gate or merge may have changed since the run was trained.
    """
    saved = out / "recipe.yaml"
    if not saved.is_file() or saved.read_bytes() != recipes.to_yaml(recipe).encode():
        write_recipe(out, recipe)


def append_metrics(out: Path, line: Mapping[str, float]) -> None:
    """Add one line to the log."""
    with checkpoint.writing(out), open(out / METRICS, "a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")


def read_metrics(out: Path, *needed: str) -> list[dict[str, Any]]:
    """The log's complete lines; one without its end was being written when the run stopped.

    Raises:
        AegisError: no log, or a line is not a JSON object with numbers for the `needed` keys.
    """
    path = out / METRICS
    with files.reading(path, "give a run folder that `aegis train` wrote"):
        lines = path.read_bytes().splitlines(keepends=True)
    return [
        _figures(path, number, line, needed)
        for number, line in enumerate(lines, 1)
        if line.endswith(b"\n")
    ]


def _figures(path: Path, number: int, line: bytes, needed: Sequence[str]) -> dict[str, Any]:
    """One line of the log."""
    try:
        found = files.parse_json(line)
        if not isinstance(found, dict) or not all(
            isinstance(found.get(key), int | float) for key in needed
        ):
            raise ValueError(f"no object with {', '.join(needed) or 'keys'}")
        if wrong := [key for key, value in found.items() if not _is_figure(value)]:
            raise ValueError(f"'{wrong[0]}' is not a finite number")
    except ValueError as error:
        said = f"{path} is damaged: line {number}: {error}"
        raise AegisError(said, "one JSON object per line", "delete the damaged line") from error
    return found


def _is_figure(value: Any) -> bool:
    if value is None:
        return True
    # Every comparison with NaN is false, so NaN is no figure; neither is infinity.
    return isinstance(value, int | float) and abs(value) < sys.float_info.max


def truncate_metrics(out: Path, step: int) -> None:
    """Forget what was logged after `step`: a resumed run repeats those steps."""
    kept = [json.dumps(line) + "\n" for line in read_metrics(out, "step") if line["step"] <= step]
    files.write_text(out / METRICS, "".join(kept))
