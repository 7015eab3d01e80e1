"""Sets of rendered scenes and their questions, packed for pre-training or one by one."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from aegis_cli.common import gl
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Progress, ignore
from aegis_cli.common.limits import MOST_MADE
from aegis_cli.common.processes import mapped
from aegis_cli.data.vqa.questions import FAMILIES, Balancer, Question, cell_labels

if TYPE_CHECKING:  # a process that renders scenes needs neither torch nor Pillow
    from aegis_cli.data.vqa.images import Pictures

# Questions of each family per training scene, if the scene admits as many.
TRAINING_MIX: dict[str, int] = {
    "color": 2,
    "shape": 2,
    "count": 1,
    "count-kind": 1,
    "exists": 2,
    "side": 1,
    "where": 2,
}
_CHUNK = 250  # scenes a worker renders at a time


def digest_of(text: str) -> str:
    """sha256 of a text such as an image's name, which need not be valid UTF-8.

    Python represents invalid bytes by surrogates.
    """
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


@dataclass(frozen=True)
class VQASet:
    """Questions about images; `image_of[i]` is the image that `questions[i]` asks about.

    Attributes:
        images: [N, 64, 64, 3] uint8 of scenes, or images of files that are decoded when they are
            indexed.
        image_of: [M] int64.
        questions: M questions.
        skipped: bad questions that were left out.
    """

    images: np.ndarray | Pictures
    image_of: np.ndarray
    questions: tuple[Question, ...]
    skipped: int = 0

    @property
    def names(self) -> list[str] | None:
        """A digest of each image's name; None for scenes, which each seed draws anew."""
        if isinstance(self.images, np.ndarray):
            return None
        return [digest_of(picture.key)[:10] for picture in self.images.pictures]

    def sized(self, size: int | None) -> VQASet:
        """The same set for a backbone that needs images of `size` pixels per side.

        Rendered images keep their own size.
        """
        if isinstance(self.images, np.ndarray):
            return self
        return replace(self, images=self.images.sized(size))

    def asked(self, ask: str) -> VQASet:
        """The same set with each question inserted at the {} in `ask`."""
        if ask == "{}":
            return self
        questions = (replace(q, text=ask.replace("{}", q.text)) for q in self.questions)
        return replace(self, questions=tuple(questions))

    def part(self, rows: slice | Sequence[int]) -> VQASet:
        """The same images with some of the questions, by a slice or by their numbers."""
        if isinstance(rows, slice):
            chosen = self.questions[rows]
        else:
            chosen = tuple(self.questions[row] for row in rows)
        return replace(self, image_of=self.image_of[rows], questions=chosen)

    def batches(self, size: int) -> Iterator[tuple[np.ndarray | list[np.ndarray], list[Question]]]:
        """Images [B, H, W, 3] and their questions, `size` pairs at a time.

        Images that keep their own sizes are returned as a list.
        """
        for start in range(0, len(self.questions), size):
            rows = slice(start, start + size)
            yield self.images[self.image_of[rows]], list(self.questions[rows])


class Rendered(NamedTuple):
    """Scenes as arrays, and their questions.

    `images` is [N, 64, 64, 3] uint8, and `cells` [N, 64] uint8 has what is in each grid cell.
    """

    images: np.ndarray
    cells: np.ndarray
    questions: list[list[Question]]


def render_training(
    seed: int, scenes: int, workers: int = 2, on_event: OnEvent = ignore
) -> Rendered:
    """`scenes` training scenes with up to `sum(TRAINING_MIX.values())` questions each.

    Raises:
        AegisError: more are requested than can be drawn.
    """
    _check_count(scenes, "scenes")
    gl.check()
    # Chunks of equal size, whatever the number of workers: answers are balanced within a chunk.
    jobs = [
        (seed, "train", start, min(_CHUNK, scenes - start), TRAINING_MIX)
        for start in range(0, scenes, _CHUNK)
    ]
    images = np.empty((scenes, 64, 64, 3), np.uint8)
    cells = np.empty((scenes, 64), np.uint8)
    questions: list[list[Question]] = []
    for (_, _, start, count, _), part in zip(jobs, _map(jobs, workers), strict=True):
        images[start : start + count], cells[start : start + count] = part.images, part.cells
        questions += part.questions
        on_event(Progress("render", start + count, scenes, "scenes"))
    return Rendered(images, cells, questions)


def load_scenes(
    split: str, questions: int, seed: int = 0, workers: int = 2, on_event: OnEvent = ignore
) -> VQASet:
    """A set of `questions` questions of one split, with the seven families in equal shares.

    A scene is asked at most one question of each family. The first scenes that fill the quotas are
    used: a shorter set's scenes are among a longer one's, in the same order.

    Raises:
        AegisError: more are requested than can be drawn.
    """
    _check_count(questions, "questions about scenes")
    gl.check()
    quota = {family: questions // len(FAMILIES) for family in FAMILIES}
    for family in FAMILIES[: questions % len(FAMILIES)]:
        quota[family] += 1
    missing = Counter(quota)  # remaining questions of each family
    images: list[np.ndarray] = []
    image_of: list[int] = []
    kept: list[Question] = []
    mix = dict.fromkeys(FAMILIES, 1)
    start = 0
    chunk = min(_CHUNK, max(8, questions // 10))  # a small set starts no worker process
    while missing.total():
        at_once = workers if chunk == _CHUNK else 1
        jobs = [(seed, split, start + i * chunk, chunk, mix) for i in range(at_once)]
        start += len(jobs) * chunk
        for part in _map(jobs, workers):
            for image, scene_questions in zip(part.images, part.questions, strict=True):
                wanted = [q for q in scene_questions if missing[q.family] > 0]
                if wanted:  # at most one of each family, so no quota is exceeded
                    missing.subtract(q.family for q in wanted)
                    image_of += [len(images)] * len(wanted)
                    images.append(image)
                    kept += wanted
        on_event(Progress("render", questions - missing.total(), questions, "questions"))
    return VQASet(np.stack(images), np.array(image_of), tuple(kept))


def _check_count(count: int, what: str) -> None:
    """Raise AegisError for a number that would take forever to draw."""
    if count > MOST_MADE:
        raise AegisError(f"{count:,} {what}", f"at most {MOST_MADE:,}", "ask for fewer")


_Job = tuple[int, str, int, int, dict[str, int]]


def _map(jobs: Sequence[_Job], workers: int) -> Iterator[Rendered]:
    with mapped(
        _render_chunk,
        jobs,
        min(workers, len(jobs)),
        "a rendering process",
        "free some memory, then run it again",
    ) as parts:
        yield from parts


def _render_chunk(job: _Job) -> Rendered:
    """Scenes start .. start + count of a split.

    Answers are balanced within the chunk, so workers need no shared state.
    """
    from aegis_cli.data.vqa.scenes import renderer_of_thread, scene_rng  # loads OpenGL

    seed, split, start, count, mix = job
    renderer, balancer = renderer_of_thread(), Balancer()
    images, cells, questions = [], [], []
    for index in range(start, start + count):
        rng = scene_rng(seed, split, index)
        scene = renderer.render(rng)
        images.append(scene.image)
        cells.append(cell_labels(scene))
        asked = []
        for family, count_of_family in mix.items():
            asked += balancer.choose(scene, family, count_of_family, rng)
        questions.append(asked)
    return Rendered(np.stack(images), np.stack(cells), questions)
