"""A dataset's meta folder: its episodes, where their frames are, and the texts of its tasks."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from aegis_cli.common.errors import AegisError
from aegis_cli.data.lerobot import layout, version_2, version_3
from aegis_cli.data.lerobot.layout import EpisodeIndex, Info


@dataclass(frozen=True)
class Dataset:
    """What the meta folder says; the folders `data` and `videos` have not been read.

    Attributes:
        tasks: texts, in the order of their `task_index`.
        episodes: in the order of their frames, which are numbered through from 0.
    """

    folder: Path
    info: Info
    tasks: tuple[str, ...]
    episodes: tuple[EpisodeIndex, ...]

    @cached_property
    def stats(self) -> Mapping[str, Mapping[str, Any]] | None:
        """By feature and statistic a (nested) list of numbers; None where the dataset has none.

        Nothing that is learned depends on them, and version 2.1 has those of each episode.
        """
        if self.info.has_episode_files:
            return version_2.read_stats(self.folder)
        return layout.read_stats(self.folder)

    @property
    def table_files(self) -> list[Path]:
        """The meta folder's files of tasks and episodes."""
        reader = version_2 if self.info.has_episode_files else version_3
        return reader.table_files(self.folder)

    def cameras(self, names: str | Sequence[str] | None) -> tuple[str, ...]:
        """The features that one or several names stand for, in their order.

        None stands for the only one there is.

        Raises:
            AegisError: no such camera, one twice, or several to choose among.
        """
        cameras = self.info.cameras
        if names is None:
            if len(cameras) != 1:
                found = f"'{self.folder}' has {len(cameras)} cameras{_list(cameras)}"
                raise AegisError(found, "the cameras to learn from", _choose(cameras))
            return cameras
        listed = (names,) if isinstance(names, str) else names
        found = tuple(self._camera(name) for name in listed)
        if twice := [camera for i, camera in enumerate(found) if camera in found[:i]]:
            raise AegisError(
                f"the camera '{twice[0]}' twice",
                "each camera once",
                "name it once, in demos.camera, or as --camera of aegis anchor",
            )
        return found

    def _camera(self, name: str) -> str:
        cameras = self.info.cameras
        for camera in (name, layout.CAMERA + name):
            if camera in cameras:
                return camera
        listed = ", ".join(cameras) or "no camera at all"
        raise AegisError(
            f"no camera '{name}' in '{self.folder}'", f"one of: {listed}", _choose(cameras)
        )

    def size(self, feature: str) -> int:
        """How many numbers a vector feature has in each frame.

        Raises:
            AegisError: the feature is missing, or is no vector.
        """
        found = self.info.features.get(feature)
        if found is None:
            features = ", ".join(self.info.features)
            raise AegisError(
                f"no feature '{feature}' in '{self.folder}'; it has {features}",
                "the features with the robot's positions and with its actions",
                "name them: --set demos.state=NAME, --set demos.action=NAME",
            )
        if len(found.shape) != 1 or not found.dtype.startswith(("float", "int", "uint")):
            shape = " x ".join(map(str, found.shape))
            what = f"'{feature}' in '{self.folder}' is {found.dtype} of shape {shape}"
            raise AegisError(
                what, "a vector of numbers", "give a dataset whose frames have one vector of it"
            )
        return found.shape[0]

    def names(self, features: Sequence[str]) -> tuple[str, ...]:
        """What the numbers of features side by side are called; empty where one has no names."""
        named = [self.info.features[feature].components for feature in features]
        return tuple(itertools.chain(*named)) if all(map(any, named)) else ()


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


def load(folder: Path) -> Dataset:
    """Read the meta folder and check that its parts agree.

    Raises:
        AegisError: no dataset, another version, a missing or damaged file, or counts that do not
            agree.
    """
    folder = Path(folder)
    info = layout.read_info(folder)
    layout.require_pyarrow()
    reader = version_2 if info.has_episode_files else version_3
    tasks, episodes = reader.read_tasks(folder), reader.read_episodes(folder, info)
    return Dataset(folder, info, tasks, episodes)
