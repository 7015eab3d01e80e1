"""Demonstrations as training batches."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from aegis_cli import sim
from aegis_cli.common import artifacts, hub
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, ignore
from aegis_cli.common.watched_files import WatchedFiles, WatchedPaths
from aegis_cli.data import episodes as episodes_of
from aegis_cli.data import far_positions, relative, renaming, task_episodes
from aegis_cli.data.batch import Images, Normalizer, RobotBatch, deviations
from aegis_cli.data.fitted import FittedFrames
from aegis_cli.data.joined_frames import JoinedFrames
from aegis_cli.data.lerobot import dataset, download, layout, rows
from aegis_cli.data.lerobot import frames as camera_frames
from aegis_cli.data.lerobot import source as sources
from aegis_cli.data.lerobot.on_demand import FramesOnDemand
from aegis_cli.data.lerobot.source import Source
from aegis_cli.data.renaming import Renaming
from aegis_cli.data.selection import ALL, Selection, listed

# The most relative actions that their scale is fitted to: each frame has a chunk of them.
_MOST_ROWS = 2**20

# The share of the episodes that is held out, the seed of their choice, and `demos.only`.
Split = tuple[float | None, int, str | None]
# The frames of one camera, [N, H, W, 3] uint8.
Frames = Tensor | FramesOnDemand | FittedFrames | JoinedFrames


@dataclass(frozen=True)
class Member:
    """One of several sets of demonstrations that a policy is trained on together.

    Attributes:
        name: its path, or its id on the hub.
        sha256: digest of everything it was read from.
        train: frames to train on.
    """

    name: str
    sha256: str
    train: int


@dataclass(frozen=True)
class Demonstrations:
    """Demonstrations of a file or a LeRobot folder.

    The frames stay on the disk until a batch asks for them.

    Attributes:
        task: the simulated task's name; None for a dataset of any other robot.
        frames: one entry per camera, in order.
        tensors: `proprio` [N, P] and `actions` [N, A] float32, `episode_starts` [E + 1] int64.
        instructions: the instruction texts.
        instruction_of: [N] int64, the text of each frame.
        episode_of: [N] int64, the episode of each frame.
        train, validation: [*] int64 frame numbers, split by episode.
        sha256: digest of everything they were read from.
        cameras: names of the LeRobot folder's cameras that the frames come from.
        watched: the files that frames are read from.
        action_names, proprio_names: names of the A actions and P positions; empty if the data has
            none.
        fps: frames per second, which is the control rate of the robot; None if the data does not
            say.
        datasets: ids on the hub, if the demonstrations were given by id.
        members: the sets that these were joined from, in the order of their frames; empty for one
            set.
    """

    task: str | None
    frames: tuple[Frames, ...]
    tensors: dict[str, Tensor]
    instructions: list[str]
    instruction_of: Tensor
    episode_of: Tensor
    train: Tensor
    validation: Tensor
    sha256: str
    cameras: tuple[str, ...] = ()
    watched: tuple[WatchedFiles | WatchedPaths, ...] = ()
    action_names: tuple[str, ...] = ()
    proprio_names: tuple[str, ...] = ()
    fps: float | None = None
    datasets: tuple[str, ...] = ()
    members: tuple[Member, ...] = ()

    @property
    def recorded(self) -> dict[str, Any]:
        """The robot's entries in a policy's meta: `action_names`, `proprio_names` and `fps`.

        Names are left out unless each number has one; an unknown rate is left out too.
        """
        told = {
            "action_names": (self.action_names, self.tensors["actions"]),
            "proprio_names": (self.proprio_names, self.tensors["proprio"]),
        }
        found: dict[str, Any] = {}
        for key, (names, values) in told.items():
            # Datasets may leave single numbers unnamed; the name is then an empty string.
            if all(names) and len(names) == values.shape[1] > 0:
                found[key] = list(names)
        if self.fps is not None:
            found["fps"] = self.fps
        return found

    def fitted(self, sizes: Sequence[tuple[int, int]]) -> Demonstrations:
        """The same demonstrations with each camera's frames resized to a (height, width)."""
        shown = (_fitted(*each) for each in zip(self.frames, sizes, strict=True))
        return replace(self, frames=tuple(shown))

    @property
    def held(self) -> list[Tensor]:
        """All tensors that hold the data; frames that stay in a file are memory-mapped."""
        own = [value for value in vars(self).values() if isinstance(value, Tensor)]
        return [*own, *self.tensors.values(), *itertools.chain(*map(_held, self.frames))]

    def check_files(self) -> None:
        """Raise AegisError if the files that frames are read from have changed."""
        for watched in self.watched:
            watched.check()

    @cached_property
    def read(self) -> Tensor:
        """[*] int64, the frames that were read: those to train and to validate on."""
        return torch.cat([self.train, self.validation]).sort().values

    @cached_property
    def texts(self) -> list[str]:
        """The distinct instructions of these frames."""
        return [self.instructions[i] for i in self.instruction_of[self.read].unique().tolist()]

    @cached_property
    def without_instruction(self) -> Tensor:
        """Numbers of the episodes read that have an empty or blank instruction."""
        is_blank = torch.tensor([not text.strip() for text in self.instructions])
        without = self.read[is_blank[self.instruction_of[self.read]]]  # frame numbers
        return self.episode_of[without].unique()

    def images(self, frame: Tensor) -> Images:
        """What a policy sees at frames [B]: [B, H, W, 3], or B tuples of one image per camera."""
        seen = [frames[frame] for frames in self.frames]  # [B, H, W, 3] of each camera
        if len(seen) == 1:
            return seen[0]
        # Cameras may have different sizes, so their images cannot be one tensor.
        return list(zip(*seen, strict=True))

    def batch(self, frames: np.ndarray | Tensor, chunk: int) -> RobotBatch:
        """Frames [B] with the `chunk` expert actions that start there.

        A chunk that runs past its episode repeats the last action, marked as padding.
        """
        frame = torch.as_tensor(frames)
        actions, is_pad = self.chunks(frame, chunk)
        return RobotBatch(
            images=self.images(frame),
            instructions=[self.instructions[i] for i in self.instruction_of[frame].tolist()],
            proprio=self.tensors["proprio"][frame],
            actions=actions,
            is_pad=is_pad,
        )

    def chunks(self, frame: Tensor, chunk: int) -> tuple[Tensor, Tensor]:
        """The actions [B, chunk, A] of `batch` at frames [B], and what is padding [B, chunk]."""
        end = self.tensors["episode_starts"][self.episode_of[frame] + 1][:, None]  # [B, 1]
        ahead = frame[:, None] + torch.arange(chunk)  # [B, chunk]
        # After the end comes the next episode, with another instruction and start.
        within = torch.minimum(ahead, end - 1)
        return self.tensors["actions"][within], ahead >= end

    def size(self, frame: Tensor, chunk: int) -> tuple[int, int]:
        """The number of frames [B], and of actions in their chunks that are not padding."""
        _, is_pad = self.chunks(frame, chunk)
        return len(frame), int((~is_pad).sum())

    def relative_places(self, absolute: Sequence[str]) -> tuple[int | None, ...]:
        """The position that each action is relative to; see `relative.places`."""
        sizes = self.tensors["actions"].shape[1], self.tensors["proprio"].shape[1]
        return relative.places(self.action_names, self.proprio_names, sizes, absolute)

    def scales(
        self, normalization: str = "mean_std", chunk: int = 1, places: relative.Places = ()
    ) -> tuple[Normalizer, Normalizer]:
        """Normalizers of proprioception and actions, fitted to the training episodes only.

        Args:
            chunk: how many actions are predicted at once.
            places: what each action is relative to; statistics are then over all steps of the
                chunks, since relative actions grow along them.
        """
        fit = {"mean_std": Normalizer.fit, "quantiles": Normalizer.fit_quantiles}[normalization]
        actions = self.tensors["actions"][self.train]
        if places:
            actions = self._relative_actions(chunk, places)
        return fit(self.tensors["proprio"][self.train]), fit(actions)

    @property
    def action_std(self) -> list[float]:
        """Standard deviations of the A actions over the training frames; 0 for a fixed one."""
        return deviations(self.tensors["actions"][self.train]).tolist()

    def proprio_reach(self, scale: Normalizer, normalization: str) -> list[float] | None:
        """How far the positions of the training frames ever were; see `far_positions.reach`."""
        return far_positions.reach(self.tensors["proprio"][self.train], scale, normalization)

    def _relative_actions(self, chunk: int, places: relative.Places) -> Tensor:
        """Actions [N, A] of the training frames' chunks minus their origins.

        If there are more than `_MOST_ROWS`, only evenly spaced frames are used.
        """
        every = -(-len(self.train) * chunk // _MOST_ROWS)  # rounded up
        frames = self.train[:: max(1, every)]
        actions, is_pad = self.chunks(frames, chunk)
        origins = relative.Origins(places)(self.tensors["proprio"][frames])
        # Padding repeats an episode's last action, and is never a target.
        return (actions - origins)[~is_pad]


def _fitted(frames: Frames, size: tuple[int, int]) -> Frames:
    """A camera's frames in this size; unchanged if they already have it."""
    return frames if tuple(frames.shape[1:3]) == size else FittedFrames(frames, size)


def _held(frames: Frames) -> Iterator[Tensor]:
    """The tensors that hold a camera's frames."""
    if isinstance(frames, Tensor):
        yield frames
    elif isinstance(frames, FittedFrames):
        yield from _held(frames.frames)
    elif isinstance(frames, JoinedFrames):
        for part in frames.parts:
            yield from _held(part)
    # `FramesOnDemand` holds no tensor: its frames are decoded each time.


def at(path: str | Path) -> Path:
    """The path of demonstrations as the user wrote it, or the id of a dataset on the hub.

    Raises:
        AegisError: nothing is there and it cannot be an id, such as './a/b'; or it is a file of a
            LeRobot dataset instead of its folder.
    """
    if not Path(path).exists() and hub.is_local(str(path)):
        raise AegisError(
            f"no file or folder '{path}'",
            "a file of aegis demos, the folder of a LeRobot dataset, or its id on the hub",
            f"check the path, or record with: aegis demos{hub.not_asked(str(path))}",
        )
    _refuse_inside(Path(path))
    return Path(path)


def _refuse_inside(path: Path) -> None:
    """Raise AegisError for one of the files that a LeRobot dataset consists of."""
    # A file of `aegis demos` may have been put into a dataset's folder.
    if path.is_dir() or path.suffix == ".safetensors":
        return
    folder = next(filter(layout.is_dataset, path.absolute().parents), None)
    if folder is not None:
        raise AegisError(
            f"'{path}', a file of a LeRobot dataset", "the dataset's folder", f"give '{folder}'"
        )


def locate(path: Path, selection: Selection | None = None) -> Path:
    """The file or folder of demonstrations; for a dataset on the hub, its local copy.

    Args:
        selection: the part of a dataset on the hub to download; None: only the meta folder.

    Raises:
        AegisError: there is nothing of that name, here or on the hub, or it lacks the features.
    """
    if at(path).exists():
        return Path(path)
    folder = download.meta(str(path))
    if selection is None:
        return folder
    # Unsuitable datasets are found before anything large is downloaded.
    found = dataset.load(folder, selection.rename)
    for feature in selection.vectors:
        found.size(feature)
    cameras = found.cameras(selection.camera)
    return download.fetch(str(path), found, cameras, _episodes(found, selection.only))


def load(
    path: Path,
    validation_share: float | None,
    seed: int,
    selection: Selection = ALL,
    image_size: int | None = None,
    workers: int | None = None,
    on_event: OnEvent = ignore,
    cache: bool | None = True,
    check_text: Callable[[str], None] | None = None,
) -> Demonstrations:
    """Read demonstrations, a file of `aegis demos` or a LeRobot dataset, and split them by episode.

    Other episodes of a LeRobot folder are not read. All frames and episodes keep their numbers,
    whatever is selected.

    Args:
        validation_share: share of the episodes that is held out; None: all of them.
        image_size: side in pixels of the squares that a LeRobot folder's frames are fitted into;
            None: they keep their size.
        workers: processes that decode a LeRobot folder's frames; the result does not depend on it.
        cache: whether all frames of a LeRobot folder's videos are first decoded into a cache.
            Otherwise each is decoded when needed, unless the cache already has them. None: if the
            disk has enough room.
        check_text: called with each instruction of a LeRobot folder before its videos are decoded,
            which may take hours; raises AegisError for one that cannot be read.

    Raises:
        AegisError: the demonstrations are not valid, or there are too few episodes to hold one out.
    """
    here = locate(path, selection)
    split = (validation_share, seed, selection.only)
    if here.is_dir():
        found = _load_folder(
            here, split, selection, image_size, workers, cache, on_event, check_text
        )
        if here == path:
            return found
        # The copy lies in the hub's cache, whose path means nothing to others.
        return replace(found, datasets=(str(path),))
    artifacts.read_header(here, "demos")  # a file of another kind is refused first
    selection.check_file(here)
    return _load_file(here, split, selection.rename)


def digest(path: Path, selection: Selection = ALL) -> str:
    """sha256 of everything that `load` would read."""
    path = locate(path, selection)
    if not path.is_dir():
        return artifacts.sha256_file(path)
    found = dataset.load(path, selection.rename)
    source = _source(found, selection.only)
    of_cameras = sources.digests(source, found.cameras(selection.camera))
    return sources.joined_digest(of_cameras, "cameras")


def _source(found: dataset.Dataset, only: str | None) -> Source:
    return sources.find(found, _episodes(found, only))


def _episodes(found: dataset.Dataset, only: str | None) -> list[int] | None:
    """The numbers of the episodes that `demos.only` selects; None if it is not set."""
    if only is None:
        return None
    if task_episodes.is_task(only, found.info.splits):
        return task_episodes.of_task(found, only)
    return episodes_of.chosen(only, len(found.episodes), found.info.splits, found.folder)


def part_of(path: Path, task: str, shared: bool) -> str | None:
    """The value of `demos.only` that selects a task's own episodes; None: all are its own.

    Only LIBERO's datasets hold several tasks' episodes.

    Args:
        shared: whether other tasks are trained on the demonstrations as well.

    Raises:
        AegisError: its own episodes cannot be determined.
    """
    if sim.of_datasets(task) is None:
        return None
    here = locate(path)
    is_choice = here.is_dir() and task_episodes.is_choice(dataset.load(here), task, shared)
    return task if is_choice else None


def is_one_of(path: Path, selection: Selection, sha256: Collection[str]) -> bool:
    """Whether the selected part of these demonstrations has one of the digests."""
    here = locate(path)
    if here.is_dir() and selection.only is not None:
        found = dataset.load(here, selection.rename)
        # Other data may have fewer episodes or lack the split, which is no error here.
        try:
            _episodes(found, selection.only)
        except AegisError:
            return False
    return digest(path, selection) in sha256


def count_episodes(path: Path) -> int:
    """How many episodes there are in a file of `aegis demos` or a LeRobot folder."""
    path = locate(path)
    if path.is_dir():
        return layout.read_info(path).episodes
    return len(artifacts.load(path, "demos").tensors["episode_starts"]) - 1


def playable_task(
    path: Path, camera: str | tuple[str, ...] | None, named: str, rename: Renaming = ()
) -> str | None:
    """The simulated task that a policy trained on these demonstrations can act in.

    It is None if another robot was recorded, or cameras that the task does not have.

    Args:
        named: the task that a recipe names. LIBERO's datasets do not identify themselves.
    """
    path = locate(path)
    if not path.is_dir():
        return artifacts.load(path, "demos").header.meta["task"]
    found = dataset.load(path, rename)
    task = found.info.task
    if task is None and sim.of_datasets(named) is not None:
        task = named
    seen_by = {
        sim.camera(task, layout.short(own), layout.short(found.called(own)))
        for own in found.cameras(camera)
    }
    return sim.playable(task, seen_by)


def _load_file(path: Path, split: Split, rename: Renaming) -> Demonstrations:
    # Watched before it is read, so that changes in the meantime are noticed.
    watched = WatchedFiles([path])
    artifact = artifacts.load(path, "demos")
    tensors, meta = dict(artifact.tensors), artifact.header.meta
    count = len(tensors["episode_starts"]) - 1
    # Tensors with their own field below are popped; `tensors` keeps the rest.
    episode_of, train, validation = _split(
        path, tensors["episode_starts"], split, learned_from(path, count, split[2])
    )
    return Demonstrations(
        task=meta["task"],
        frames=(tensors.pop("frames"),),
        instructions=meta["instructions"],
        instruction_of=tensors.pop("instruction")[episode_of],
        tensors=tensors,
        episode_of=episode_of,
        train=train,
        validation=validation,
        sha256=watched.sha256[path],
        watched=(watched,),
        action_names=renaming.joints(rename, meta.get("action_names", ()), f"'{path}'"),
        proprio_names=renaming.joints(rename, meta.get("proprio_names", ()), f"'{path}'"),
        fps=float(meta["control_hz"]) if "control_hz" in meta else None,
    )


def _load_folder(
    path: Path,
    split: Split,
    selection: Selection,
    image_size: int | None,
    workers: int | None,
    cache: bool | None,
    on_event: OnEvent,
    check_text: Callable[[str], None] | None,
) -> Demonstrations:
    # Errors in the dataset are found in order of cost: the meta folder, the rows and the
    # instructions are read before any video is decoded.
    found = dataset.load(path, selection.rename)
    cameras = found.cameras(selection.camera)
    lengths = [episode.length for episode in found.episodes]
    starts = torch.tensor([0, *lengths]).cumsum(0)  # [E + 1]
    chosen = _episodes(found, selection.only)
    episodes = np.arange(len(lengths)) if chosen is None else np.array(chosen, dtype=np.int64)
    episode_of, train, validation = _split(path, starts, split, episodes)
    source = sources.find(found, chosen)
    index = rows.read_index(source)
    proprio, proprio_names = _vectors(source, selection.state)
    actions, action_names = _vectors(source, selection.action)
    digests = sources.digests(source, cameras, on_event)
    if check_text is not None:
        # Frames that are not read have task 0, whose text may be another episode's.
        read = torch.cat([train, validation]).numpy()
        for number in np.unique(index.task[read]).tolist():
            check_text(found.tasks[number])
    pixels = dict(zip(cameras, sources.pixel_digests(source, cameras), strict=True))
    if cache is None:
        cache = camera_frames.have_room(source, pixels, image_size, on_event)
    frames: list[Frames] = []
    mapped, videos = list[Path](), set[Path]()
    for name, own in pixels.items():
        is_video = found.info.features[name].dtype != "image"
        # Reading frames that an earlier run has decoded is faster than decoding them again.
        if is_video and not cache and not camera_frames.are_kept(source, name, image_size, own):
            parts = list(camera_frames.video_parts(source, index, name))
            frames.append(FramesOnDemand(parts, found.info.frames, image_size))
            videos.update(part.path for part in parts)
        else:
            made, file = camera_frames.load(source, index, name, image_size, own, workers, on_event)
            frames.append(torch.from_numpy(made))
            mapped.append(file)
    return Demonstrations(
        task=found.info.task,
        frames=tuple(frames),
        tensors={"proprio": proprio, "actions": actions, "episode_starts": starts},
        instructions=list(found.tasks),
        instruction_of=torch.from_numpy(index.task),
        episode_of=episode_of,
        train=train,
        validation=validation,
        sha256=sources.joined_digest(digests, "cameras"),
        cameras=tuple(map(found.called, cameras)),
        # Only Aegis writes to its cache, which may be too large to read for a digest.
        watched=(WatchedFiles(mapped, by_content=False), WatchedPaths(videos)),
        action_names=action_names,
        proprio_names=proprio_names,
        fps=found.info.fps,
    )


def _vectors(source: Source, features: str | tuple[str, ...]) -> tuple[Tensor, tuple[str, ...]]:
    """Features concatenated to [N, D] float32, and the names of their D numbers.

    There are no names if none of the features has any.
    """
    chosen = listed(features)
    read = [rows.read_vectors(source, name) for name in chosen]
    none = np.zeros((source.dataset.info.frames, 0), np.float32)  # if no feature is chosen
    joined = np.concatenate([none, *read], axis=1)
    return torch.from_numpy(joined), source.dataset.names(chosen)


def _split(
    path: Path, starts: Tensor, split: Split, episodes: np.ndarray
) -> tuple[Tensor, Tensor, Tensor]:
    """The episode of each frame [N], and the frames to train and to validate on.

    Args:
        episodes: numbers [*] int64 of the chosen episodes.
    """
    validation_share, seed, only = split
    needed = 1 if validation_share is None else 2  # one is held out
    if len(episodes) < needed:
        record = "record more episodes" + ("" if path.is_dir() else " with aegis demos")
        raise AegisError(
            f"{len(episodes)} episode{'s' * (not len(episodes))} in '{path}'"
            + (f" by demos.only: {only}" if only else ""),
            "at least one" if needed == 1 else "2 or more: one is held out",
            "choose more with demos.only" if only else record,
        )
    # `held_out` counts only the chosen episodes, so every choice has some to validate on.
    validated = episodes[held_out(len(episodes), validation_share, seed)]
    episode_of = torch.repeat_interleave(torch.arange(len(starts) - 1), starts.diff())  # [N]
    is_chosen = torch.isin(episode_of, torch.from_numpy(episodes))
    is_validation = torch.isin(episode_of, torch.from_numpy(validated))
    train, validation = is_chosen & ~is_validation, is_validation
    return episode_of, train.nonzero().squeeze(1), validation.nonzero().squeeze(1)


def learned_from(path: Path, count: int, only: str | None) -> np.ndarray:
    """The numbers of the episodes that training uses, in order.

    Args:
        count: how many there are.
        only: as in `demos.only`.

    Raises:
        AegisError: some episodes do not exist.
    """
    if only is None:
        return np.arange(count)
    path = locate(path)
    if path.is_dir():
        numbers = _episodes(dataset.load(path), only)
    else:  # a file of `aegis demos` has no splits
        numbers = episodes_of.chosen(only, count, {}, path)
    return np.array(numbers, dtype=np.int64)


def held_out_of(path: Path, only: str | None, validation_share: float, seed: int) -> list[int]:
    """The numbers of the episodes that a training with this seed holds out.

    Args:
        only: as in `demos.only`.

    Raises:
        AegisError: some episodes do not exist.
    """
    own = learned_from(path, count_episodes(path), only)
    numbers: list[int] = own[held_out(len(own), validation_share, seed)].tolist()
    return sorted(numbers)


def held_out(episodes: int, validation_share: float | None, seed: int) -> np.ndarray:
    """The numbers of the episodes that a training with this share and seed holds out.

    At least one is held out and never all, except with a share of None, which holds out all.
    """
    if validation_share is None:
        return np.arange(episodes)
    count = min(episodes - 1, max(1, round(validation_share * episodes)))
    return np.random.default_rng(seed).permutation(episodes)[:count]
