"""Streams of image folders: ROOT/TASK/{train,test}/CLASS/IMAGE, the usual layout of datasets."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from aegis_cli.common.errors import AegisError
from aegis_cli.common.files import parse_json, reading, sha256_file
from aegis_cli.common.pictures import decoded
from aegis_cli.data.streams.contract import Part, StreamTask, has_one_gap

TEMPLATE = "a photo of a {}"  # without a full stop, which the embedded encoder does not know
# A file in a task's folder, with the words for class folders that are named otherwise.
CLASSES = "classes.json"
TEMPLATES = "templates.txt"
VALIDATION = 20  # every 20th training image, if a task has no validation folder
_SUFFIXES = {".jpg", ".jpeg", ".png", ".bmp", ".ppm", ".webp", ".tif", ".tiff"}
_THREADS = 4  # decoders; Pillow releases the GIL while it works


@dataclass(frozen=True)
class Listing:
    """The images of one part by path, and their labels."""

    files: tuple[Path, ...]
    labels: tuple[int, ...]

    def where(self, chosen: Sequence[bool]) -> Listing:
        """The images for which `chosen` is True."""
        rows = [i for i, is_chosen in enumerate(chosen) if is_chosen]
        return Listing(tuple(self.files[i] for i in rows), tuple(self.labels[i] for i in rows))

    def part(self, size: int) -> Part:
        """The images at `size` pixels per side, with their labels."""
        labels = torch.tensor(self.labels, dtype=torch.int64)
        return Part(labels, lambda rows: decode([self.files[i] for i in rows.tolist()], size))


def load(root: Path, name: str, size: int, templates: Sequence[str] = (TEMPLATE,)) -> StreamTask:
    """The task in `root/name`; its images are decoded on access.

    A class that `classes.json` does not name has the name of its folder, with spaces for
    underscores. A `templates.txt` beside it, one sentence with "{}" per line, replaces `templates`.
    Without a `validation` folder every twentieth training image, chosen by the hash of its path, is
    held out for validation.

    Raises:
        AegisError: folders are missing or empty, classes differ between parts, or no image can be
            held out.
    """
    folder = Path(root) / name
    classes, listed = _parts(folder)
    listed = _split(folder, listed)
    words = _words(folder, classes)
    if (folder / TEMPLATES).is_file():
        templates = _sentences(folder / TEMPLATES)
    parts = {part: listed[part].part(size) for part in ("train", "validation", "test")}
    return StreamTask(name, words, tuple(templates), **parts)


def contents(folder: Path) -> dict[str, object]:
    """The contents that a task is loaded from: its classes, and a digest of each file.

    File sizes would not be enough, because another picture may have the same size. The files are
    read each time, which takes little time compared with decoding them, which every run does.

    Raises:
        AegisError: as in `load`, or a file cannot be read.
    """
    classes, parts = _parts(folder)
    used = [file for listed in parts.values() for file in listed.files]
    # Words are included: other class names or sentences make another task from the same images.
    used += filter(Path.is_file, (folder / CLASSES, folder / TEMPLATES))
    with ThreadPoolExecutor(_THREADS) as pool:
        digests = list(pool.map(sha256_file, used))
    names = [path.relative_to(folder).as_posix() for path in used]
    return {"classes": classes, "files": dict(zip(names, digests, strict=True))}


def shared(folder: Path, digests: Mapping[str, str]) -> tuple[list[tuple[str, str]], int]:
    """The held-out images of a task that are also, byte for byte, in an earlier part.

    Args:
        digests: of the files, by name, as from `contents`.

    Returns:
        Their names, each with the equal file's in an earlier part; and the number of held-out
        images.
    """
    listed = _split(folder, _parts(folder)[1])
    known: dict[str, str] = {}  # digest -> the first file
    total, found = 0, list[tuple[str, str]]()
    for part in ("train", "validation", "test"):
        names = [file.relative_to(folder).as_posix() for file in listed[part].files]
        if part != "train":
            total += len(names)
            found += [(name, known[digests[name]]) for name in names if digests[name] in known]
        for name in names:
            known.setdefault(digests[name], name)
    return found, total


def decode(files: Sequence[Path], size: int) -> Tensor:
    """Images [B, size, size, 3] uint8, resized and cropped as by CLIP's processor.

    The shorter side is resized (bicubic), and the centre is cropped.

    Raises:
        AegisError: a file is no complete image.
    """
    with ThreadPoolExecutor(_THREADS) as pool:
        squares = list(pool.map(lambda file: _square(file, size), files))
    return torch.from_numpy(np.stack(squares))


def _square(file: Path, size: int) -> np.ndarray:
    from PIL import Image

    try:
        image = Image.fromarray(decoded(file.read_bytes()))
    except (OSError, ValueError) as error:
        raise AegisError(
            f"'{file}' cannot be read as an image ({error})",
            "a whole image file",
            "replace or remove it",
        ) from error
    shorter = min(image.size)
    # The longer side is truncated to whole pixels, as in CLIP's processor; rounding would differ.
    # The shorter one is set directly, since a float quotient may be a pixel too small.
    width, height = (size if side == shorter else int(size * side / shorter) for side in image.size)
    left, top = (width - size) // 2, (height - size) // 2
    scaled = image.resize((width, height), Image.Resampling.BICUBIC)
    return np.asarray(scaled.crop((left, top, left + size, top + size)))


def _parts(folder: Path) -> tuple[list[str], dict[str, Listing]]:
    """The class folders of a task, and the images of its existing parts."""
    parts = {part: folder / part for part in ("train", "validation", "test")}
    missing = [str(parts[part]) for part in ("train", "test") if not parts[part].is_dir()]
    if missing:
        raise AegisError(
            f"no folder {' and no folder '.join(missing)}",
            f"{folder}/train/CLASS/IMAGE and …/test/CLASS/IMAGE",
            "unpack the dataset there, a folder for each class",
        )
    classes = _class_folders(parts["train"])
    there = {part: path for part, path in parts.items() if path.is_dir()}
    return classes, {part: _list(path, classes) for part, path in there.items()}


def _visible_folders(folder: Path) -> list[str]:
    """Names of the visible subfolders, in alphabetical order."""
    names = [path.name for path in folder.iterdir() if path.is_dir()]
    return sorted(name for name in names if not name.startswith("."))


def _split(folder: Path, listed: Mapping[str, Listing]) -> dict[str, Listing]:
    """The same parts; if there is no validation part, some training images are held out."""
    if "validation" in listed:
        return dict(listed)
    train, validation = _held_back(listed["train"], folder)
    return {**listed, "train": train, "validation": validation}


def _class_folders(train: Path) -> list[str]:
    """Names of the class folders, in the order of the labels."""
    found = _visible_folders(train)
    if len(found) < 2:
        expected = "a folder for each of two classes or more"
        raise AegisError(
            f"{len(found)} folders in '{train}'", expected, "sort the images into them"
        )
    return found


def _list(part: Path, classes: Sequence[str]) -> Listing:
    """The images of a part, by class; a part may lack some classes."""
    folders = _visible_folders(part)
    if unknown := [name for name in folders if name not in classes]:
        raise AegisError(
            f"'{part}' has the classes {unknown[:3]}, which train lacks",
            "train's classes",
            "move the folders, or name them alike",
        )
    files, labels = [], []
    for label, name in enumerate(classes):
        inside = (part / name).rglob("*") if name in folders else ()
        # Sorted, because the order of a folder differs between file systems.
        images = sorted(p for p in inside if _is_image(p.relative_to(part)))
        files += images
        labels += [label] * len(images)
    if not files:
        raise AegisError(
            f"no image in '{part}'",
            f"images ({', '.join(sorted(_SUFFIXES))}) in class folders",
            "check the path",
        )
    return Listing(tuple(files), tuple(labels))


def _is_image(path: Path) -> bool:
    """Whether a path has the suffix of an image, and no part of it is hidden.

    Hidden files belong to some program, such as thumbnails of the images.
    """
    hidden = any(name.startswith(".") for name in path.parts)
    return path.suffix.lower() in _SUFFIXES and not hidden


def _held_back(train: Listing, folder: Path) -> tuple[Listing, Listing]:
    """Split training images into training and validation.

    A path's hash decides, so adding images moves no other image. The exception is a class that
    would have no training image left: it keeps one.

    Raises:
        AegisError: there is only one image per class, so none can be held out.
    """
    names = [file.relative_to(folder).as_posix() for file in train.files]
    hashed = [hashlib.sha256(name.encode()).digest() for name in names]
    numbers = [int.from_bytes(digest[:8], "big") for digest in hashed]
    rising = sorted(range(len(hashed)), key=hashed.__getitem__)
    last = {train.labels[i]: i for i in rising}  # class -> the image with the largest hash
    held = {i for i in rising if numbers[i] % VALIDATION == 0}
    held.add(rising[0])  # at least one image is held out, even in a small task
    learned = {label for i, label in enumerate(train.labels) if i not in held}
    held -= {i for label, i in last.items() if label not in learned}
    if not held:  # the only one was returned to its class
        spare = [i for i in rising if i not in last.values()]
        if not spare:
            raise AegisError(
                f"one image of each class in '{folder / 'train'}', and no folder 'validation'",
                "an image to validate on, and one of each class to learn from",
                f"put some into {folder}/validation/CLASS",
            )
        held.add(spare[0])
    is_held = [i in held for i in range(len(names))]
    return train.where([not each for each in is_held]), train.where(is_held)


def _sentences(path: Path) -> list[str]:
    """The non-empty lines of a file, each a sentence with one gap."""
    with reading(path, "check the path"):
        text = path.read_bytes()
    try:
        lines = text.decode("utf-8").splitlines()
    except UnicodeDecodeError as error:
        fix = f"iconv -f LATIN1 -t UTF-8, or the encoding that it was written in, on '{path}'"
        raise AegisError(
            f"'{path}' is not UTF-8 ({error})", "sentences with a '{}' in UTF-8, one per line", fix
        ) from error
    found = [line.strip() for line in lines if line.strip()]
    wrong = [line for line in found if not has_one_gap(line)]
    if wrong or not found:
        raise AegisError(
            f"'{path}' with {repr(wrong[0]) if wrong else 'no sentence'}",
            "sentences with one '{}' and no other brace, one per line",
            "write e.g. 'a photo of a {}.', or remove the file",
        )
    return found


def _words(folder: Path, classes: Sequence[str]) -> tuple[str, ...]:
    """The word for each class in a sentence.

    Raises:
        AegisError: `classes.json` is no mapping of class folders to words.
    """
    path = folder / CLASSES
    named: dict[str, str] = {}
    if path.is_file():
        try:
            with reading(path, "check the path"):
                named = parse_json(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise AegisError(
                f"'{path}' is not JSON ({error})", '{"folder": "words", …}', "correct it"
            ) from error
        words = list(named.values()) if isinstance(named, dict) else [None]
        if not all(isinstance(word, str) and word for word in words):
            raise AegisError(
                f"'{path}' with values that are not words", '{"folder": "words", …}', "correct it"
            )
        if unknown := sorted(set(named) - set(classes)):
            found = f"'{path}' names {unknown[:3]}, which are not folders of train"
            raise AegisError(found, "names of class folders", "correct it")
    return tuple(named.get(name, name.replace("_", " ")) for name in classes)
