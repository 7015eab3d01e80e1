"""`aegis pretrain`: an embedded VLM from scratch, on rendered scenes and optionally easy-VQA."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from aegis_cli.common import devices, locks
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, ignore
from aegis_cli.common.palette import COLORS
from aegis_cli.core.attention import KeyValue
from aegis_cli.data.vqa import easy, sets
from aegis_cli.data.vqa.dataset import TRAINING_MIX, Rendered, render_training
from aegis_cli.data.vqa.metrics import Graded, by_family, grade, score
from aegis_cli.data.vqa.packing import Packed, mirror, mirror_cells, mirror_words, pack
from aegis_cli.data.vqa.questions import GRID, SHAPES, Question, vocabulary
from aegis_cli.data.vqa.things import IMAGE_SIZE
from aegis_cli.data.vqa.words import wide_vocabulary
from aegis_cli.models import backbones
from aegis_cli.models.backbones.embedded import EmbeddedVLM, Shape
from aegis_cli.models.backbones.tokenizer import SPECIAL
from aegis_cli.pretraining import loop
from aegis_cli.recipes import PretrainRecipe, digest
from aegis_cli.training.schedule import BatchOrder

BLOCKS = sum(TRAINING_MIX.values())
BLOCK_TOKENS = 16
# The shorter half of an image's questions runs separately from the longer half, which saves
# padding.
SHARES = (slice(0, BLOCKS // 2), slice(BLOCKS // 2, BLOCKS))
EVALUATION_BATCH = 200
VALIDATION_QUESTIONS = 700
# Besides the answers, the image tokens of the middle layer learn what is in their cell (detection
# pre-training). Otherwise the model needs a thousand steps to discover that the picture matters.
# The head for it is not part of the model.
CELL_KINDS = 1 + len(COLORS) * len(SHAPES)
CELL_LOSS = 0.5
EMPTY_CELL_WEIGHT = 0.1
# The label of a cell with unknown content; it adds nothing to the loss.
UNKNOWN_CELL = 255


@dataclass(frozen=True)
class Scores:
    """How well the finished model answers probe questions.

    Accuracies are fractions in [0, 1], overall and by family; the cross-entropy is in nats per
    answer.
    """

    accuracy: float
    families: dict[str, float]
    cross_entropy: float
    questions: int


@dataclass(frozen=True)
class PretrainReport:
    """The result, measured on probe scenes that no training seed touches.

    Attributes:
        easy_vqa: the same for the test part of easy-VQA; None if the model was not trained on it.
    """

    accuracy: float
    families: dict[str, float]
    cross_entropy: float
    questions: int
    parameters: int
    steps: int
    out: str
    easy_vqa: Scores | None = None


@dataclass
class _VlmPretraining:
    """Everything that the loop needs, built once."""

    recipe: PretrainRecipe
    model: EmbeddedVLM
    cell_head: nn.Linear
    optimizers: list[torch.optim.Optimizer]
    images: np.ndarray
    cells: np.ndarray
    packed: Packed
    order: BatchOrder
    easy_order: BatchOrder | None
    words: tuple[np.ndarray, np.ndarray]

    def rows(self, step: int) -> np.ndarray:
        """The picture indices of a step: scenes, then easy-VQA, which comes after all scenes."""
        scenes = self.order.rows(step)
        if self.easy_order is None:
            return scenes
        return np.concatenate([scenes, self.recipe.scenes + self.easy_order.rows(step)])

    @property
    def parameters(self) -> dict[str, nn.Parameter]:
        return dict(self.model.named_parameters()) | {
            f"cell_head.{n}": p for n, p in self.cell_head.named_parameters()
        }


def run(
    recipe: PretrainRecipe, out: Path, resume: bool = False, on_event: OnEvent = ignore
) -> PretrainReport:
    """Train on `recipe.scenes` scenes, write `out/model.safetensors` with its provenance.

    Raises:
        AegisError: `out` holds an earlier run and `resume` is off, or its state belongs to another
            recipe.
    """
    out = Path(out)
    with locks.alone(out):
        path = loop.begin(recipe, out, resume)
        run = _build(recipe, on_event)

        def validate() -> dict[str, float]:
            found = {}
            for name in _sets_of(recipe):
                graded = _grade(run.model, recipe, name, "validation", VALIDATION_QUESTIONS)
                found["validation" if name == sets.SCENES else name] = score(graded).accuracy
            return found

        loop.train(run, path, lambda step: _loss_of(run, step), on_event, validate)
        return _finish(run, out, on_event)


def _build(recipe: PretrainRecipe, on_event: OnEvent) -> _VlmPretraining:
    easy_pictures = easy_training() if recipe.easy_vqa else None
    torch.manual_seed(recipe.seed)
    model = _begin(recipe).to(devices.pick())
    if recipe.compile:
        model.image_pass = torch.compile(model.image_pass)  # type: ignore[method-assign]
        model.text_pass = torch.compile(model.text_pass)  # type: ignore[method-assign]
    head = nn.Linear(model.width, CELL_KINDS).to(model.device)
    pictures = render_training(recipe.seed, recipe.scenes, on_event=on_event)
    easy_order = None
    if easy_pictures is not None:
        easy_order = BatchOrder(len(easy_pictures.images), recipe.easy_vqa, recipe.seed)
        pictures = _joined(pictures, easy_pictures)
    matrices = [p for p in model.layers.parameters() if p.ndim == 2]
    optimizers = loop.optimizers(matrices, [*model.parameters(), *head.parameters()], recipe)
    return _VlmPretraining(
        recipe,
        model,
        head,
        optimizers,
        pictures.images,
        pictures.cells,
        pack(pictures.questions, model.tokenizer.encode, BLOCKS, BLOCK_TOKENS),
        BatchOrder(recipe.scenes, recipe.batch_size, recipe.seed),
        easy_order,
        mirror_words(model.tokenizer.vocabulary),
    )


def _begin(recipe: PretrainRecipe) -> EmbeddedVLM:
    """The model before its first step; words that `recipe.start` lacks are initialised randomly.

    Raises:
        AegisError: the start is not an embedded VLM, or has another shape.
    """
    words = (*SPECIAL, *(wide_vocabulary() if recipe.easy_vqa else vocabulary()))
    model = EmbeddedVLM(Shape(recipe.model.width, recipe.model.depth, recipe.model.heads), words)
    if recipe.start is None:
        return model
    start = backbones.load(recipe.start)
    if not isinstance(start, EmbeddedVLM) or start.shape != model.shape:
        raise AegisError(
            f"start: {recipe.start}",
            "an embedded VLM of the recipe's width, depth and heads",
            "correct start, or the section model",
        )
    known = {word: row for row, word in enumerate(start.tokenizer.vocabulary)}
    state = start.state_dict()
    table = model.words.weight.detach().clone()
    for row, word in enumerate(words):
        if word in known:
            table[row] = state["words.weight"][known[word]]
    model.load_state_dict({**state, "words.weight": table})
    return model


def easy_training() -> Rendered:
    """easy-VQA's training pictures, with unknown cells.

    A picture with more questions than fit in a row appears several times, each with a part of them.

    Raises:
        AegisError: the package with the questions is missing.
    """
    source = sets.read(easy.NAME)
    assert isinstance(source, sets.Listed)
    asked = source.choose("train", len(source.entries), seed=0).sized(IMAGE_SIZE)
    questions_of: dict[int, list[Question]] = {}
    for image, question in zip(asked.image_of.tolist(), asked.questions, strict=True):
        questions_of.setdefault(image, []).append(question)
    rows, questions = [], []
    for image, of_image in questions_of.items():
        parts = -(-len(of_image) // BLOCKS)
        rows += [image] * parts
        questions += [of_image[part::parts] for part in range(parts)]
    images = asked.images[np.array(rows)]
    assert isinstance(images, np.ndarray)  # all have been resized to one size
    cells = np.full((len(rows), GRID * GRID), UNKNOWN_CELL, np.uint8)
    return Rendered(images, cells, questions)


def _joined(first: Rendered, second: Rendered) -> Rendered:
    return Rendered(
        np.concatenate([first.images, second.images]),
        np.concatenate([first.cells, second.cells]),
        [*first.questions, *second.questions],
    )


def _loss_of(run: _VlmPretraining, step: int) -> Tensor:
    rows = run.rows(step)
    flip = np.random.default_rng([run.recipe.seed, step]).random(len(rows)) < 0.5
    return _loss(run, rows, flip)


def _loss(run: _VlmPretraining, rows: np.ndarray, flip: np.ndarray) -> Tensor:
    """Cross-entropy in nats per token over the answers of all blocks, plus the weighted cell loss.

    The image is encoded once for all its blocks.
    """
    model = run.model
    images = run.images[rows]
    shares = [run.packed.blocks(rows, share) for share in SHARES]
    turned = [mirror(images, blocks, length, flip, run.words) for blocks, length in shares]
    with devices.autocast(model.device, run.recipe.precision):
        hidden, image = model.image_pass(model.pixels(torch.from_numpy(turned[0][0])))
        kinds = run.cell_head(hidden[model.depth // 2 - 1]).flatten(0, 1).float()
        parts = [
            _answer_loss(
                model,
                torch.from_numpy(blocks).to(model.device),
                torch.from_numpy(length).to(model.device),
                image,
            )
            for (_, blocks), (_, length) in zip(turned, shares, strict=True)
        ]
    cells = torch.from_numpy(mirror_cells(run.cells[rows], flip)).to(model.device).flatten().long()
    weight = torch.ones(CELL_KINDS, device=model.device)
    weight[0] = EMPTY_CELL_WEIGHT
    answers = torch.stack([total for total, _ in parts]).sum() / sum(count for _, count in parts)
    in_cells = F.cross_entropy(kinds, cells, weight=weight, ignore_index=UNKNOWN_CELL)
    # A model that starts from learned weights already knows that the picture matters.
    share = CELL_LOSS if run.recipe.start is None else 0.0
    return answers + share * in_cells


def _answer_loss(
    model: EmbeddedVLM, ids: Tensor, prompt_length: Tensor, image: list[KeyValue]
) -> tuple[Tensor, int]:
    """Summed cross-entropy of the answer tokens in blocks [B, N, S], and their number."""
    hidden, _ = model.text_pass(ids, prompt_length, image)
    following = ids[..., 1:]
    asked = prompt_length.unsqueeze(-1)
    position = torch.arange(following.shape[-1], device=ids.device)
    counts = (position >= asked - 1) & (following != model.tokenizer.pad) & (asked > 0)
    scores = model.logits(hidden[-1][..., :-1, :][counts])
    return F.cross_entropy(scores, following[counts], reduction="sum"), int(counts.sum())


def _finish(run: _VlmPretraining, out: Path, on_event: OnEvent) -> PretrainReport:
    """Round the weights to their shipped precision, grade them on probe questions, write them."""
    recipe, model = run.recipe, run.model.eval()
    model.load_state_dict({name: t.bfloat16().float() for name, t in model.state_dict().items()})
    found = {}
    for name in _sets_of(recipe):
        graded = _grade(model, recipe, name, "probe", recipe.probe_questions, on_event)
        found[name] = _scores(graded)
    scenes = asdict(found.pop(sets.SCENES))
    provenance = {
        "recipe_sha256": digest(recipe),
        "seed": recipe.seed,
        "steps": recipe.steps,
        **scenes,
        **{name: asdict(scores) for name, scores in found.items()},
    }
    target = loop.save(model, out, provenance)
    count = sum(p.numel() for p in model.parameters())
    return PretrainReport(
        **scenes,
        parameters=count,
        steps=recipe.steps,
        out=str(target),
        easy_vqa=found.get(easy.NAME),
    )


def _sets_of(recipe: PretrainRecipe) -> tuple[str, ...]:
    """The question sets that the model is trained on."""
    return (sets.SCENES, easy.NAME) if recipe.easy_vqa else (sets.SCENES,)


def _scores(graded: list[Graded]) -> Scores:
    total = score(graded)
    families = {name: s.accuracy for name, s in by_family(graded).items()}
    return Scores(total.accuracy, families, total.cross_entropy, total.questions)


def _grade(
    model: EmbeddedVLM,
    recipe: PretrainRecipe,
    name: str,
    part: str,
    count: int,
    on_event: OnEvent = ignore,
) -> list[Graded]:
    """Answers to up to `count` questions of one part of a set, graded."""
    asked = sets.read(name).choose(part, count, seed=0, on_event=on_event)
    with torch.inference_mode(), devices.autocast(model.device, recipe.precision):
        return grade(
            model.answers,
            asked.sized(model.image_size),
            EVALUATION_BATCH,
            on_event,
        )
