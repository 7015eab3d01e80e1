"""The recipes of `aegis pretrain`, which trains the embedded models from scratch."""

from __future__ import annotations

from aegis_cli.data.streams.names import TASKS as STREAM_TASKS
from aegis_cli.recipes.keys import (
    FOLDER_NAME,
    MADE,
    NOT_EMPTY,
    NOT_NEGATIVE,
    POSITIVE,
    SEED,
    choice,
    key,
    section,
)
from aegis_cli.recipes.policy import PRECISIONS


@section
class Model:
    """The size of the embedded VLM."""

    width: int = key(POSITIVE, default=192, doc="Width of the layers; the heads divide it.")
    depth: int = key(POSITIVE, default=6, doc="Number of layers.")
    heads: int = key(POSITIVE, default=6, doc="Attention heads per layer.")


@section
class Towers:
    """The size of the embedded dual encoder's two towers."""

    width: int = key(
        POSITIVE, default=128, doc="Width of both towers' layers; the heads divide it."
    )
    depth: int = key(POSITIVE, default=3, doc="Number of layers of the image tower.")
    text_depth: int = key(POSITIVE, default=2, doc="Number of layers of the text tower.")
    heads: int = key(POSITIVE, default=4, doc="Attention heads per layer.")


@section
class PretrainRecipe:
    """Trains an embedded VLM on questions about drawn scenes, and about easy-VQA's pictures."""

    name: str = key(FOLDER_NAME, doc="Name of the run; it is written to runs/NAME.")
    seed: int = key(SEED, default=0, doc="Seed of the scenes, the weights and the training.")
    scenes: int = key(MADE, default=50_000, doc="Number of scenes that are trained on.")
    probe_questions: int = key(
        MADE, default=7000, doc="Number of questions that the finished model is asked."
    )
    start: str | None = key(
        NOT_EMPTY,
        default=None,
        doc="Embedded VLM whose weights it starts from, such as 'embedded'; words that it does not "
        "know start from random ones. Null trains from scratch.",
    )
    steps: int = key(POSITIVE, default=4000, doc="Optimizer steps.")
    batch_size: int = key(POSITIVE, default=48, doc="Scenes per step, each with all its questions.")
    easy_vqa: int = key(
        NOT_NEGATIVE,
        default=0,
        doc="Pictures of easy-VQA per step beside the scenes, each with its questions. Above 0 the "
        "model's vocabulary is the wide one: words of easy-VQA and of robot instructions too.",
    )
    lr: float = key(NOT_NEGATIVE, default=2e-3, doc="Peak learning rate.")
    warmup: int = key(
        NOT_NEGATIVE, default=100, doc="Steps over which the learning rate rises to its peak."
    )
    weight_decay: float = key(NOT_NEGATIVE, default=0.02, doc="AdamW's weight decay.")
    precision: str = key(choice(*PRECISIONS), default="bf16", doc="Number format of training.")
    compile: bool = key(default=False, doc="Compile the model with torch.compile.")
    checkpoint_every: int = key(POSITIVE, default=1000, doc="Steps between two checkpoints.")
    model: Model = Model()


@section
class DualRecipe:
    """Trains the embedded dual encoder on drawn pictures and their captions."""

    name: str = key(FOLDER_NAME, doc="Name of the run; it is written to runs/NAME.")
    seed: int = key(SEED, default=0, doc="Seed of the pictures, the weights and the training.")
    pictures: int = key(POSITIVE, default=60_000, doc="Number of pictures that are trained on.")
    tasks: tuple[str, ...] = key(
        choice(*STREAM_TASKS),
        default=tuple(STREAM_TASKS),
        doc="Tasks whose validation parts the finished model classifies.",
    )
    steps: int = key(POSITIVE, default=3000, doc="Optimizer steps.")
    batch_size: int = key(POSITIVE, default=256, doc="Pictures per step, each with one caption.")
    lr: float = key(NOT_NEGATIVE, default=2e-3, doc="Peak learning rate.")
    warmup: int = key(
        NOT_NEGATIVE, default=100, doc="Steps over which the learning rate rises to its peak."
    )
    weight_decay: float = key(NOT_NEGATIVE, default=0.02, doc="AdamW's weight decay.")
    precision: str = key(choice(*PRECISIONS), default="auto", doc="Number format of training.")
    checkpoint_every: int = key(POSITIVE, default=500, doc="Steps between two checkpoints.")
    towers: Towers = Towers()
