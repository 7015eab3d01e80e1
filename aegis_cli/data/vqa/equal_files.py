"""Pictures that are one and the same under two names, which a split by names tells apart."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Progress
from aegis_cli.common.files import sha256_file
from aegis_cli.data.vqa.images import Picture

# Two files of one size that are not equal nearly always differ here: their beginnings are headers,
# which are alike in pictures of one camera.
_END = 4096  # bytes
_EVERY = 256  # files between two reports of progress

Told = Callable[[Path], int | bytes | str]


def shared(
    held_out: Sequence[Picture], others: Sequence[Picture], on_event: OnEvent
) -> list[tuple[Picture, Picture]]:
    """The held-out pictures whose file is one of the others', byte for byte, each with that one.

    The ends are read of files of equal sizes alone, and all of it where the ends are equal, too.
    Pictures that lie in no file of their own are left out.
    """
    tells: tuple[Told, ...] = (_size, _end, sha256_file)
    pairs: list[tuple[Picture, Picture]] = []
    for told in tells:
        total = len(held_out) + len(others)
        mine = dict(_told(held_out, told, on_event, 0, total))
        theirs = dict(_told(others, told, on_event, len(held_out), total))
        if total >= _EVERY:  # what has been begun is ended
            on_event(Progress("compare pictures", total, total, "files"))
        first = {value: picture for picture, value in reversed(theirs.items())}
        pairs = [(picture, first[value]) for picture, value in mine.items() if value in first]
        alike = {*mine.values()}
        held_out = [picture for picture, _ in pairs]
        others = [picture for picture, value in theirs.items() if value in alike]
    return pairs


def _told(
    pictures: Sequence[Picture], told: Told, on_event: OnEvent, before: int, total: int
) -> Iterator[tuple[Picture, int | bytes | str]]:
    """What is told of each picture's file; nothing of one that cannot be read.

    Args:
        before: how many of `total` files have been looked at before these.
    """
    for number, picture in enumerate(pictures, before + 1):
        if number % _EVERY == 0:
            on_event(Progress("compare pictures", number, total, "files"))
        if isinstance(picture.source, Path):
            try:
                yield picture, told(picture.source)
            except (OSError, AegisError):  # whoever looks at the picture says what is wrong
                continue


def _size(file: Path) -> int:
    return file.stat().st_size


def _end(file: Path) -> bytes:
    with file.open("rb") as opened:
        opened.seek(max(0, _size(file) - _END))
        return opened.read()
