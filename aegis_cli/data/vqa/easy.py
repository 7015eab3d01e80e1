"""easy-VQA: 48,248 questions about drawn shapes by another author, from its PyPI package.

The package has 4,000 images for training and 1,000 for tests, of 64 x 64 pixels with one shape
each. See https://github.com/vzhou842/easy-VQA (MIT).
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from importlib import metadata
from pathlib import Path

from aegis_cli.common.errors import AegisError
from aegis_cli.data.vqa.entries import Entry, Reader, make_question
from aegis_cli.data.vqa.images import Picture

NAME = "easy-vqa"
# Another version may have other questions, and no file would show it.
VERSION = "1.0"
FAMILIES: tuple[str, ...] = ("shape", "color", "exists", "exists-not")


def reader() -> Reader:
    """The package's questions.

    Raises:
        AegisError: the package is missing, or has another version.
    """
    fix = f"pip install 'aegis-vla[{NAME}]' (or {NAME}=={VERSION})"
    try:
        import easy_vqa

        found = metadata.version(NAME)
    except ImportError:
        raise AegisError("no package 'easy_vqa'", "easy-VQA's questions and images", fix) from None
    if found != VERSION:
        raise AegisError(f"{NAME} {found}", f"version {VERSION}", fix)
    folder = Path(easy_vqa.__file__).parent / "data"
    files = tuple(folder / split / "questions.json" for split in ("train", "test"))
    return Reader(lambda *_: iter(_entries()), files)


@cache  # reading them takes seconds, and a run is probed several times
def _entries() -> tuple[Entry, ...]:
    return tuple(_read())


def _read() -> Iterator[Entry]:
    import easy_vqa

    sources = {
        "train": (easy_vqa.get_train_questions, easy_vqa.get_train_image_paths),
        "test": (easy_vqa.get_test_questions, easy_vqa.get_test_image_paths),
    }
    for split, (questions, image_paths) in sources.items():
        paths = {image: Path(path) for image, path in image_paths().items()}
        # Both splits number their images from 0, so a key needs the split.
        for number, (text, answer, image) in enumerate(zip(*questions(), strict=True)):
            where = f"{NAME} {split}, question {number}"
            question = make_question(where, text, [answer], f"{split}-{number}", family(text))
            yield Entry(where, question, Picture(f"{split}/{image}", where, paths[image]))


def is_test(key: str) -> bool:
    """Whether an image belongs to easy-VQA's own test split."""
    return key.startswith("test/")


@cache  # 48,248 questions have 107 texts
def family(text: str) -> str:
    """What a question asks for: a shape, a color, or whether something is there or is not."""
    words = text.lower().rstrip("?").split()
    if words[0] != "what":
        return "exists-not" if {"not", "no"} & set(words) else "exists"
    # "what is the blue shape" asks for the shape, "what color is the shape" for the color.
    return "color" if "color" in words else "shape"
