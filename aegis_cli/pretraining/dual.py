"""`aegis pretrain` for the embedded dual encoder: a contrastive loss on pictures and captions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from aegis_cli.common import devices, locks
from aegis_cli.common.events import OnEvent, ignore
from aegis_cli.data.streams import corpus, embedded
from aegis_cli.evaluation import zero_shot
from aegis_cli.models.backbones.embedded_dual import EmbeddedDual, Shape
from aegis_cli.models.backbones.tokenizer import SPECIAL
from aegis_cli.pretraining import loop
from aegis_cli.recipes import DualRecipe, digest
from aegis_cli.training.schedule import BatchOrder

VALIDATION_PICTURES = 1000  # held-out pictures of the corpus's own kinds, for retrieval figures


@dataclass(frozen=True)
class DualReport:
    """The result; all fractions are in [0, 1].

    Attributes:
        zero_shot: accuracy on the validation part of each stream task, by name.
        accuracy: mean of these accuracies.
        image_to_text: fraction of held-out pictures whose nearest caption is true.
        text_to_image: fraction of captions that are true of their nearest picture, among those that
            are true of any held-out picture.
    """

    zero_shot: dict[str, float]
    accuracy: float
    image_to_text: float
    text_to_image: float
    parameters: int
    steps: int
    out: str


@dataclass
class _DualPretraining:
    """Everything that the loop needs, built once."""

    recipe: DualRecipe
    model: EmbeddedDual
    optimizers: list[torch.optim.Optimizer]
    pictures: corpus.Corpus
    says: np.ndarray
    ids: Tensor  # [openings, captions, words]
    order: BatchOrder

    @property
    def parameters(self) -> dict[str, nn.Parameter]:
        return dict(self.model.named_parameters())


def run(
    recipe: DualRecipe, out: Path, resume: bool = False, on_event: OnEvent = ignore
) -> DualReport:
    """Train on `recipe.pictures` pictures, write `out/model.safetensors` with its provenance.

    Raises:
        AegisError: `out` holds an earlier run and `resume` is off, or its state belongs to another
            recipe.
    """
    out = Path(out)
    with locks.alone(out):
        path = loop.begin(recipe, out, resume)
        run = _build(recipe, on_event)
        loop.train(run, path, lambda step: _loss_of(run, step), on_event)
        return _finish(run, out, on_event)


def _build(recipe: DualRecipe, on_event: OnEvent) -> _DualPretraining:
    pictures = corpus.render(recipe.seed, recipe.pictures, on_event=on_event)
    torch.manual_seed(recipe.seed)
    tower = recipe.towers
    shape = Shape(tower.width, tower.depth, tower.text_depth, tower.heads)
    model = EmbeddedDual(shape, (*SPECIAL, *corpus.vocabulary())).to(devices.pick())
    said = corpus.captions()
    texts = [opening + text for opening in corpus.OPENINGS for text in said.texts]
    ids = model.ids(texts).view(len(corpus.OPENINGS), len(said.texts), -1)
    order = BatchOrder(recipe.pictures, recipe.batch_size, recipe.seed)
    # Muon is for matrices between hidden states, which embeddings and the stem are not.
    inside = [*model.image.layers.parameters(), *model.text.layers.parameters()]
    matrices = [parameter for parameter in inside if parameter.ndim == 2]
    optimizers = loop.optimizers(matrices, list(model.parameters()), recipe)
    return _DualPretraining(recipe, model, optimizers, pictures, said.says, ids, order)


def _loss_of(run: _DualPretraining, step: int) -> Tensor:
    return _loss(run, run.order.rows(step), np.random.default_rng([run.recipe.seed, step]))


def _loss(run: _DualPretraining, rows: np.ndarray, rng: np.random.Generator) -> Tensor:
    """The loss of one batch, with one random caption for each picture.

    Each caption is compared with every picture in the batch.
    """
    model, facts = run.model, run.pictures.facts[rows]
    true = corpus.true_of(run.says, facts)  # [B, captions]
    drawn = np.array([rng.choice(np.flatnonzero(row)) for row in true])
    # A caption that was drawn for several pictures is one column with several positives.
    chosen = np.unique(drawn)
    openings = rng.integers(len(run.ids), size=len(chosen))
    ids = run.ids[openings, chosen]  # [N, words]
    positive = torch.from_numpy(corpus.true_of(run.says[chosen], facts)).to(model.device)
    pictures = torch.from_numpy(run.pictures.images[rows])
    with devices.autocast(model.device, run.recipe.precision):
        images = model.image_features(model.pixels(pictures))  # [B, D]
        texts = model.id_features(ids)  # [N, D]
    return contrastive(model.scale() * images @ texts.T, positive)


def contrastive(logits: Tensor, positive: Tensor) -> Tensor:
    """CLIP's symmetric loss (arXiv 2103.00020) with possibly several true captions per picture.

    A caption may also be true of several pictures. The target of a row or column is uniform over
    its positives, as in UniCL (arXiv 2204.03610), so a true caption is never a negative, even if it
    was drawn for another picture in the batch.

    Args:
        logits: [B, N], scaled cosines of pictures and captions.
        positive: [B, N] bool, at least one in each row and column.
    """
    target = positive.float()
    to_text = F.cross_entropy(logits, target / target.sum(1, keepdim=True))
    to_image = F.cross_entropy(logits.T, target.T / target.T.sum(1, keepdim=True))
    return (to_text + to_image) / 2


def _finish(run: _DualPretraining, out: Path, on_event: OnEvent) -> DualReport:
    """Round the weights to the shipped precision, measure them, write them with provenance."""
    recipe, model = run.recipe, run.model.eval()
    model.load_state_dict({name: t.bfloat16().float() for name, t in model.state_dict().items()})
    found: dict[str, float] = {}
    for name in recipe.tasks:
        task = embedded.task(name, model.image_size, out / "stream", on_event)
        found[name] = zero_shot.accuracy(model, task, task.validation)
    mean, (to_text, to_image) = sum(found.values()) / len(found), _retrieval(run, on_event)
    provenance = {
        "recipe_sha256": digest(recipe),
        "seed": recipe.seed,
        "steps": recipe.steps,
        "zero_shot": found,
        "accuracy": mean,
        "image_to_text": to_text,
        "text_to_image": to_image,
    }
    target = loop.save(model, out, provenance)
    count = sum(p.numel() for p in model.parameters())
    return DualReport(found, mean, to_text, to_image, count, recipe.steps, str(target))


@torch.inference_mode()
def _retrieval(run: _DualPretraining, on_event: OnEvent) -> tuple[float, float]:
    """Fractions of correct retrievals, from pictures to captions and back.

    Retrieved are the nearest caption of each held-out picture, and the nearest picture of each
    caption that is true of any.
    """
    pictures = corpus.render(run.recipe.seed, VALIDATION_PICTURES, "validation", on_event)
    model, true = run.model, torch.from_numpy(corpus.true_of(run.says, pictures.facts))
    parts = torch.from_numpy(pictures.images).split(zero_shot.BATCH)
    images = torch.cat([model.image_features(model.pixels(part)) for part in parts])
    captions = model.id_features(run.ids[0])  # those without an opening
    cosines = (images @ captions.T).cpu()  # [pictures, captions]
    nearest_caption = cosines.argmax(1, keepdim=True)
    nearest_picture = cosines.argmax(0, keepdim=True)
    asked = true.any(0)  # a caption that is true of no picture has no correct answer
    to_text = true.gather(1, nearest_caption).float().mean()
    to_image = true.gather(0, nearest_picture)[0, asked].float().mean()
    return float(to_text), float(to_image)
