"""`--vqa FOLDER[#SPLIT]`: a Hugging Face dataset as `save_to_disk` wrote it, or as parquet.

Columns: `image` or `images`, `question`, and `answers` (texts, or objects with the key `answer`),
else `answer` or `multiple_choice_answer`; or a conversation instead of questions and answers
(`conversations.py`). If present, `question_id` or `id`, `image_id`, `answer_type` and `source` are
read too.
"""

from __future__ import annotations

import hashlib
import logging
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePath
from typing import Any, TypeVar

from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Progress, ignore
from aegis_cli.common.files import refuse_special, sha256_file
from aegis_cli.common.json_lists import CHUNK
from aegis_cli.data.vqa import conversations
from aegis_cli.data.vqa.entries import (
    ANSWERS,
    Entry,
    Inside,
    OnRead,
    Read,
    Reader,
    bad,
    make_question,
)
from aegis_cli.data.vqa.images import Picture
from aegis_cli.data.vqa.questions import Question

_NAMES = ("question_id", "id")
_USED = {
    *(*_NAMES, "question", *ANSWERS, *conversations.KEYS),
    *("image_id", "answer_type", "source"),
}
_BATCH = 1000  # rows that are taken at a time; a multiple of the ten that `datasets` takes
# Files that save_to_disk writes for one split, and for several.
_SAVED, _SPLITS = "state.json", "dataset_dict.json"
Stem = TypeVar("Stem", bound=PurePath)

# The suffix after a split's name in the names of its parquet files; older ones have a hash.
_PART = re.compile(r"(^|[-_])\d+(-of-\d+(-[0-9a-f]+)?)?$")


def is_dataset(path: Path) -> bool:
    """Whether a path looks like a dataset."""
    return any((path / name).is_file() for name in (_SAVED, _SPLITS)) or bool(_parquet(path))


def reader(path: Path, split: str | None = None) -> Reader:
    """The questions of one split.

    Args:
        split: its name; None if there is only one.

    Raises:
        AegisError: there are several splits or none of that name, a file is a pipe, or the package
            is missing.
    """
    _check_package()
    if (path / _SPLITS).is_file():
        path = _folder_of_split(path, split)
        split = None  # that folder holds one split
    if (path / _SAVED).is_file():
        files = sorted(path.glob("*.arrow"))
        if split is not None:
            raise _no_split(path, split, [])
    else:
        files = list(of_split(str(path), _parquet(path), split))
    # `datasets` would wait forever for a pipe.
    for file in (*files, *path.glob("*.json")):
        refuse_special(file)
    return Reader(partial(_read, path, tuple(files)), tuple(files))


def _folder_of_split(path: Path, split: str | None) -> Path:
    """The folder that save_to_disk wrote for a split, or for the only one if None."""
    folders = {saved.parent.name: saved.parent for saved in path.glob(f"*/{_SAVED}")}
    if not folders:
        raise AegisError(
            f"no split in '{path}', which should hold some",
            "the folder of one split",
            "download it again",
        )
    return folders[_chosen(str(path), [*folders], split)]


def of_split(where: str, files: Sequence[Stem], split: str | None) -> list[Stem]:
    """The parquet files of a split, or of the only one if None.

    Args:
        where: the set's path or name.

    Raises:
        AegisError: there are several splits, or none of that name.
    """
    splits = [_split(file) for file in files]
    chosen = _chosen(where, splits, split)
    return [file for file, own in zip(files, splits, strict=True) if own == chosen]


def _split(file: PurePath) -> str:
    """The split of a parquet file, by its name; files that are only numbered form one split."""
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
    """The requested split, or the only one if None."""
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
        found = f"no split '{split}' in '{where}', which is a single split without a name"
        return AegisError(found, "a split's name only where there are several", f"--vqa '{where}'")
    found = f"no split '{split}' in '{where}'"
    return AegisError(found, f"one of {', '.join(splits)}", f"--vqa '{where}#{splits[-1]}'")


def _read(
    path: Path, files: tuple[Path, ...], on_event: OnEvent, on_read: OnRead
) -> Iterator[Read]:
    is_large = sum(file.stat().st_size for file in files if file.exists()) > CHUNK
    tell = on_event if is_large else ignore
    tell(Progress("open", 0, 1, "data set"))  # `datasets` first converts parquet files, in minutes
    rows = _open(path, files)
    tell(Progress("open", 1, 1, "data set"))
    columns = rows.column_names
    _check_columns(path, columns)
    stored = _Stored(path, files, rows)
    name = next((c for c in _NAMES if c in columns), None)
    folder = Inside(path if path.is_dir() else path.parent)
    told = rows.select_columns([c for c in columns if c in _USED])
    outside = _outside(rows)
    for number, row in enumerate(_each(told, path, on_read)):
        where = f"row {number} of '{path}'"
        try:
            apart = next(outside)
            if isinstance(apart, int):  # raises
                conversations.one_picture(where, [None] * apart)
            at: str | _InRow = _InRow(stored, number)
            if isinstance(apart, str) and apart:
                at = folder.find(where, apart).path
            image_id = row.get("image_id")
            # Rows repeat images: equal bytes are one image, which belongs to one part. If it has an
            # id, no image has to be read to know that.
            key = _digest(at) if image_id is None else f"image {image_id}"
            picture = Picture(key, where, at)
            for question in _questions(where, row, number if name is None else row[name]):
                yield Entry(where, question, picture)
        except AegisError as error:
            yield error


def _pictures(columns: Sequence[str]) -> str:
    """The column of images, or of lists of images."""
    return "images" if "image" not in columns and "images" in columns else "image"


def _check_columns(path: Path, columns: Sequence[str]) -> None:
    """Raise AegisError unless there are images, and questions with answers or conversations."""
    asks = "question" in columns and any(answers in columns for answers in ANSWERS)
    if _pictures(columns) in columns and (asks or conversations.key_of(columns) is not None):
        return
    raise AegisError(
        f"the columns {', '.join(columns)} in '{path}'",
        f"image, question and one of {', '.join(ANSWERS)}; or image or images and one of "
        f"{', '.join(conversations.KEYS)}",
        "rename the columns (datasets: rename_column)",
    )


def _questions(where: str, row: dict[str, Any], name: Any) -> list[Question]:
    """A row's single question, or those of its conversation."""
    if (key := conversations.key_of(row)) is not None:
        return conversations.questions(where, row[key], name, row.get("source"))
    answers = next(c for c in ANSWERS if c in row)
    kind = row.get("answer_type")
    family = kind if isinstance(kind, str) and kind else "all"
    return [make_question(where, row["question"], row[answers], name, family)]


def _open(path: Path, files: tuple[Path, ...]) -> Any:
    """The rows, with images as stored bytes."""
    import datasets

    datasets.disable_progress_bars()  # ours are enough
    log = logging.getLogger("datasets")
    before = log.level
    log.setLevel(logging.CRITICAL)  # the error already says what is wrong with a damaged file
    try:
        if files and files[0].suffix == ".parquet":
            rows = datasets.Dataset.from_parquet([str(f) for f in files])
        else:
            rows = datasets.load_from_disk(str(path))
        columns = list(rows.column_names)
        column = _pictures(columns)
        # As bytes: decoding every image would take hours before the first question. A column of
        # lists would be rewritten beside the set by the cast, so it is read by pyarrow instead.
        if column in columns and not _is_listed(rows, column):
            rows = rows.cast_column(column, datasets.Image(decode=False))
    except Exception as error:  # for a damaged file, pyarrow may raise almost anything
        raise _unreadable(path, error) from error
    finally:
        log.setLevel(before)
    return rows


def _is_listed(rows: Any, column: str) -> bool:
    """Whether each row has a list of images."""
    import pyarrow as pa

    kind = rows.data.schema.field(column).type
    listed = bool(pa.types.is_list(kind) or pa.types.is_large_list(kind))
    if listed and not pa.types.is_struct(kind.value_type):
        raise ValueError(f"lists of {kind.value_type} in the column {column}")
    return listed


def _each(rows: Any, path: Path, on_read: OnRead) -> Iterator[dict[str, Any]]:
    """The rows one by one; a damaged file may have fewer than it claims."""
    given = 0
    batches = rows.iter(batch_size=_BATCH)  # many times faster than one by one
    while True:
        try:
            batch = next(batches)
        except StopIteration:
            return
        except Exception:  # its first rows may be whole
            break
        for values in zip(*batch.values(), strict=True):
            yield dict(zip(batch, values, strict=True))
            given += 1
        on_read(given, len(rows))
    try:
        remaining = iter(rows.select(range(given, len(rows))))
        while (row := next(remaining, None)) is not None:
            yield row
    except Exception as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> AegisError:
    # `datasets` only says that a file could not be read; its cause says why.
    why = (str(error.__cause__ or error).splitlines() or [type(error).__name__])[0]
    expected = "questions in a folder that datasets saved, or in whole parquet files"
    return AegisError(f"'{path}' cannot be read ({why})", expected, "download it again")


def _outside(rows: Any) -> Iterator[str | int | None]:
    """The path of each row's image if it is not stored in the row; no image is read for this.

    A number is the count of images in a row that does not have exactly one.
    """
    column = _pictures(rows.column_names)
    listed = _is_listed(rows, column)
    for images in rows.data.column(column).iterchunks():
        for first in range(0, len(images), _BATCH):
            yield from _outside_of(images.slice(first, _BATCH), listed)


def _outside_of(images: Any, listed: bool) -> Sequence[str | int | None]:
    """The same for some of the rows."""
    import pyarrow.compute as pc

    counts = None
    if listed:
        counts = pc.fill_null(pc.list_value_length(images), 0)
        images = pc.list_flatten(images)
    stored, paths = pc.struct_field(images, "bytes"), pc.struct_field(images, "path")
    size = pc.fill_null(pc.binary_length(stored), 0)
    # If a row has both, the path is only where the image was on its author's disk.
    missing = pc.equal(size, 0)
    apart = pc.if_else(missing, paths, None).to_pylist()
    if counts is None:
        return apart
    each = iter(apart)
    rows_of = [[next(each) for _ in range(count)] for count in counts.to_pylist()]
    return [own[0] if len(own) == 1 else len(own) for own in rows_of]


@dataclass
class _Stored:
    """The rows of a set. A copy sent to another process opens its files there."""

    path: Path
    files: tuple[Path, ...]
    rows: Any

    def __getstate__(self) -> dict[str, Any]:
        return {"path": self.path, "files": self.files}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.path, self.files = state["path"], state["files"]
        self.rows = _open(self.path, self.files)


@dataclass(frozen=True, slots=True)
class _InRow:
    """Reads the bytes of an image that is stored in its row."""

    stored: _Stored
    number: int

    @property
    def where(self) -> str:
        return f"row {self.number} of '{self.stored.path}'"

    def __call__(self) -> bytes:
        rows = self.stored.rows
        image = rows.data.column(_pictures(rows.column_names))[self.number].as_py()
        if isinstance(image, list):
            image = image[0]
        if not image or not image.get("bytes"):
            raise bad(self.where, "no image", "an image per row", "add it")
        return bytes(image["bytes"])


def _digest(at: str | Callable[[], bytes]) -> str:
    """sha256 of an image's bytes, from a file or a function."""
    return sha256_file(at) if isinstance(at, str) else hashlib.sha256(at()).hexdigest()
