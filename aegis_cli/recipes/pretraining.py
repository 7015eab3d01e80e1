"""What `aegis pretrain` reads to make the embedded VLM."""

from __future__ import annotations

from dataclasses import dataclass

from aegis_cli.recipes.policy import (
    FOLDER_NAME,
    NOT_NEGATIVE,
    POSITIVE,
    PRECISIONS,
    SEED,
    Model,
    choice,
)
from aegis_cli.recipes.strict_yaml import key


@dataclass(frozen=True)
class PretrainRecipe:
    """What `aegis pretrain` reads."""

    name: str = key(FOLDER_NAME)
    seed: int = key(SEED, 0)
    scenes: int = key(POSITIVE, 50_000)
    probe_questions: int = key(POSITIVE, 7000)  # asked of the finished model
    steps: int = key(POSITIVE, 4000)
    batch_size: int = key(POSITIVE, 48)  # scenes, each with all its questions
    lr: float = key(NOT_NEGATIVE, 2e-3)
    warmup: int = key(NOT_NEGATIVE, 100)  # steps
    weight_decay: float = key(NOT_NEGATIVE, 0.02)
    precision: str = key(choice(*PRECISIONS), "bf16")
    compile: bool = False
    checkpoint_every: int = key(POSITIVE, 1000)
    model: Model = Model()
