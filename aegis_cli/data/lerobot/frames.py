"""A camera's frames, decoded once into a file that stays on disk and is memory-mapped.

Several processes decode.

The file is named by the digest of what its pixels depend on, so runs share it, and a dataset whose
pictures change gets a new one. It lies in $AEGIS_CACHE, else in $XDG_CACHE_HOME/aegis or
~/.cache/aegis; if it is deleted, the frames are decoded again. Files that no run has used for a
month are deleted when another one is written.
"""

from __future__ import annotations

import bisect
import math
import mmap
import os
import shutil
import sys
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from aegis_cli.common import cache, files
from aegis_cli.common import pictures as fitting
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Progress, Warned
from aegis_cli.common.processes import mapped, worker_count
from aegis_cli.data.episodes import as_text
from aegis_cli.data.lerobot import layout, pictures, video
from aegis_cli.data.lerobot.dataset import Dataset
from aegis_cli.data.lerobot.rows import Index
from aegis_cli.data.lerobot.source import CHOOSING, DataFile, Source

_PART = 256  # frames decoded per call, or slightly more
_PER_WORKER = 8  # parts that are worth starting a worker for
# In Python since 3.13. With it, Linux reserves no memory for a private mapping.
_NORESERVE = getattr(mmap, "MAP_NORESERVE", 0x4000 if sys.platform == "linux" else 0)
_SHARE = 0.25  # of the free disk space, which decoded frames may take by default
_SAME = 2.0  # of 255: the mean difference allowed between decoders of different machines


@dataclass(frozen=True)
class ImagePart:
    """Consecutive rows of a data file, which lie in the row groups `groups`.

    `skip` rows of these groups come before them.
    """

    path: Path
    camera: str
    groups: tuple[int, ...]
    skip: int
    first_frame: int
    count: int

    def decode(self) -> Iterator[np.ndarray]:
        """Frames [H, W, 3] uint8."""
        cells = self._cells()
        return (self._picture(cells, i) for i in range(self.count))

    def at(self, i: int) -> np.ndarray:
        """Frame `i` of the part."""
        return self._picture(self._cells(), i)

    def _cells(self) -> Any:
        with layout.reading_parquet(self.path):
            file = layout.open_parquet(self.path)
            # Row groups are the smallest part of a file that can be read separately.
            groups = file.read_row_groups(list(self.groups), columns=[self.camera])
            return groups.column(self.camera).slice(self.skip, self.count)

    def _picture(self, cells: Any, i: int) -> np.ndarray:
        entry = cells[i].as_py()
        data = entry.get("bytes") if isinstance(entry, dict) else None
        return pictures.from_bytes(
            data, f"the picture of frame {self.first_frame + i} in '{self.path}'"
        )


@dataclass(frozen=True)
class VideoPart:
    """Frames of a video file at ascending times.

    Attributes:
        episodes: all episodes that are read from the file, for an error's advice.
    """

    path: Path
    times: tuple[float, ...]
    tolerance: float
    first_frame: int
    episodes: str

    @property
    def count(self) -> int:
        return len(self.times)

    def decode(self) -> Iterator[np.ndarray]:
        """Frames [H, W, 3] uint8."""
        with self._advising():
            yield from video.read(self.path, self.times, self.tolerance)

    def at(self, i: int) -> np.ndarray:
        """Frame `i` of the part."""
        with self._advising():
            return next(video.read(self.path, self.times[i : i + 1], self.tolerance))

    @contextmanager
    def _advising(self) -> Generator[None]:
        """Name the episodes to leave out if the file is missing or damaged."""
        try:
            yield
        except AegisError as error:
            if error.fix != layout.AGAIN:  # such as a file that Git LFS has not downloaded
                raise
            fix = f"get the dataset again, or leave out episodes {self.episodes} ({CHOOSING})"
            raise AegisError(error.found, error.expected, fix) from error


Part = ImagePart | VideoPart


def load(
    source: Source,
    index: Index,
    camera: str,
    side: int | None,
    digest: str,
    workers: int | None,
    on_event: OnEvent,
) -> tuple[np.ndarray, Path]:
    """All frames of a camera, memory-mapped; they are decoded first if they are not cached.

    Frames of episodes that are not read keep their places, which take no disk space.

    Args:
        side: pixels of the square that each frame is fitted into; None: frames keep their size, or
            are fitted to the first one's.
        digest: of what the frames are decoded from, as `source.pixel_digests` gives it.
        workers: processes; the frames do not depend on it. Default: up to one per core, fewer for
            few frames.

    Returns:
        The frames [N, H, W, 3] uint8, and the file that holds them.

    Raises:
        AegisError: a picture or video is missing or damaged, or the cache cannot be written.
    """
    path, count = _file(source, camera, side, digest), source.dataset.info.frames
    kept = path.exists()
    if not kept:
        parts = list(split(source, index, camera))
        _make_cache(path.parent, parts)
        # Without a side, the first frame determines the size that others are fitted to.
        height, width = (side, side) if side is not None else parts[0].at(0).shape[:2]
        _write(path, parts, (count, height, width, 3), workers, camera, on_event)
    frames = _open(path, count)
    if kept:
        cache.mark_read(path)
        _check_some(path, frames, source, index, camera)
    return frames, path


def _make_cache(folder: Path, parts: Sequence[Part]) -> None:
    """Create the folder of decoded frames.

    Raises:
        AegisError: it cannot be created.
    """
    try:
        files.make_folder(folder)
    except AegisError as error:
        fix = f"set AEGIS_CACHE to a folder that can be written{_without(parts)}"
        raise AegisError(error.found, "a cache of decoded frames", fix) from error


def _without(parts: Sequence[Part]) -> str:
    """The end of an advice: how to avoid the cache, if that is possible."""
    return ", or --set demos.cache=false" if isinstance(parts[0], VideoPart) else ""


def are_kept(source: Source, camera: str, side: int | None, digest: str) -> bool:
    """Whether `load` would find the frames without decoding any."""
    return _file(source, camera, side, digest).exists()


def have_room(
    source: Source, cameras: Mapping[str, str], side: int | None, on_event: OnEvent
) -> bool:
    """Whether the frames to be decoded take at most `_SHARE` of the free disk space.

    If not, a warning says so.

    Args:
        cameras: the digest of each camera that is read, as for `load`.
    """
    features = source.dataset.info.features
    count = sum(source.dataset.episodes[number].length for number in source.episodes)
    needed = 0
    for camera, digest in cameras.items():
        if features[camera].dtype != "image" and not are_kept(source, camera, side, digest):
            values = math.prod(features[camera].shape) if side is None else 3 * side**2
            needed += count * values
    folder = cache.folder("frames")
    there = next(path for path in (folder, *folder.absolute().parents) if path.is_dir())
    free = shutil.disk_usage(there).free
    if needed <= _SHARE * free:
        return True
    text = (
        f"the frames of '{source.dataset.folder}' stay in its videos, and each is decoded when a "
        f"batch needs it: all of them would take {needed / 1e9:,.1f} of the {free / 1e9:,.1f} GB "
        f"that are free for '{folder}'. data_s is how long a step waits for them; --set "
        "demos.cache=true decodes them in advance all the same"
    )
    on_event(Warned("demos", text))
    return False


def _file(source: Source, camera: str, side: int | None, digest: str) -> Path:
    """The cache file of frames decoded from a source with this digest.

    A selection of episodes has its own file, unless the file of all episodes exists.
    """
    # Another decoder or filter makes other pixels from the same files.
    made = {"decoder": fitting.DECODER, "filter": fitting.FILTER}
    key = {"dataset": digest, "camera": camera, "side": side, **made}
    whole = cache.folder("frames") / _name(key)
    if len(source.episodes) == len(source.dataset.episodes) or whole.exists():
        return whole
    return cache.folder("frames") / _name({**key, "episodes": source.episodes})


def _name(key: Mapping[str, Any]) -> str:
    return f"{files.sha256_value(key)[:32]}.npy"


def pick(source: Source, index: Index, camera: str, numbers: Sequence[int]) -> list[np.ndarray]:
    """Some of a camera's frames in their own size, by their ascending numbers."""
    found = []
    for part in split(source, index, camera):
        of_part = range(part.first_frame, part.first_frame + part.count)
        found += [part.at(number - part.first_frame) for number in numbers if number in of_part]
    return found


def split(source: Source, index: Index, camera: str) -> Iterator[Part]:
    """A camera's frames in parts that can be decoded one by one, in order."""
    if source.dataset.info.features[camera].dtype == "image":
        for file in source.data:
            yield from _image_parts(file, camera)
    else:
        yield from video_parts(source, index, camera)


def _image_parts(file: DataFile, camera: str) -> Iterator[ImagePart]:
    """The rows of a file that are read, divided at row groups into parts of sufficient size."""
    with layout.reading_parquet(file.path):
        found = layout.open_parquet(file.path)
        if camera not in found.schema_arrow.names:
            raise AegisError(
                f"no column '{camera}' in '{file.path}'",
                "every feature that meta/info.json lists",
                layout.AGAIN,
            )
        meta = found.metadata
        sizes = [meta.row_group(number).num_rows for number in range(meta.num_row_groups)]
    ends = np.cumsum(sizes)  # the row at which each row group ends
    for rows in file.rows:
        first, last = rows.first, rows.first + rows.count
        for end in ends[np.searchsorted(ends, first, side="right") :].tolist():
            stop = min(end, last)
            # A part ends at the end of a row group: small groups are put together.
            if stop - first >= _PART or stop == last:
                groups = np.searchsorted(ends, [first, stop - 1], side="right")
                chosen = tuple(range(groups[0], groups[1] + 1))
                skip = first - int(ends[groups[0]] - sizes[groups[0]])
                frame = rows.first_frame + first - rows.first
                yield ImagePart(file.path, camera, chosen, skip, frame, stop - first)
                first = stop
            if stop == last:
                break


def video_parts(source: Source, index: Index, camera: str) -> Iterator[VideoPart]:
    """A camera's frames in videos; consecutive episodes of one file are read together."""
    dataset = source.dataset
    tolerance = 0.5 / dataset.info.fps
    ends = _clip_ends(dataset, camera)
    starts = np.cumsum([0, *(episode.length for episode in dataset.episodes)]).tolist()
    of_file: dict[Path, list[int]] = {}
    for number in source.episodes:
        of_file.setdefault(dataset.episodes[number].clips[camera].file, []).append(number)

    def part(path: Path, times: Sequence[float], first: int) -> VideoPart:
        episodes = as_text(of_file[path])
        return VideoPart(dataset.folder / path, tuple(times), tolerance, first, episodes)

    first, path = 0, Path()
    times: list[float] = []
    for number in source.episodes:
        frame, clip = starts[number], dataset.episodes[number].clips[camera]
        own = clip.start_s + index.timestamp[frame : starts[number + 1]]
        _check_within_clip(own, ends[number], number, source, camera)
        goes_on = clip.file == path and frame == first + len(times)
        # `video.read` needs ascending times: an episode may lie before one of a lower number.
        if times and (not goes_on or own[0] <= times[-1] or len(times) >= _PART):
            yield part(path, times, first)
            times = []
        if not times:
            first, path = frame, clip.file
        times += own.tolist()
    yield part(path, times, first)


def _clip_ends(dataset: Dataset, camera: str) -> list[float]:
    """Where each episode's clip ends in its file, in seconds: at the latest where the next begins.

    Infinity for the last clip of a file, if the meta folder does not give its end.
    """
    # Of all episodes, including those not read: an episode ends where its neighbour begins.
    clips = [episode.clips[camera] for episode in dataset.episodes]
    begun: dict[Path, list[float]] = {}
    for clip in clips:
        begun.setdefault(clip.file, []).append(clip.start_s)
    for times in begun.values():
        times.sort()
    ends = []
    for clip in clips:
        times = begun[clip.file]
        later = bisect.bisect_right(times, clip.start_s)
        ends.append(min(clip.end_s, times[later] if later < len(times) else math.inf))
    return ends


def _check_within_clip(
    times: np.ndarray, end_s: float, number: int, source: Source, camera: str
) -> None:
    """Raise AegisError if times of an episode in its file [L] are nearest to another's frames.

    This happens if its timestamps have a gap, or the camera has lost frames.
    """
    # A later time is nearer to the next episode's first frame.
    last_s = end_s - 0.5 / source.dataset.info.fps
    past = int((times > last_s).sum())
    if past:
        whose = "1 frame" if past == 1 else f"{past} frames"
        raise AegisError(
            f"{whose} of episode {number} in '{source.dataset.folder}' with timestamps past "
            f"the end of its video of '{layout.short(camera)}'",
            "timestamps that begin at 0 and have no gap that the video lacks",
            f"correct that episode's timestamps, or choose episodes without {number} (demos.only, "
            "--only of aegis anchor, or --episodes of aegis evaluate)",
        )


def _write(
    path: Path,
    parts: Sequence[Part],
    shape: tuple[int, int, int, int],
    workers: int | None,
    camera: str,
    on_event: OnEvent,
) -> None:
    """Decode a camera's frames into a file beside `path`, then rename it."""
    files.sweep_all(path.parent)  # left over from killed processes
    cache.sweep(path.parent)
    count = sum(part.count for part in parts)
    needed, free = count * int(np.prod(shape[1:])), shutil.disk_usage(path.parent).free
    if needed > free:
        raise AegisError(
            f"{free / 1e6:,.2f} MB free in '{path.parent}'",
            f"{needed / 1e6:,.2f} MB for the decoded frames",
            f"free some space, set AEGIS_CACHE to a folder on a larger disk{_without(parts)}",
        )
    try:
        with files.aside(path) as (aside, file):
            # The file gets its full size at once; each process writes its parts at their offsets.
            offset = npy.open_memmap(aside, "w+", np.uint8, shape).offset
            done, stage = 0, f"decode {layout.short(camera)}"
            workers = workers or worker_count(len(parts) // _PER_WORKER)
            decode = partial(_decode, aside, offset, shape[1:3])
            on_event(Progress(stage, done, count, "frames"))
            with mapped(
                decode, parts, workers, "a decoding process", "free some memory, then run it again"
            ) as counts:
                for decoded in counts:
                    done += decoded
                    on_event(Progress(stage, done, count, "frames"))
            os.fsync(file.fileno())  # else a power failure could leave a name without frames
            os.replace(aside, path)
    except OSError as error:
        raise AegisError(
            f"cannot write '{path}': {error.strerror or error}",
            "a cache that can be written",
            "free some space, or set AEGIS_CACHE to another folder",
        ) from error


def _decode(file: Path, offset: int, size: tuple[int, int], part: Part) -> int:
    """Write a part's frames at their offset in the file."""
    height, width = size
    count = 0
    with open(file, "r+b") as out:
        out.seek(offset + part.first_frame * height * width * 3)
        for frame in part.decode():
            out.write(np.ascontiguousarray(fitting.fit(frame, height, width)).data)
            count += 1
    return count


def _check_some(path: Path, frames: np.ndarray, source: Source, index: Index, camera: str) -> None:
    """Compare the first, a middle and the last cached frame with the dataset's.

    Comparing all would take as long as the cache saves.

    Raises:
        AegisError: the file holds other frames.
    """
    parts = list(split(source, index, camera))
    first, middle, last = parts[0], parts[len(parts) // 2], parts[-1]
    chosen = [(first, 0), (middle, middle.count // 2), (last, last.count - 1)]
    for part, place in chosen:
        number = part.first_frame + place
        # In floats, because differences of uint8 wrap around.
        wanted = fitting.fit(part.at(place), *frames.shape[1:3]).astype(float)
        if np.abs(frames[number] - wanted).mean() > _SAME:
            raise AegisError(
                f"frame {number} of the cached frames in '{path}', which are not those of "
                f"'{source.dataset.folder}'",
                "the frames that were decoded from it",
                f"rm '{path}'",
            )


def _open(path: Path, frames: int) -> np.ndarray:
    try:
        array = _mapped(path)
        if array.dtype != np.uint8 or array.ndim != 4 or len(array) != frames:
            raise ValueError(f"{array.dtype} {list(array.shape)}")
    except (OSError, ValueError) as error:
        raise AegisError(
            f"the cached frames in '{path}' are damaged: {error}",
            f"{frames} frames",
            f"rm '{path}'",
        ) from error
    return array


def _mapped(path: Path) -> np.ndarray:
    """The array of a .npy file, which may be larger than the memory.

    The mapping is private to this process: torch regards a tensor over it as writable, but the file
    is never written. NumPy's own mapping of this kind has to fit into memory as a whole.

    Raises:
        OSError, ValueError: the file cannot be read, or is damaged.
    """
    with open(path, "rb") as file:
        version = npy.read_magic(file)
        shape, _, kind = npy.read_array_header_1_0(file)
        if version != (1, 0) or kind.hasobject:
            raise ValueError(f"version {version} of {kind}")
        start, flags = file.tell(), mmap.MAP_PRIVATE | _NORESERVE
        bytes_of = mmap.mmap(file.fileno(), 0, flags=flags, prot=mmap.PROT_READ | mmap.PROT_WRITE)
    return np.frombuffer(bytes_of, kind, math.prod(shape), start).reshape(shape)
