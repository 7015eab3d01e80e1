"""Find equal pictures under two names, which a split by name would treat as different."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Tally
from aegis_cli.common.files import sha256_file
from aegis_cli.data.vqa.images import Picture

# Different files of equal size nearly always differ in their last bytes; their first bytes are
# headers, which are alike in pictures of one camera.
_END = 4096  # bytes
_EVERY = 256  # files between two reports of progress

Told = Callable[[Path], int | bytes | str]


def shared(
    held_out: Sequence[Picture], others: Sequence[Picture], on_event: OnEvent
) -> list[tuple[Picture, Picture]]:
    """The held-out pictures whose file equals one of the others, byte for byte, each with that one.

    Only files of equal size have their ends compared, and only those with equal ends are read
    whole. Pictures that are not files of their own are left out.
    """
    tells: tuple[Told, ...] = (_size, _end, sha256_file)
    pairs: list[tuple[Picture, Picture]] = []
    for told in tells:
        total = len(held_out) + len(others)
        tally = Tally("compare pictures", total, "files", _EVERY, on_event)
        mine = dict(_told(tally.each(held_out), told))
        theirs = dict(_told(tally.each(others), told))
        first = {value: picture for picture, value in reversed(theirs.items())}
        pairs = [(picture, first[value]) for picture, value in mine.items() if value in first]
        alike = {*mine.values()}
        held_out = [picture for picture, _ in pairs]
        others = [picture for picture, value in theirs.items() if value in alike]
    return pairs


def _told(pictures: Iterable[Picture], told: Told) -> Iterator[tuple[Picture, int | bytes | str]]:
    """The result of `told` for each picture's file; unreadable files are skipped."""
    for picture in pictures:
        if isinstance(picture.source, Path):
            try:
                yield picture, told(picture.source)
            except (OSError, AegisError):  # reported when the picture is used
                continue


def _size(file: Path) -> int:
    return file.stat().st_size


def _end(file: Path) -> bytes:
    with file.open("rb") as opened:
        opened.seek(max(0, _size(file) - _END))
        return opened.read()
