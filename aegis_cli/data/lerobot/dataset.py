"""A dataset's meta folder: its episodes, where their frames are, and its task texts."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from aegis_cli.common.errors import AegisError
from aegis_cli.data import renaming
from aegis_cli.data.lerobot import layout, version_2, version_3
from aegis_cli.data.lerobot.layout import EpisodeIndex, Info
from aegis_cli.data.renaming import Renaming


@dataclass(frozen=True)
class Dataset:
    """The contents of the meta folder; the folders `data` and `videos` have not been read.

    Attributes:
        tasks: texts, in the order of their `task_index`.
        episodes: in the order of their frames, which are numbered consecutively from 0.
        rename: the reader's names for cameras, features and joints. `info` and stored files have
            the dataset's own names.
    """

    folder: Path
    info: Info
    tasks: tuple[str, ...]
    episodes: tuple[EpisodeIndex, ...]
    rename: Renaming = ()

    @cached_property
    def stats(self) -> Mapping[str, Mapping[str, Any]] | None:
        """A (nested) list of numbers per feature and statistic; None if the dataset has none.

        Training does not depend on them. Version 2.1 has them per episode.
        """
        if self.info.has_episode_files:
            return version_2.read_stats(self.folder)
        return layout.read_stats(self.folder)

    @property
    def table_files(self) -> list[Path]:
        """The meta folder's files of tasks and episodes."""
        reader = version_2 if self.info.has_episode_files else version_3
        return reader.table_files(self.folder)

    def called(self, feature: str) -> str:
        """The reader's name of a feature of the dataset."""
        return renaming.feature(self.rename, feature)

    def own(self, feature: str) -> str:
        """The dataset's own name of a feature; the given name if there is none."""
        return self._own_names.get(feature, feature)

    @cached_property
    def _own_names(self) -> dict[str, str]:
        return {self.called(own): own for own in self.info.features}

    def cameras(self, names: str | Sequence[str] | None) -> tuple[str, ...]:
        """The dataset's own camera features that one or several names stand for, in order.

        None stands for the dataset's only camera.

        Raises:
            AegisError: there is no such camera, one is named twice, or there are several to choose
                from.
        """
        cameras = tuple(map(self.called, self.info.cameras))
        if names is None:
            if len(cameras) != 1:
                found = f"'{self.folder}' has {len(cameras)} cameras{_list(cameras)}"
                raise AegisError(found, "the cameras to learn from", _choose(cameras))
            return self.info.cameras
        listed = (names,) if isinstance(names, str) else names
        found = tuple(self._camera(name) for name in listed)
        # Compared after lookup: a camera may be named both by its short name and by its feature.
        twice = [camera for i, camera in enumerate(found) if camera in found[:i]]
        if twice:
            raise AegisError(
                f"the camera '{twice[0]}' twice",
                "each camera once",
                "name it once, in demos.camera, or as --camera of aegis anchor",
            )
        return found

    def _camera(self, name: str) -> str:
        cameras = tuple(map(self.called, self.info.cameras))
        for camera in (name, layout.CAMERA + name):
            if camera in cameras:
                return self.own(camera)
        listed = ", ".join(cameras) or "no camera at all"
        found = f"no camera '{name}' in '{self.folder}'"
        if any(self._is_depth(camera) for camera in (name, layout.CAMERA + name)):
            found = f"the camera '{name}' in '{self.folder}' shows depth, which no backbone reads"
        raise AegisError(found, f"one of: {listed}", _choose(cameras))

    def _is_depth(self, camera: str) -> bool:
        feature = self.info.features.get(self.own(camera))
        return feature is not None and feature.is_depth

    def size(self, feature: str) -> int:
        """The size of a vector feature in each frame.

        Raises:
            AegisError: the feature is missing, or is not a vector.
        """
        found = self.info.features.get(self.own(feature))
        if found is None:
            features = ", ".join(self._own_names)
            raise AegisError(
                f"no feature '{feature}' in '{self.folder}'; it has {features}",
                "the features with the robot's positions and with its actions",
                "name them: --set demos.state=NAME, --set demos.action=NAME",
            )
        numeric = found.dtype.startswith(("float", "int", "uint", "bool"))
        if len(found.shape) != 1 or not numeric:
            shape = " x ".join(map(str, found.shape))
            what = f"'{feature}' in '{self.folder}' is {found.dtype} of shape {shape}"
            raise AegisError(
                what, "a vector of numbers", "give a dataset whose frames have one vector of it"
            )
        return found.shape[0]

    def names(self, features: Sequence[str]) -> tuple[str, ...]:
        """The names of the numbers of concatenated features; empty if none has names.

        If only some features have names, the numbers of the others are named by their feature and
        index: `joints.0`. If two features share a name, as those of two arms do, all but LeRobot's
        own features of state and action prefix theirs: `left_arm.gripper`.

        Raises:
            AegisError: a renaming would give two of them the same name.
        """
        told = [self.info.features[self.own(feature)].components for feature in features]
        if not any(map(any, told)):
            return ()
        named = [_named(feature, each) for feature, each in zip(features, told, strict=True)]
        where = f"'{self.folder}'"
        own = [renaming.joints(self.rename, components, where) for components in named]
        alone = tuple(itertools.chain(*own))
        if len({*alone}) == len(alone) or len(own) == 1:
            # Each feature was checked by itself; two of them may now share a name.
            renaming.check_apart(self.rename, tuple(itertools.chain(*named)), alone, where)
            return alone
        within = list[str]()
        for feature, said, components in zip(features, told, own, strict=True):
            # Numbered names already contain their feature's name.
            within += _within(feature, components) if any(said) else components
        # Renamed again: a renaming may name `left_arm.gripper` or `gripper`.
        return renaming.joints(self.rename, within, where)

    @property
    def all_names(self) -> set[str]:
        """The dataset's own names of its features, its cameras (short) and its numbers."""
        features = self.info.features
        found = {*features, *map(layout.short, self.info.cameras)}
        for name, feature in features.items():
            if name in self.info.cameras:  # their components are red, green and blue
                continue
            found.update(_named(name, feature.components), _within(name, feature.components))
        return found


def _named(feature: str, components: Sequence[str]) -> Sequence[str]:
    """The names of a feature's numbers; if it has none, its own name with an index."""
    if any(components):
        return components
    short = _short(feature)
    return [f"{short}.{number}" for number in range(len(components))]


def _within(feature: str, components: Sequence[str]) -> tuple[str, ...]:
    """The names of a feature's numbers prefixed with the feature's, except for LeRobot's own."""
    if feature in (layout.STATE, layout.ACTION):
        return tuple(components)
    short = _short(feature)
    return tuple(f"{short}.{name}" if name else name for name in components)


def _short(feature: str) -> str:
    return feature.removeprefix("observation.").removeprefix("action.")


def _list(cameras: tuple[str, ...]) -> str:
    return f": {', '.join(cameras)}" if cameras else ""


def _choose(cameras: tuple[str, ...]) -> str:
    if not cameras:
        return "give a dataset with pictures"
    one = f"--set demos.camera={cameras[0]}"
    of_anchor = f"for aegis anchor: --camera {cameras[0]}"
    if len(cameras) == 1:
        return f"{one}; {of_anchor}"
    several = f"--set 'demos.camera=[{', '.join(cameras)}]'"
    return (
        f"{one}; a Hugging Face backbone also reads several: {several}; {of_anchor}, which is "
        "repeatable"
    )


def load(folder: Path, rename: Renaming = ()) -> Dataset:
    """Read the meta folder and check that its parts agree.

    Raises:
        AegisError: there is no dataset, its version is unsupported, a file is missing or damaged,
            counts do not agree, or two features would get the same name.
    """
    folder = Path(folder)
    info = layout.read_info(folder)  # JSON: errors here do not need the package
    layout.require_pyarrow()
    reader = version_2 if info.has_episode_files else version_3
    if not info.episodes and not all(path.exists() for path in reader.table_files(folder)):
        raise AegisError(
            f"no episode in '{folder}': its recording ended before one was saved",
            "at least one",
            "record it again",
        )
    tasks, episodes = reader.read_tasks(folder), reader.read_episodes(folder, info)
    found = Dataset(folder, info, tasks, episodes, rename)
    features = tuple(info.features)
    renaming.check_apart(rename, features, [*map(found.called, features)], f"'{folder}'")
    return found
