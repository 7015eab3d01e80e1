"""Seven families of questions about a scene, with answers balanced within each family."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from aegis_cli.common.palette import COLORS
from aegis_cli.data.vqa.answers import normalise
from aegis_cli.data.vqa.things import IMAGE_SIZE, SHAPES, Scene, Thing

FAMILIES: tuple[str, ...] = ("color", "shape", "count", "count-kind", "exists", "side", "where")
GRID = 8  # location words: x0..x7 from left to right, y0..y7 from top to bottom
NUMBERS: tuple[str, ...] = ("zero", "one", "two", "three", "four")
X_WORDS: tuple[str, ...] = tuple(f"x{i}" for i in range(GRID))
Y_WORDS: tuple[str, ...] = tuple(f"y{i}" for i in range(GRID))
_MIN_SIDE_GAP_PX = 6.0

# As in instructions to a robot, "target" and "pad" name any thing, and "point to" asks where it is.
_NOUNS = ("object", "thing", "target", "pad")
_WHERE = (
    "where is the {}",
    "point to the {}",
    "find the {}",
    "locate the {}",
    "go to the {}",
    "move to the {}",
    "touch the {}",
    "reach the {}",
)
# Words of robot instructions that do not occur in the questions.
INSTRUCTION_WORDS: tuple[str, ...] = tuple(
    (
        "move go push drive bring put slide steer guide touch reach point finger ball mass arm tip "
        "to the at on onto into over a it"
    ).split()
)


@dataclass(frozen=True, slots=True)
class Question:
    """A question, its reference answer, and people's answers.

    Attributes:
        text, answer: for a scene, lower-case words separated by single spaces.
        answers: people's answers, of which `answer` is the most common; () if the answer is
            computed and has to match word for word.
        id: the set's own name for the question.
    """

    family: str
    text: str
    answer: str
    answers: tuple[str, ...] = ()
    id: str | int | None = None

    def compared(self, answer: str) -> str:
        """An answer in the form that is compared; people's answers are normalised."""
        return normalise(answer) if self.answers else answer

    def is_answered_by(self, said: str) -> bool:
        """Whether `said` is the reference answer."""
        return self.compared(said) == self.compared(self.answer)


def location_words(x_px: float, y_px: float) -> str:
    """The grid cell of a pixel position, as two words: `x3 y5`."""
    cell = IMAGE_SIZE / GRID
    return f"{X_WORDS[int(x_px // cell)]} {Y_WORDS[int(y_px // cell)]}"


def cell_labels(scene: Scene) -> np.ndarray:
    """What is in each cell of the grid, [64] uint8 row by row.

    0 is nothing; a thing is 1 + 3 color + shape.
    """
    labels = np.zeros((GRID, GRID), np.uint8)
    cell = IMAGE_SIZE / GRID
    for thing in scene.things:
        kind = 1 + len(SHAPES) * COLORS.index(thing.color) + SHAPES.index(thing.shape)
        labels[int(thing.y_px // cell), int(thing.x_px // cell)] = kind
    return labels.reshape(-1)


def vocabulary() -> tuple[str, ...]:
    """Every word that a question, an answer or an instruction may use, in a fixed order."""
    # The indices in this list are the tokens of pre-trained models: the order must not change.
    templates = " ".join((*_WHERE, *_COLOR, *_SHAPE, *_COUNT, *_EXISTS, *_SIDE)).replace("{}", "")
    plural = [f"{shape}s" for shape in SHAPES]
    words = (
        *COLORS,
        *SHAPES,
        *plural,
        *NUMBERS,
        *X_WORDS,
        *Y_WORDS,
        "yes",
        "no",
        "left",
        "right",
        *_NOUNS,
        *(f"{n}s" for n in _NOUNS),
        *templates.split(),
        *INSTRUCTION_WORDS,
    )
    return tuple(dict.fromkeys(words))


_COLOR = ("what color is the {}", "which color does the {} have", "what is the color of the {}")
_SHAPE = ("what shape is the {}", "which shape does the {} have", "what is the shape of the {}")
_COUNT = ("how many {} are there", "how many {} do you see", "count the {}")
_EXISTS = ("is there a {}", "do you see a {}")
_SIDE = ("is the {} left or right of the {}",)


def _names(thing: Thing, things: tuple[Thing, ...], hide: str = "") -> list[str]:
    """Noun phrases that fit only this thing, without the attribute that the question asks for."""
    same_color = sum(t.color == thing.color for t in things) == 1
    same_shape = sum(t.shape == thing.shape for t in things) == 1
    same_both = sum((t.color, t.shape) == (thing.color, thing.shape) for t in things) == 1
    names = []
    # A phrase may neither fit another thing nor give the answer away.
    if same_color and hide != "color":
        names += [f"{thing.color} {noun}" for noun in _NOUNS]
    if same_shape and hide != "shape":
        names.append(thing.shape)
    if same_both and not hide:
        names.append(f"{thing.color} {thing.shape}")
    if len(things) == 1:
        names += ["object", "target"]
    return names


def _pick(rng: np.random.Generator, options: tuple[str, ...] | list[str]) -> str:
    return options[rng.integers(len(options))]


def _ask_color(scene: Scene, rng: np.random.Generator) -> Iterator[Question]:
    for thing in scene.things:
        names = _names(thing, scene.things, hide="color")
        if names:
            yield Question("color", _pick(rng, _COLOR).format(_pick(rng, names)), thing.color)


def _ask_shape(scene: Scene, rng: np.random.Generator) -> Iterator[Question]:
    for thing in scene.things:
        names = _names(thing, scene.things, hide="shape")
        if names:
            yield Question("shape", _pick(rng, _SHAPE).format(_pick(rng, names)), thing.shape)


def _ask_count(scene: Scene, rng: np.random.Generator) -> Iterator[Question]:
    plural = _pick(rng, ("objects", "things"))
    # NUMBERS ends with the maximum number of things in a scene.
    yield Question("count", _pick(rng, _COUNT).format(plural), NUMBERS[len(scene.things)])


def _ask_count_kind(scene: Scene, rng: np.random.Generator) -> Iterator[Question]:
    colors = Counter(thing.color for thing in scene.things)
    shapes = Counter(thing.shape for thing in scene.things)
    numbers = {f"{color} objects": colors[color] for color in COLORS}
    numbers |= {f"{shape}s": shapes[shape] for shape in SHAPES}
    for kind, number in numbers.items():
        if number < len(NUMBERS) - 1:  # four of a kind is too rare to balance
            yield Question("count-kind", _pick(rng, _COUNT).format(kind), NUMBERS[number])


def _ask_exists(scene: Scene, rng: np.random.Generator) -> Iterator[Question]:
    # A dict, since the order of a set differs between processes.
    kinds = list(dict.fromkeys((t.color, t.shape) for t in scene.things))
    for color, shape in kinds:
        yield Question("exists", _pick(rng, _EXISTS).format(f"{color} {shape}"), "yes")
    # The hard "no": the colour or the shape occurs in the scene, but not their combination.
    with_its_color = _pick(rng, [t.color for t in scene.things]), _pick(rng, SHAPES)
    with_its_shape = _pick(rng, COLORS), _pick(rng, [t.shape for t in scene.things])
    for pair in (with_its_color, with_its_shape):
        if pair not in kinds:
            yield Question("exists", _pick(rng, _EXISTS).format(" ".join(pair)), "no")
    asked = _pick(rng, COLORS)
    present = any(t.color == asked for t in scene.things)
    text = _pick(rng, _EXISTS).format(f"{asked} object")
    yield Question("exists", text, "yes" if present else "no")


def _ask_side(scene: Scene, rng: np.random.Generator) -> Iterator[Question]:
    for one in scene.things:
        for other in scene.things:
            gap = one.x_px - other.x_px  # negative if `one` is on the left
            names, others = _names(one, scene.things), _names(other, scene.things)
            if one is not other and abs(gap) >= _MIN_SIDE_GAP_PX and names and others:
                text = _SIDE[0].format(_pick(rng, names), _pick(rng, others))
                yield Question("side", text, "left" if gap < 0 else "right")


def _ask_where(scene: Scene, rng: np.random.Generator) -> Iterator[Question]:
    for thing in scene.things:
        names = _names(thing, scene.things)
        if names:
            text = _pick(rng, _WHERE).format(_pick(rng, names))
            yield Question("where", text, location_words(thing.x_px, thing.y_px))


_ASK = {
    "color": _ask_color,
    "shape": _ask_shape,
    "count": _ask_count,
    "count-kind": _ask_count_kind,
    "exists": _ask_exists,
    "side": _ask_side,
    "where": _ask_where,
}


@dataclass
class Balancer:
    """Chooses, among the questions that a scene admits, those whose answers are rare so far.

    Each family's answers are counted separately.
    """

    asked: dict[str, Counter[str]] = field(
        default_factory=lambda: {family: Counter() for family in FAMILIES}
    )

    def choose(
        self, scene: Scene, family: str, count: int, rng: np.random.Generator
    ) -> list[Question]:
        """Up to `count` questions of one family; fewer if the scene admits fewer."""
        candidates = list(dict.fromkeys(_ASK[family](scene, rng)))  # equal questions once
        # `min` below takes the first of equally rare answers, which would favour the scene's order.
        rng.shuffle(candidates)  # type: ignore[arg-type]
        chosen = []
        while candidates and len(chosen) < count:
            best = min(candidates, key=lambda q: self.asked[family][q.answer])
            candidates.remove(best)
            self.asked[family][best.answer] += 1
            chosen.append(best)
        return chosen


def majority_share(questions: Iterable[Question]) -> float:
    """The accuracy of always giving a family's most common answer: the weak baseline."""
    answers: dict[str, Counter[str]] = {}
    for question in questions:
        answers.setdefault(question.family, Counter())[question.compared(question.answer)] += 1
    total = sum(counts.total() for counts in answers.values())
    commonest = sum(max(counts.values()) for counts in answers.values())
    return commonest / total
