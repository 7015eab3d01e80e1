"""Several sets of demonstrations that one policy is trained on together.

They are of one robot: cameras, positions, actions and control rate have to agree. Each set holds
out its own episodes, as it would alone. They are concatenated to one set, whose scale is that of
all training frames.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import torch

from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Warned, ignore
from aegis_cli.data import demonstrations, joints, other_units, renaming
from aegis_cli.data.batch import deviations
from aegis_cli.data.demonstrations import Demonstrations, Member
from aegis_cli.data.joined_frames import JoinedFrames
from aegis_cli.data.lerobot import dataset, layout
from aegis_cli.data.lerobot import source as sources
from aegis_cli.data.renaming import Renaming
from aegis_cli.data.selection import ALL, Paths, Selection, listed

_INPUT = "demos"  # the name of the demonstrations' digest in an artifact's header


def each(paths: str | Path | Sequence[Path]) -> tuple[Path, ...]:
    """The sets, one by one."""
    return (Path(paths),) if isinstance(paths, str | Path) else tuple(map(Path, paths))


def said(paths: Paths) -> str:
    """Their names in a sentence."""
    return " and ".join(f"'{path}'" for path in each(paths))


def at(named: str | Sequence[str]) -> Paths:
    """The sets that `demos.path` names, each checked by `demonstrations.at`."""
    if isinstance(named, str):
        return demonstrations.at(named)
    return tuple(demonstrations.at(name) for name in named)


def load(
    paths: Paths,
    validation_share: float | None,
    seed: int,
    selection: Selection = ALL,
    image_size: int | None = None,
    workers: int | None = None,
    on_event: OnEvent = ignore,
    cache: bool | None = True,
    check_text: Callable[[str], None] | None = None,
) -> Demonstrations:
    """Read one set of demonstrations as `demonstrations.load` does, or read several and join them.

    Raises:
        AegisError: something is wrong with one of them, the sets are not of one robot, a set is
            named twice, episodes are selected from several sets, or a name to be renamed is in no
            set.
    """
    chosen = each(paths)
    # First all that the meta folders can show: decoding a set can take hours.
    _check_each_once(chosen)
    check_rename(chosen, selection.rename)
    if len(chosen) > 1:
        _check_selection(chosen, selection)
        _check_alike(chosen, selection)
    found = [
        demonstrations.load(
            path,
            validation_share,
            seed,
            selection,
            image_size,
            workers,
            on_event,
            cache,
            check_text,
        )
        for path in chosen
    ]
    return joined(chosen, found, on_event)


def joined(
    paths: Sequence[Path], found: Sequence[Demonstrations], on_event: OnEvent = ignore
) -> Demonstrations:
    """Concatenate the sets; a single one is returned unchanged.

    Pictures are resized to the first set's size, as they are when the policy acts.

    Args:
        paths: the name of each set.
    """
    first, *others = found
    if not others:
        return first
    sizes = [(frames.shape[1], frames.shape[2]) for frames in first.frames]  # of each camera
    _warn_of_other_sizes(paths, found, on_event)
    _warn_of_other_units(paths, found, on_event)
    shown = [first, *(other.fitted(sizes) for other in others)]
    # Frames and episodes are numbered consecutively: each set's numbers start where the previous
    # set ends.
    starts = _begin_at([len(own.episode_of) for own in shown])
    numbered = list(zip(shown, starts, strict=True))
    first_episodes = _begin_at([len(own.tensors["episode_starts"]) - 1 for own in shown])
    episode_of = [own.episode_of + n for own, n in zip(shown, first_episodes, strict=True)]
    ends = [own.tensors["episode_starts"][1:] + start for own, start in numbered]
    # An instruction of several sets is listed once.
    texts = list(dict.fromkeys(text for own in shown for text in own.instructions))
    of_camera = zip(*(own.frames for own in shown), strict=True)
    members = zip(paths, shown, strict=True)
    # `_check_alike` has compared the sets, so the first one that has a value decides.
    return Demonstrations(
        task=next((own.task for own in shown if own.task is not None), None),
        frames=tuple(map(JoinedFrames, of_camera)),
        tensors={
            "proprio": torch.cat([own.tensors["proprio"] for own in shown]),
            "actions": torch.cat([own.tensors["actions"] for own in shown]),
            "episode_starts": torch.cat([torch.zeros(1, dtype=torch.int64), *ends]),
        },
        instructions=texts,
        instruction_of=torch.cat([_renumbered(own, texts) for own in shown]),
        episode_of=torch.cat(episode_of),
        train=torch.cat([own.train + start for own, start in numbered]),
        validation=torch.cat([own.validation + start for own, start in numbered]),
        sha256=sources.joined_digest([own.sha256 for own in shown], "sets"),
        cameras=next((own.cameras for own in shown if own.cameras), ()),
        watched=tuple(watched for own in shown for watched in own.watched),
        action_names=next((own.action_names for own in shown if any(own.action_names)), ()),
        proprio_names=next((own.proprio_names for own in shown if any(own.proprio_names)), ()),
        fps=next((own.fps for own in shown if own.fps is not None), None),
        datasets=tuple(name for own in shown for name in own.datasets),
        members=tuple(Member(str(path), own.sha256, len(own.train)) for path, own in members),
    )


def _begin_at(counts: Sequence[int]) -> list[int]:
    """The offset of each of several consecutive parts of these lengths; the first is 0."""
    return [0, *itertools.accumulate(counts[:-1])]


def _renumbered(own: Demonstrations, texts: Sequence[str]) -> torch.Tensor:
    """The text of each of a set's frames, as an index into all sets' texts."""
    places = {text: place for place, text in enumerate(texts)}
    of_own = torch.tensor([places[text] for text in own.instructions])
    return of_own[own.instruction_of]


def playable_task(
    paths: Paths, camera: str | tuple[str, ...] | None, named: str, rename: Renaming = ()
) -> str | None:
    """As `demonstrations.playable_task`, for one set or the first of several that has a task."""
    tasks = (demonstrations.playable_task(path, camera, named, rename) for path in each(paths))
    return next((task for task in tasks if task is not None), None)


# --- digests --------------------------------------------------------------------------------------


def digest(paths: Paths, selection: Selection = ALL) -> str:
    """sha256 of everything that `load` would read."""
    of_sets = [demonstrations.digest(path, selection) for path in each(paths)]
    return sources.joined_digest(of_sets, "sets")


def inputs(found: Demonstrations) -> dict[str, str]:
    """The digests for an artifact's header: of all sets together, and of each of several."""
    named = {_INPUT: found.sha256}
    for number, member in enumerate(found.members, start=1):
        named[f"{_INPUT} {number}"] = member.sha256
    return named


def digests(inputs: Mapping[str, str]) -> frozenset[str]:
    """The digests of demonstrations among a header's inputs, including those of single sets."""
    own = [name for name in inputs if name.split(" ")[0] == _INPUT]  # `demos 2` is the second set
    return frozenset(inputs[name] for name in own)


def differing(there: Mapping[str, str], here: Mapping[str, str]) -> str:
    """Which inputs of a run have different digests here, as a text such as "a different anchor"."""
    names = sorted(name for name in there.keys() | here.keys() if there.get(name) != here.get(name))
    sets = [name for name in names if name.startswith(f"{_INPUT} ")]
    if not sets:
        return f"a different {', '.join(names)}"
    if {there.get(name) for name in sets} == {here.get(name) for name in sets}:
        return "the sets of demonstrations in a different order"
    # If a set differs, so does the digest of all together, which adds nothing.
    others = [name for name in names if name not in (_INPUT, *sets)]
    numbered = [f"set {name.removeprefix(f'{_INPUT} ')} of the demonstrations" for name in sets]
    return f"a different {', '.join([*others, *numbered])}"


# --- shares ---------------------------------------------------------------------------------------


def check_weights(weights: Sequence[float] | None, sets: int) -> None:
    """Raise AegisError unless there is one weight per set, or no weights."""
    if weights is None or (sets > 1 and len(weights) == sets):
        return
    raise AegisError(
        f"demos.weights: {_numbers(weights)} with {_counted(sets)} of demonstrations",
        "a weight for each of two or more sets, in their order",
        "correct demos.weights, or delete it: each set is then weighted by its frames",
    )


def drawn(found: Demonstrations, weights: Sequence[float] | None) -> list[int]:
    """How many of an epoch's frames come from each of several sets, by their weights.

    An epoch has as many draws as there are training frames; without weights each frame comes once.
    Frames left by rounding go to the largest remainders, and to the first of equal ones.

    Raises:
        AegisError: a weight amounts to less than one frame.
    """
    sizes = [member.train for member in found.members]
    if weights is None:
        return sizes
    total, exactly = sum(sizes), list(map(Fraction, weights))
    whole = sum(exactly)  # exactly, since a sum of large weights may overflow a float
    exact = [total * weight / whole for weight in exactly]
    counts = [int(count) for count in exact]  # rounded down
    # Sorting is stable, so the first of equal remainders comes first.
    by_rest = sorted(range(len(counts)), key=lambda i: counts[i] - exact[i])
    for i in by_rest[: total - sum(counts)]:
        counts[i] += 1
    for member, count in zip(found.members, counts, strict=True):
        if count == 0:
            raise AegisError(
                f"demos.weights: {_numbers(weights)}, which leave '{member.name}' none of an "
                f"epoch's {total} frames",
                "weights that give every set at least one frame per epoch",
                "raise its weight, or leave the set out",
            )
    return counts


def _numbers(weights: Sequence[float]) -> str:
    return ", ".join(f"{weight:g}" for weight in weights)


def _counted(sets: int) -> str:
    return "1 set" if sets == 1 else f"{sets} sets"


# --- sets that do not go together -----------------------------------------------------------------


def _check_each_once(paths: Sequence[Path]) -> None:
    found = [path.resolve() for path in paths]  # a link and its target are one set
    for place, path in enumerate(paths):
        if found[place] in found[:place]:
            raise AegisError(
                f"the demonstrations '{path}' twice",
                "each set once",
                "name it once; demos.weights gives it a larger share",
            )


def _check_selection(paths: Sequence[Path], selection: Selection) -> None:
    if selection.only is not None:
        raise AegisError(
            f"demos.only: {selection.only} with {_counted(len(paths))} of demonstrations",
            "one set, to choose episodes from",
            "leave demos.only out, or give one set",
        )


@dataclass(frozen=True)
class Robot:
    """The description of the robot that a set was recorded with.

    Attributes:
        sizes: the numbers of positions and of actions.
        names: `action_names` and `proprio_names`, if there are any.
    """

    cameras: tuple[str, ...]
    sizes: tuple[int, int]
    names: dict[str, tuple[str, ...]]
    fps: float | None
    task: str | None


def robot_of(path: Path, selection: Selection) -> Robot:
    """The robot of a set, without decoding any frame.

    Raises:
        AegisError: the set lacks the selected cameras or features.
    """
    here = demonstrations.locate(path)
    if not here.is_dir():
        artifact = artifacts.load(here, "demos")
        selection.check_file(here)  # a file of another kind was refused before
        meta = artifact.header.meta
        sizes = artifact.tensors["proprio"].shape[1], artifact.tensors["actions"].shape[1]
        names = {}
        for name in ("action_names", "proprio_names"):
            names[name] = renaming.joints(selection.rename, meta.get(name, ()), f"'{path}'")
        fps = float(meta["control_hz"]) if "control_hz" in meta else None
        return Robot((), sizes, _complete(names, sizes), fps, meta["task"])
    found = dataset.load(here, selection.rename)
    own = found.cameras(selection.camera)
    cameras = tuple(layout.short(found.called(camera)) for camera in own)
    positions, actions = listed(selection.state), listed(selection.action)
    sizes = sum(map(found.size, positions)), sum(map(found.size, actions))
    names = {"action_names": found.names(actions), "proprio_names": found.names(positions)}
    return Robot(cameras, sizes, _complete(names, sizes), found.info.fps, found.info.task)


def _complete(
    names: Mapping[str, tuple[str, ...]], sizes: tuple[int, int]
) -> dict[str, tuple[str, ...]]:
    """The lists of names in which each number has a name."""
    counts = {"proprio_names": sizes[0], "action_names": sizes[1]}
    return {kind: own for kind, own in names.items() if all(own) and len(own) == counts[kind] > 0}


def check_rename(paths: Sequence[Path], rename: Renaming) -> None:
    """Raise AegisError for a name to be renamed that occurs in none of these sets."""
    if not rename:
        return
    # One set may already have the policy's names, while another needs the renaming.
    names = set[str]()
    for path in paths:
        here = demonstrations.locate(path)
        if here.is_dir():
            names |= dataset.load(here).all_names
        else:
            meta = artifacts.read_header(here, "demos").meta
            names |= {*meta.get("action_names", ()), *meta.get("proprio_names", ())}
    renaming.check_known(rename, names, said(tuple(paths)))


def _check_alike(paths: Sequence[Path], selection: Selection) -> None:
    """Raise AegisError unless all sets are of one robot, before anything large is read."""
    robots = [(path, robot_of(path, selection)) for path in paths]
    # Every pair, since the first set may not say what two others disagree about.
    for known, other in itertools.combinations(robots, 2):
        _check_robot(*other, *known)


def _check_robot(path: Path, robot: Robot, known_path: Path, known: Robot) -> None:
    """Raise AegisError unless two sets are of one robot, as far as both describe it."""
    if robot.sizes != known.sizes:
        raise AegisError(
            f"{robot.sizes[0]} positions and {robot.sizes[1]} actions in '{path}'"
            f"{joints.told_apart(known.names, robot.names)}",
            f"{known.sizes[0]} and {known.sizes[1]}, as in '{known_path}'",
            "give demonstrations of the same robot",
        )
    for other in joints.differences(known.names, robot.names):
        _refuse_names(path, known_path, other)
    if known.cameras and robot.cameras and robot.cameras != known.cameras:
        raise AegisError(
            f"the camera {', '.join(robot.cameras)} of '{path}'",
            f"{', '.join(known.cameras)}, as in '{known_path}'",
            "choose cameras that all sets have with demos.camera; or, where a camera of "
            f"'{path}' has another name, rename it: --set 'demos.rename={{ITS NAME: NAME}}'",
        )
    if None not in (robot.fps, known.fps) and robot.fps != known.fps:
        raise AegisError(
            f"{robot.fps:g} frames a second in '{path}'",
            f"{known.fps:g}, as in '{known_path}'",
            "give demonstrations of one control rate: actions are meant for steps of one length",
        )
    if None not in (robot.task, known.task) and robot.task != known.task:
        raise AegisError(
            f"demonstrations of '{robot.task}' in '{path}'",
            f"those of '{known.task}', as in '{known_path}'",
            "give demonstrations of one simulated task",
        )


def _refuse_names(path: Path, known_path: Path, other: joints.Difference) -> None:
    """Raise AegisError for positions or actions that have other names or another order."""
    known, found = ", ".join(other.known), ", ".join(other.found)
    if other.moved is not None:
        raise AegisError(
            f"'{other.moved}' in another place in '{path}', with {other.what} {found}",
            f"{known}, in this order, as in '{known_path}'",
            "give demonstrations that share one order",
        )
    raise AegisError(
        f"{other.what} named {found} in '{path}'",
        f"{known}, as in '{known_path}'",
        "give demonstrations of the same robot; where these are the same joints in the same order, "
        "give them the same names with --set 'demos.rename={ITS NAME: NAME, ...}'",
    )


def _warn_of_other_units(
    paths: Sequence[Path], found: Sequence[Demonstrations], on_event: OnEvent
) -> None:
    """Warn of sets whose actions may be in other units than the first set's."""
    first, *others = found
    for path, other in zip(paths[1:], others, strict=True):
        text = other_units.said(
            f"the actions in '{path}'",
            _action_spread(other),
            _action_spread(first),
            f"those in '{paths[0]}'",
        )
        if text is not None:
            on_event(Warned("train", f"{text}, and one policy cannot act in both"))


def _action_spread(own: Demonstrations) -> list[float]:
    """Standard deviations [A] of the actions in all episodes that are read."""
    return deviations(own.tensors["actions"][own.read]).tolist()


def _warn_of_other_sizes(
    paths: Sequence[Path], found: Sequence[Demonstrations], on_event: OnEvent
) -> None:
    """Warn of pictures that are resized to the size of the first set's."""
    first, *others = found
    texts = list[str]()
    for path, other in zip(paths[1:], others, strict=True):
        for own, known in zip(other.frames, first.frames, strict=True):
            if own.shape[1:3] == known.shape[1:3]:
                continue
            texts.append(
                f"the pictures in '{path}' are {own.shape[1]} x {own.shape[2]}, and those in "
                f"'{paths[0]}' {known.shape[1]} x {known.shape[2]}: they are fitted into that size"
            )
    for text in dict.fromkeys(texts):  # several cameras may have the same sizes
        on_event(Warned("train", text))
