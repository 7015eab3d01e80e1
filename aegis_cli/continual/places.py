"""Where a stream of robot tasks finds its backbone and its demonstrations: `inputs.json`.

The run's other files hold digests of their contents; this one holds only paths, so that the folder
can be used from any other folder, and after it or its inputs have moved.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aegis_cli import recipes
from aegis_cli.common import commands, files, hub
from aegis_cli.common.errors import AegisError
from aegis_cli.models import backbones
from aegis_cli.recipes import RobotStreamRecipe
from aegis_cli.training import inputs
from aegis_cli.training.folder import is_learning

_RELATIVE = "relative"  # a key: the places relative to the run
_OPTION = "--backbone MODEL (in Python, backbone='MODEL')"


@dataclass(frozen=True)
class Places:
    """Absolute paths, or ids on the hub.

    Attributes:
        backbone: also the name of an embedded one.
        demos: one per task; empty if they are recorded beside the run.
    """

    backbone: str
    demos: tuple[str, ...]


def of(recipe: RobotStreamRecipe) -> Places:
    """The places that a recipe names, relative to the folder that the command is called in."""
    return Places(_absolute(recipe.backbone), tuple(map(_absolute, _named(recipe))))


def keep(out: Path, places: Places) -> None:
    """Write the places into a run's folder, both as absolute paths and relative to it."""
    began = inputs.began_in(out) or Path.cwd()
    absolute = _json(places.backbone, places.demos) | {inputs.BEGAN_IN: str(began)}
    here = out.absolute()

    def relative(name: str) -> str:
        own, layers = backbones.divided(name)
        if not Path(own).is_absolute():
            return name
        return _with_layers(os.path.relpath(own, here), layers)

    seen = _json(relative(places.backbone), list(map(relative, places.demos)))
    seen[inputs.BEGAN_IN] = relative(str(began))
    files.save_json(out / inputs.NAME, absolute | {_RELATIVE: seen})


def is_kept(out: Path, recipe: RobotStreamRecipe) -> bool:
    """Whether the run's folder suffices to find what a command has named."""
    known = _kept(out)
    try:
        return known is None or known[0] == of(here(out, recipe))
    except AegisError:  # the backbone is gone
        return False


def here(
    out: Path,
    recipe: RobotStreamRecipe,
    backbone: str | None = None,
    demos: Sequence[Path] = (),
    fix: str | None = None,
) -> RobotStreamRecipe:
    """A run's recipe with the present places of its backbone and its demonstrations.

    A path that is not there is looked up in the run's folder: where it was at the run's last start,
    or at the same place relative to the run. What a new recipe names otherwise stays as it is.

    Args:
        recipe: the run's own, or one to resume it with.
        backbone, demos: their new places; by default those of the recipe.
        fix: how to give the backbone's new place.

    Raises:
        AegisError: the backbone is gone. Demonstrations may be.
    """
    begun, known = _begun(out), _kept(out)
    if backbone is None:
        same = begun is not None and begun.backbone == recipe.backbone
        backbone = _found(out, recipe.backbone, *_backbones(known if same else None))
        own = backbones.divided(backbone)[0]
        local = hub.is_local(own) or own.startswith(backbones.LOCAL) or Path(own).is_absolute()
        if same and local and not backbones.is_here(backbone):
            raise AegisError(
                f"'{own}' is gone, the backbone of the stream in '{out}'",
                "the model that the stream was trained with",
                f"bring it back, or give its new path{_and_layers(recipe)}: {fix or _OPTION}",
            )
    recipe = dataclasses.replace(recipe, backbone=backbone)
    if demos:
        return _with_demos(out, recipe, demos)
    before, now = [] if begun is None else _named(begun), list(_named(recipe))
    for number, name in enumerate(now):
        if known is None or number >= min(len(known[0].demos), len(before)):
            continue
        if name == before[number]:
            now[number] = _found(out, name, known[0].demos[number], known[1].demos[number])
    if now and isinstance(recipe.demos.paths, str):
        now = now[:1]
    return _naming(recipe, now) if now else recipe


def to_learn(out: Path, recipe: RobotStreamRecipe) -> RobotStreamRecipe:
    """`here` for a run that is resumed.

    Raises:
        AegisError: the backbone or demonstrations are gone.
    """
    fix = commands.aegis("train", out, "--set", "backbone=MODEL")
    found = here(out, recipe, fix=fix)
    check_demos(out, found, "train")
    return found


def _and_layers(recipe: RobotStreamRecipe) -> str:
    """A reminder that a new path needs the layers that the recipe names, if it names any."""
    layers = backbones.divided(recipe.backbone)[1]
    return "" if layers is None else f", followed by #{layers}"


def as_begun(out: Path, recipe: RobotStreamRecipe) -> RobotStreamRecipe:
    """The recipe with the name of the backbone that the run in `out` began with, if there is one.

    Files of a run hold the digest of its recipe, with the name.
    """
    begun = _begun(out) if is_learning(out) else None
    return recipe if begun is None else dataclasses.replace(recipe, backbone=begun.backbone)


def refuse(run: Path) -> AegisError:
    """The error for a backbone's new place, where the run holds its backbone itself."""
    return AegisError(
        f"a new place of the backbone for '{run}', which holds its own",
        "a stream of robot tasks that was learned with experts beside a backbone",
        "leave out --backbone (in Python, backbone=)",
    )


def check_demos(out: Path, recipe: RobotStreamRecipe, command: str) -> None:
    """Raise AegisError if demonstrations that a run has learned from are gone.

    Args:
        recipe: as `here` returns it.
        command: train or probe, which take their new places.
    """
    begun, known = _begun(out), _kept(out)
    named = _named(recipe)
    for number, name in enumerate(named):
        learned = begun is not None and number < len(_named(begun))
        recorded = known is not None and name in known[0].demos
        is_path = Path(name).is_absolute() if recorded else hub.is_local(name)
        if learned and is_path and not Path(name).exists():
            count = 1 if isinstance(recipe.demos.paths, str) else len(named)
            again = _again(out, command, count)
            raise AegisError(
                f"'{name}' is gone, the demonstrations of '{recipe.tasks[number]}' in the stream "
                f"'{out}'",
                "the demonstrations that the task was learned from",
                f"bring them back, or give the new path of each task's: {again}",
            )


def _again(out: Path, command: str, count: int) -> str:
    if command == "train":
        paths = "PATH" if count == 1 else f"[{', '.join(['PATH'] * count)}]"
        return commands.aegis("train", out, "--set", f"demos.paths={paths}")
    return commands.aegis(command, out, *["--demos", "PATH"] * count)


def _with_demos(out: Path, recipe: RobotStreamRecipe, demos: Sequence[Path]) -> RobotStreamRecipe:
    """The recipe with other places of its demonstrations.

    Raises:
        AegisError: it names none, or another number of them.
    """
    paths = recipe.demos.paths
    if paths is None or recipe.simulated:
        raise AegisError(
            f"--demos with the stream in '{out}', whose tasks are simulated",
            "no demonstrations: simulated tasks are measured without them",
            "leave out --demos",
        )
    count = 1 if isinstance(paths, str) else len(paths)
    if len(demos) != count:
        raise AegisError(
            f"{len(demos)} of --demos for the stream in '{out}'",
            f"{count}: the demonstrations of {', '.join(recipe.tasks)}, in this order",
            _again(out, "probe", count),
        )
    return _naming(recipe, list(map(str, demos)))


def _naming(recipe: RobotStreamRecipe, names: Sequence[str]) -> RobotStreamRecipe:
    paths = names[0] if isinstance(recipe.demos.paths, str) else tuple(names)
    return dataclasses.replace(recipe, demos=dataclasses.replace(recipe.demos, paths=paths))


def _named(recipe: RobotStreamRecipe) -> tuple[str, ...]:
    """The demonstrations that a recipe names, one per task."""
    if recipe.demos.paths is None:
        return ()
    return tuple(recipe.demos.of_task(number) for number in range(len(recipe.tasks)))


def _begun(out: Path) -> RobotStreamRecipe | None:
    if not recipes.is_robot_stream_run(out):
        return None
    return recipes.load(out / "recipe.yaml", kind=RobotStreamRecipe)


def _backbones(known: tuple[Places, Places] | None) -> tuple[str | None, str | None]:
    return (None, None) if known is None else (known[0].backbone, known[1].backbone)


def _found(out: Path, given: str, kept: str | None, relative: str | None) -> str:
    """Where something is that a run names: as kept, else as given, else beside the run.

    An absolute path that is there is taken as given.
    """
    if kept is None or relative is None or not Path(kept).is_absolute():
        return given
    # A relative path may lead to something else here, in another checkout for example.
    if not Path(given).is_absolute() and _is_there(kept):
        return kept
    if _is_there(given):
        return given
    own, layers = backbones.divided(relative)
    moved = _with_layers(os.path.normpath(out.absolute() / own), layers)
    return moved if _is_there(moved) and not _is_there(kept) else kept


def _is_there(name: str) -> bool:
    own = backbones.divided(name)[0]
    return own in backbones.SHIPPED or Path(own).exists()


def _absolute(name: str) -> str:
    own, layers = backbones.divided(name)
    if own in backbones.SHIPPED or not Path(own).exists():
        return name  # an embedded model, or an id on the hub
    return _with_layers(str(Path(own).absolute()), layers)


def _with_layers(own: str, layers: str | None) -> str:
    return own if layers is None else f"{own}#{layers}"


def _json(backbone: str, demos: Sequence[str]) -> dict[str, Any]:
    return {"backbone": backbone, "demos": list(demos)}


def _kept(out: Path) -> tuple[Places, Places] | None:
    """The absolute places of a run and the relative ones; None for an earlier version's run.

    Raises:
        AegisError: the file is damaged.
    """
    path = out / inputs.NAME
    if not path.is_file():
        return None
    said = files.load_json(path)
    both = [_read(said), _read(said.get(_RELATIVE)) if isinstance(said, Mapping) else None]
    match both:
        case [Places() as kept, Places() as relative] if len(kept.demos) == len(relative.demos):
            return kept, relative
    raise AegisError(
        f"'{path}' is damaged: no places of a backbone and demonstrations",
        "the file as Aegis wrote it",
        "delete it; then name them: --backbone MODEL and, for probe, --demos PATH; of an "
        "unfinished run: aegis train RUN --set backbone=MODEL --set demos.paths=PATHS",
    )


def _read(said: Any) -> Places | None:
    match said:
        case {"backbone": str() as backbone, "demos": list() as demos} if all(
            isinstance(each, str) for each in demos
        ):
            return Places(backbone, tuple(demos))
    return None
