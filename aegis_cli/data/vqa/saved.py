"""`--vqa FOLDER[#SPLIT]`: a Hugging Face dataset as `save_to_disk` wrote it, or as parquet.

Columns: `image`, `question`, and `answers` (texts, or objects with the key `answer`), else `answer`
or `multiple_choice_answer`; where they exist, `question_id` or `id`, `image_id` and `answer_type`
are read too.
"""

from __future__ import annotations

import hashlib
import logging
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any, TypeVar

from aegis_cli.common.errors import AegisError
from aegis_cli.common.files import refuse_special, sha256_file
from aegis_cli.data.vqa.entries import ANSWERS, Entry, Inside, Read, Reader, bad, make_question
from aegis_cli.data.vqa.images import Picture

_NAMES = ("question_id", "id")
# Files that save_to_disk writes for one split, and for several.
_SAVED, _SPLITS = "state.json", "dataset_dict.json"
Stem = TypeVar("Stem", bound=PurePath)

# What follows a split's name in the names of its parquet files; older ones have a hash.
_PART = re.compile(r"(^|[-_])\d+(-of-\d+(-[0-9a-f]+)?)?$")


def is_dataset(path: Path) -> bool:
    """Whether a path looks like a dataset."""
    return any((path / name).is_file() for name in (_SAVED, _SPLITS)) or bool(_parquet(path))


def reader(path: Path, split: str | None = None) -> Reader:
    """The questions of one split.

    Args:
        split: its name; None: there is only one.

    Raises:
        AegisError: several splits, none of that name, a pipe in place of a file, or no package that
            reads them.
    """
    _check_package()
    if (path / _SPLITS).is_file():
        path = _folder_of_split(path, split)
        split = None  # that folder is one split
    if (path / _SAVED).is_file():
        files = sorted(path.glob("*.arrow"))
        if split is not None:
            raise _no_split(path, split, [])
    else:
        files = list(of_split(str(path), _parquet(path), split))
    # `datasets` would wait for a pipe for ever.
    for file in (*files, *path.glob("*.json")):
        refuse_special(file)
    return Reader(lambda: _read(path, tuple(files)), tuple(files))


def _folder_of_split(path: Path, split: str | None) -> Path:
    """The folder that save_to_disk wrote of a split, or of the only one for None."""
    folders = {saved.parent.name: saved.parent for saved in path.glob(f"*/{_SAVED}")}
    if not folders:
        raise AegisError(
            f"no split in '{path}', which is to hold some",
            "the folder of one split",
            "download it again",
        )
    return folders[_chosen(str(path), [*folders], split)]


def of_split(where: str, files: Sequence[Stem], split: str | None) -> list[Stem]:
    """The parquet files of a split, or of the only one for None.

    Args:
        where: the set's path or name.

    Raises:
        AegisError: several splits, or none of that name.
    """
    splits = [_split(file) for file in files]
    chosen = _chosen(where, splits, split)
    return [file for file, own in zip(files, splits, strict=True) if own == chosen]


def _split(file: PurePath) -> str:
    """The split of a parquet file, by its name; files that are only numbered are of one split."""
    return _PART.sub("", file.stem) or "numbered files"


def _parquet(path: Path) -> list[Path]:
    """The parquet files: the path itself, those in the folder, or those in its `data` folder."""
    if path.suffix == ".parquet" and path.is_file():
        return [path]
    return sorted(path.glob("*.parquet")) or sorted((path / "data").glob("*.parquet"))


def _check_package() -> None:
    try:
        import datasets  # noqa: F401
    except ImportError:
        fix = "pip install 'aegis-vla[hf]'"
        raise AegisError(
            "no package 'datasets'", "the package that reads Hugging Face's data sets", fix
        ) from None


def _chosen(where: str, names: Sequence[str], split: str | None) -> str:
    """The split that was asked for, or the only one for None."""
    splits = sorted(set(names))
    if split is not None:
        if split not in splits:
            raise _no_split(where, split, splits)
        return split
    if len(splits) > 1:
        found = f"{len(splits)} splits in '{where}': {', '.join(splits)}"
        raise AegisError(found, "one split", f"name it after a #: --vqa '{where}#{splits[-1]}'")
    return splits[0]


def _no_split(where: str | Path, split: str, splits: Sequence[str]) -> AegisError:
    if not splits:
        found = f"'{where}' is one split without a name, and no '{split}'"
        return AegisError(found, "a split's name where there are several", f"--vqa '{where}'")
    found = f"no split '{split}' in '{where}'"
    return AegisError(found, f"one of {', '.join(splits)}", f"--vqa '{where}#{splits[-1]}'")


def _read(path: Path, files: tuple[Path, ...]) -> Iterator[Read]:
    rows = _open(path, files)
    stored = _Stored(path, files, rows)
    columns = rows.column_names
    answers = next((c for c in ANSWERS if c in columns), None)
    if "image" not in columns or "question" not in columns or answers is None:
        raise AegisError(
            f"the columns {', '.join(columns)} in '{path}'",
            f"image, question and one of {', '.join(ANSWERS)}",
            "rename the columns (datasets: rename_column)",
        )
    keyed = "image_id" in columns  # then no image has to be read to tell which images are the same
    name = next((c for c in _NAMES if c in columns), None)
    folder, outside = Inside(path if path.is_dir() else path.parent), _outside(rows)
    told = rows.remove_columns("image") if keyed else rows
    for number, row in enumerate(_each(told, path)):
        where = f"row {number} of '{path}'"
        try:
            apart = outside[number]
            file = folder.find(where, apart) if apart else None
            own = number if name is None else row[name]
            kind = row.get("answer_type")
            family = kind if isinstance(kind, str) and kind else "all"
            question = make_question(where, row["question"], row[answers], own, family)
            source = file or _InRow(stored, number, where)
            image_id = row.get("image_id")
            # Rows repeat their images: equal bytes are one image, which belongs to one part.
            key = _digest(source) if image_id is None else f"image {image_id}"
            yield Entry(where, question, Picture(key, where, source))
        except AegisError as error:
            yield error


def _open(path: Path, files: tuple[Path, ...]) -> Any:
    """The rows, their images as stored."""
    import datasets

    datasets.disable_progress_bars()  # ours are enough
    log = logging.getLogger("datasets")
    before = log.level
    log.setLevel(logging.CRITICAL)  # what it would log of a damaged file, the error says
    try:
        if files and files[0].suffix == ".parquet":
            rows = datasets.Dataset.from_parquet([str(f) for f in files])
        else:
            rows = datasets.load_from_disk(str(path))
        several = _has_lists_of_images(rows)
        # As bytes: to decode every image would take hours before the first question.
        if "image" in rows.column_names and not several:
            rows = rows.cast_column("image", datasets.Image(decode=False))
    except Exception as error:  # a damaged file makes pyarrow raise nearly anything
        raise _unreadable(path, error) from error
    finally:
        log.setLevel(before)
    if several:
        raise AegisError(
            f"lists of images in the column image of '{path}'",
            "one image of each question",
            "keep the one that is asked about, or join them into one picture (datasets: map)",
        )
    return rows


def _has_lists_of_images(rows: Any) -> bool:
    import pyarrow as pa

    if "image" not in rows.column_names:
        return False
    kind = rows.data.schema.field("image").type
    return bool(pa.types.is_list(kind) or pa.types.is_large_list(kind))


def _each(rows: Any, path: Path) -> Iterator[dict[str, Any]]:
    """The rows one by one; a damaged file may hold fewer than it says."""
    remaining = iter(rows)
    while True:
        try:
            row = next(remaining)
        except StopIteration:
            return
        except Exception as error:
            raise _unreadable(path, error) from error
        yield row


def _unreadable(path: Path, error: Exception) -> AegisError:
    # `datasets` says that a file could not be read, and its cause says why.
    why = (str(error.__cause__ or error).splitlines() or [type(error).__name__])[0]
    expected = "questions in a folder that datasets saved, or in whole parquet files"
    return AegisError(f"'{path}' cannot be read ({why})", expected, "download it again")


def _outside(rows: Any) -> list[str | None]:
    """The path of each row's image that the row does not hold itself; no image is read for that."""
    import pyarrow.compute as pc

    images = rows.data.column("image")
    stored, paths = pc.struct_field(images, "bytes"), pc.struct_field(images, "path")
    size = pc.fill_null(pc.binary_length(stored), 0)
    # Where a row has both, its path is the one that the image had on somebody's disk.
    missing = pc.equal(size, 0)
    return pc.if_else(missing, paths, None).to_pylist()


@dataclass
class _Stored:
    """The rows of a set. A copy that travels to another process opens its files there."""

    path: Path
    files: tuple[Path, ...]
    rows: Any

    def __getstate__(self) -> dict[str, Any]:
        return {"path": self.path, "files": self.files}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.path, self.files = state["path"], state["files"]
        self.rows = _open(self.path, self.files)


@dataclass(frozen=True)
class _InRow:
    """What reads the bytes of an image that lies in its row."""

    stored: _Stored
    number: int
    where: str

    def __call__(self) -> bytes:
        image = self.stored.rows[self.number]["image"] or {}
        if not image.get("bytes"):
            raise bad(self.where, "no image", "an image per row", "add it")
        return bytes(image["bytes"])


def _digest(source: Path | Callable[[], bytes]) -> str:
    """sha256 of an image's bytes, wherever they lie."""
    return sha256_file(source) if isinstance(source, Path) else hashlib.sha256(source()).hexdigest()
