"""The model card of an exported backbone: how it was trained, on what, and what to do next."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aegis_cli import recipes
from aegis_cli.common.version import __version__
from aegis_cli.core.ledger import Ledger
from aegis_cli.methods.base import Method
from aegis_cli.recipes import Recipe, RobotStreamRecipe
from aegis_cli.training import freezing

_PLACES = {"backbone", "base", "path", "paths", "start", "vqa"}  # keys of models and data

_CARD = """---
library_name: transformers
pipeline_tag: image-text-to-text
tags: [robotics, vision-language-action, aegis]
---

# {name}: {steps} steps of `{method}`

The vision-language model {model} as the backbone of a robot policy,
fine-tuned with Aegis {version}. It loads and is asked as the original is; the action expert that
reads it is in `expert.safetensors`, beside this folder.

## Method

`{method}`: {summary}. Options: `{options}`.
{steps} of {planned} steps, {batch} frames per step, seed {seed}; learning rate
{backbone_lr:g} for the backbone and {expert_lr:g} for the expert.{frozen}

## Data

{train} frames of demonstrations{task}{cameras}, {validation} more for validation.
No question was trained on{except_own}.
By sha256:

{inputs}

## Drift

{drift}
Accuracy on questions is not known here: it is what `aegis probe` measures, below.

## Commands

```sh
aegis train recipe.yaml --method {method} --demos DEMOS{anchor} --out RUN
aegis probe RUN --baseline {backbone}
aegis inspect RUN
```

```python
from transformers import AutoModelForImageTextToText, AutoProcessor
folder = "RUN/checkpoints/last/backbone"
model = AutoModelForImageTextToText.from_pretrained(folder)
processor = AutoProcessor.from_pretrained(folder)
```
"""


@dataclass(frozen=True)
class Data:
    """The demonstrations: their task and cameras, if they name any, and frames per split."""

    task: str | None
    cameras: Sequence[str]
    train: int
    validation: int


def text(
    recipe: Recipe,
    method: Method,
    steps: int,
    data: Data,
    inputs: Mapping[str, str],
    ledger: Ledger,
    began_as: str | None = None,
) -> str:
    """The card after `steps` steps; equal runs give equal cards.

    Args:
        inputs: sha256 of each of the run's inputs, by a name for it.
        ledger: with one row per step if the method reads the anchor.
        began_as: as in a policy's meta.
    """
    settings, options = recipe.train, recipes.options(recipe)
    asks = method.trains_on_questions(options)
    # A method that reads no anchor may still have been given one.
    read = {name: digest for name, digest in inputs.items() if name != "anchor" or method.needs}
    cameras = ", then ".join(f"`{camera}`" for camera in data.cameras)
    return _CARD.format(
        name=recipe.name,
        steps=steps,
        method=method.name,
        model=model(recipe, began_as),
        backbone=began_as or without_folders(recipe.backbone),
        version=__version__,
        summary=method.summary,
        options=json.dumps(without_places(options), sort_keys=True),
        planned=settings.steps,
        batch=settings.batch_size,
        backbone_lr=settings.backbone_lr,
        expert_lr=settings.expert_lr,
        frozen=freezing.sentence(settings.freeze, before="\n"),
        seed=recipe.seed,
        task="" if data.task is None else f" of `{data.task}`",
        train=data.train,
        validation=data.validation,
        cameras=f" seen by {cameras}" if cameras else "",
        except_own=", but for this method's own set" if asks else "",
        inputs="\n".join(f"- {name}: `{digest}`" for name, digest in sorted(read.items())),
        drift=_drift(ledger.tensors()),
        anchor=" --anchor ANCHOR" if "anchor" in read else "",
    )


def model(recipe: Recipe | RobotStreamRecipe, began_as: str | None) -> str:
    """How a card names the model that a run began with, which another run may have trained.

    Args:
        began_as: as in a policy's meta.
    """
    if began_as is None:
        return f"`{without_folders(recipe.backbone)}`"
    return f"`{began_as}` (which Aegis had fine-tuned before)"


def without_folders(name: str) -> str:
    """How a card names a model or a file of questions: without the folder that it lies in."""
    return Path(name).name if Path(name).is_absolute() else name


def without_places(value: Any, key: str = "") -> Any:
    """A recipe or a part of it, without the folders in which models, data and questions lie.

    Args:
        key: the key whose value it is.
    """
    if isinstance(value, Mapping):
        return {name: without_places(inner, name) for name, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [without_places(inner, key) for inner in value]
    return without_folders(value) if key in _PLACES and isinstance(value, str) else value


def _drift(ledger: Mapping[str, Any]) -> str:
    if not len(ledger["w2"]):
        return "This method does not measure how far the activations have moved."
    first, last = (float(ledger["w2"][i].mean()) for i in (0, -1))
    return (
        "Squared Wasserstein-2 distance between the activations on robot frames and the "
        "anchor's on questions,\n"
        f"mean over layers: {first:.4g} in the first step, {last:.4g} in the last."
    )
