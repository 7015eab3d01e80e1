"""The sets that `--vqa` names: rendered scenes, easy-VQA, or questions in files.

They are split by image into disjoint parts for different purposes.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from aegis_cli.common import hub
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Progress, Warned, ignore
from aegis_cli.common.files import sha256_file, sha256_value
from aegis_cli.common.processes import worker_count
from aegis_cli.data.vqa import download, easy, equal_files, jsonl, official, saved
from aegis_cli.data.vqa.dataset import VQASet, digest_of, load_scenes
from aegis_cli.data.vqa.entries import OR_SKIP, Entry, Reader
from aegis_cli.data.vqa.images import Picture, Pictures, decode
from aegis_cli.data.vqa.packed import Entries, Ids

SCENES = "scenes"
PLAIN = "{}"  # the question is asked as it is
_AT_ONCE = 1024  # images between two reports of progress
# Of ten images in files, four are for anchors and co-training, one is for tuning studies, and five
# are for probes.
PARTS: dict[str, range] = {
    "anchor": range(4),
    "train": range(4),
    "validation": range(4, 5),
    "probe": range(5, 10),
}


# The parts that a part must not share images with: those used before it.
_EARLIER: dict[str, tuple[str, ...]] = {
    "anchor": (),
    "train": (),
    "validation": ("anchor", "train"),
    "probe": ("anchor", "train", "validation"),
}


class TextCheck(Protocol):
    """See `Backbone.check_text`."""

    def __call__(self, question: str, answer: str, image: Tensor | None = None) -> None: ...


@dataclass(frozen=True)
class Scenes:
    """Rendered scenes: each part has its own seeds.

    `ask` is the template of a question's prompt, with {} for the question.
    """

    name: str = SCENES
    files: tuple[Path, ...] = ()
    ask: str = PLAIN

    def choose(
        self,
        part: str,
        questions: int,
        seed: int,
        checks: Sequence[TextCheck] = (),
        on_event: OnEvent = ignore,
    ) -> VQASet:
        """Exactly `questions` questions."""
        return load_scenes(part, questions, seed, on_event=on_event).asked(self.ask)

    @property
    def sha256(self) -> dict[str, str]:
        """No digests, because rendered scenes have no files."""
        return {}

    @property
    def state(self) -> dict[str, Any]:
        """Empty, since nothing can change."""
        return {}


@dataclass(frozen=True)
class Listed:
    """Questions in files, read and checked; images are decoded on access.

    Attributes:
        name: the file's or folder's name.
        files: the files that hold the questions.
        entries: the valid questions, packed.
        skip_bad: whether bad questions are left out instead of raising an error.
        problems: the errors of the questions left out.
        ask: the template of a question's prompt, with {} for the question.
        on_event: hears how many images `state` has read.
    """

    name: str
    files: tuple[Path, ...]
    entries: Entries
    skip_bad: bool
    problems: tuple[AegisError, ...] = ()
    ask: str = PLAIN
    on_event: OnEvent = field(default=ignore, repr=False, compare=False)

    @property
    def skipped(self) -> int:
        """The number of questions left out."""
        return len(self.problems)

    def choose(
        self,
        part: str,
        questions: int,
        seed: int,
        checks: Sequence[TextCheck] = (),
        on_event: OnEvent = ignore,
    ) -> VQASet:
        """Up to `questions` questions of one part, with those of an image adjacent.

        A hash of the image's name determines its part, whatever the seed, so a probe never uses
        what an anchor was measured on. A hash of seed and name determines the order of the part's
        images, so a shorter set's images are among a longer one's.

        Raises:
            AegisError: no question is usable, or, without `skip_bad`, a check refuses one.
        """
        mine = [key for key in self.entries.images if self.holds(part, key)]
        mine.sort(key=lambda key: digest_of(f"{seed} {key}"))
        most = min(questions, sum(map(self.entries.count, mine)))
        kept: list[list[Entry]] = []
        count, skipped = 0, self.skipped
        for key in mine:
            wanted = self.entries.about(key, questions - count)
            # Only the needed ones are checked: decoding every image would take hours.
            sound = self._sound(wanted, checks)
            skipped += len(wanted) - len(sound)
            if sound:
                kept.append(sound)
                count += len(sound)
                on_event(Progress("questions", count, most, "questions"))
            if count == questions:
                break
        if not kept:
            raise self._nothing(part, len(self.entries.images), skipped)
        if count < questions:  # some were left out, so the progress has not reached 100 %
            on_event(Progress("questions", count, count, "questions"))
        self._warn_of_shared(part, [own[0].picture for own in kept], on_event)
        return _assemble(kept, skipped).asked(self.ask)

    def holds(self, part: str, key: str) -> bool:
        """Whether an image belongs to a part."""
        return share(key) in PARTS[part]

    def _warn_of_shared(self, part: str, chosen: Sequence[Picture], on_event: OnEvent) -> None:
        """Warn of held-out images that are in an earlier part under another name."""
        earlier = _EARLIER[part]
        known = [k for k in self.entries.images if any(self.holds(of, k) for of in earlier)]
        learned = [self.entries.picture(key) for key in known]
        if found := equal_files.shared(chosen, learned, on_event):
            (one, other), *_ = found
            text = (
                f"{len(found)} of the {len(chosen)} images of '{self.name}' that are asked about "
                f"are also among those for anchors, training or tuning, byte for byte, under "
                f"another name: '{one.key}' is '{other.key}'. An anchor or a training on the same "
                "set has seen them. Name the same file in all questions about a picture"
            )
            on_event(Warned("questions", text))

    def _sound(self, entries: Sequence[Entry], checks: Sequence[TextCheck]) -> list[Entry]:
        """The questions about one image that can be asked.

        If bad questions are left out, the image's pixels are tried too, with each question.
        """
        image = None
        if self.skip_bad:
            try:
                # All entries are about this image.
                image = torch.from_numpy(decode(entries[0].picture, None))
            except AegisError:  # the caller counts the questions left out
                return []
        sound = []
        for entry in entries:
            text = self.ask.replace(PLAIN, entry.question.text)
            try:
                for check in checks:
                    check(text, entry.question.answer, image)
            except AegisError as error:
                if not self.skip_bad:
                    raise AegisError(
                        f"{entry.where}: {error.found}", error.expected, error.fix + OR_SKIP
                    ) from error
            else:
                sound.append(entry)
        return sound

    def _nothing(self, part: str, pictures: int, skipped: int) -> AegisError:
        found = (
            f"no usable question for the {part} among those of {pictures} images in '{self.name}'"
        )
        fix = "add questions about more images"
        if self.skip_bad:
            found += f" ({skipped} left out)"
            fix += ", or run without --skip-bad to see what is wrong"
        return AegisError(
            found,
            "one or more; a hash of its name assigns an image to anchors (4 of 10), studies "
            "(1 of 10) or probes (5 of 10)",
            fix,
        )

    @cached_property
    def sha256(self) -> dict[str, str]:
        """Digests of the files that hold the questions, by name."""
        return {f"vqa/{path.name}": sha256_file(path) for path in self.files}

    @cached_property
    def state(self) -> dict[str, Any]:
        """A value that changes if a question or an image does.

        It holds digests of the question files and of the image files. File times would change when
        a folder is copied, and everything would be trained again.
        """
        # Images stored in rows are part of the question files, whose digests are included anyway.
        sources = {key: self.entries.picture(key).source for key in self.entries.images}
        paths = {key: source for key, source in sources.items() if isinstance(source, Path)}
        digests: dict[str, str | None] = {}
        with ThreadPoolExecutor(worker_count(len(paths))) as pool:
            keys = list(paths)
            for first in range(0, len(keys), _AT_ONCE):
                some = keys[first : first + _AT_ONCE]
                digests |= zip(some, pool.map(_digest, map(paths.__getitem__, some)), strict=True)
                if len(paths) > _AT_ONCE:
                    self.on_event(Progress("checksums", len(digests), len(paths), "images"))
        return {"question_files": self.sha256, "image_files": sha256_value(digests)}


class EasyVqa(Listed):
    """easy-VQA, with its own split: only probes get its test images.

    A hash of the image's name assigns a tenth of the others to tuning studies, and the rest to
    anchors and training.
    """

    def holds(self, part: str, key: str) -> bool:
        if easy.is_test(key):
            return part == "probe"
        held_back = share(key) == 0
        return part == "validation" if held_back else part in ("anchor", "train")

    @cached_property
    def sha256(self) -> dict[str, str]:
        """Digests of the question files of both splits, which have the same name."""
        return {f"vqa/{easy.NAME}/{path.parent.name}": sha256_file(path) for path in self.files}

    @cached_property
    def state(self) -> dict[str, Any]:
        """The questions' digests; a given package version always has the same images."""
        return {"question_files": self.sha256}


def read(
    vqa: str, skip_bad: bool = False, on_event: OnEvent = ignore, ask: str = PLAIN
) -> Scenes | Listed:
    """Read the set that a name stands for, checking every question; no image is decoded yet.

    Args:
        ask: the template of a question's prompt, with {} for the question.

    Raises:
        AegisError: there is nothing of that name, a file cannot be read, or, without `skip_bad`, a
            question is bad.
    """
    if vqa == SCENES:
        return Scenes(ask=ask)
    source = easy.reader() if vqa == easy.NAME else _reader(*_located(vqa))
    entries = Entries()
    ids = Ids(entries)
    problems: list[AegisError] = []

    def on_read(done: int, total: int) -> None:
        # As many in the rest as in what is read, which is known only when all of it is.
        expected = max(round(len(entries) * total / done), len(entries) + 1)
        on_event(Progress("read", len(entries), expected, "questions"))

    for entry in source.read(on_event, on_read):
        problem = ids.add(entry) if isinstance(entry, Entry) else entry
        if isinstance(entry, Entry) and problem is None:
            entries.append(entry)
        elif problem is not None:
            if not skip_bad:
                source.check(on_event)  # a set that is unusable as a whole is refused for that
                raise problem
            # Without what was read around it, which would stay in memory.
            problems.append(problem.with_traceback(None))
    on_event(Progress("read", len(entries), len(entries), "questions"))
    if not entries:
        first = f": {len(problems)} are bad, the first: {problems[0].found}" if problems else ""
        raise AegisError(
            f"no usable question in '{vqa}'{first}",
            "one or more",
            "correct the file, or name another set",
        )
    kind = EasyVqa if vqa == easy.NAME else Listed
    # The set's name does not depend on the working directory: `.` becomes the folder's name.
    name = os.path.basename(os.path.abspath(vqa)).replace("#", "-")
    return kind(name, source.files, entries, skip_bad, tuple(problems), ask, on_event)


def _located(vqa: str) -> tuple[Path, str | None]:
    """The path of a set (for one on the hub, of its local copy), and the split after a #."""
    # A file's name may itself contain a #; if the file exists, it is meant.
    if os.path.exists(vqa):
        return Path(vqa), None
    name, _, split = vqa.rpartition("#") if "#" in vqa else (vqa, "", None)
    if name in (SCENES, easy.NAME):
        raise AegisError(f"the split '{split}' of '{name}'", "no split", f"--vqa {name}")
    if os.path.exists(name):
        return Path(name), split
    if hub.is_local(name):
        missing = f"question set '{name}', which does not exist"
        raise _unknown(missing, f"check the path, or use --vqa scenes{hub.not_asked(name)}")
    return download.fetch(name, split), split


def _reader(path: Path, split: str | None) -> Reader:
    """The reader for the path's format."""
    if split is not None and not saved.is_dataset(path):
        raise AegisError(
            f"the split '{split}' of '{path}', which is not a Hugging Face data set",
            "the path alone, for a set without splits",
            f"--vqa '{path}'",
        )
    pairs = sorted(path.glob(f"*{official.SUFFIX}")) if path.is_dir() else []
    if len(pairs) > 1:
        names = ", ".join(p.name for p in pairs)
        raise AegisError(
            f"{len(pairs)} questions files in '{path}': {names}", "one", f"--vqa {pairs[-1]}"
        )
    if path.is_file() and path.suffix == ".jsonl":
        return jsonl.reader(path)
    # Whatever its name: an official file is never a list.
    if path.is_file() and path.suffix == ".json" and jsonl.is_list(path):
        return jsonl.reader(path)
    # Before other .json files, and before folders with parquet files beside the pair.
    if pairs or (path.is_file() and path.name.endswith(official.SUFFIX)):
        return official.reader(pairs[0] if pairs else path)
    if saved.is_dataset(path):
        return saved.reader(path, split)
    if path.is_file() and path.suffix == ".json":
        raise official.misnamed(path)
    raise _unknown(f"question set '{path}'")


def is_file(path: Path) -> bool:
    """Whether a file has the name of a questions file, or is a list in JSON."""
    if not path.is_file():
        return False
    if path.suffix in (".jsonl", ".parquet") or path.name.endswith(official.SUFFIX):
        return True
    return path.suffix == ".json" and jsonl.is_list(path)


def is_folder(path: Path) -> bool:
    """Whether a folder looks like a set of questions."""
    return any(path.glob(f"*{official.SUFFIX}")) or saved.is_dataset(path)


def _unknown(found: str, fix: str = "check the path, or use --vqa scenes") -> AegisError:
    expected = (
        "'scenes', 'easy-vqa', a .jsonl file, a list in a .json file, the questions file of VQAv2 "
        "or OK-VQA, a folder of a Hugging Face data set, or its id on the hub"
    )
    return AegisError(found, expected, fix)


def _digest(image: Path) -> str | None:
    """sha256 of a file; None if it cannot be read, which is reported when the image is used."""
    try:
        return sha256_file(image)
    except AegisError:
        return None


def share(key: str) -> int:
    """The tenth, from 0 to 9, that an image belongs to."""
    return int(digest_of(key)[:12], 16) % 10


def _assemble(kept: Iterable[Sequence[Entry]], skipped: int) -> VQASet:
    """The set of these questions, which are grouped by image."""
    groups = list(kept)
    image_of = np.repeat(np.arange(len(groups)), [len(group) for group in groups])  # [M]
    questions = tuple(entry.question for entry in chain.from_iterable(groups))
    return VQASet(Pictures([group[0].picture for group in groups]), image_of, questions, skipped)
