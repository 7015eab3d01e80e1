"""The sections of a stream's recipe: each key with its default and what it may be."""

from __future__ import annotations

from dataclasses import dataclass

from aegis_cli.recipes.policy import (
    BELOW_ONE,
    COLOR_SETS,
    NORMALIZATIONS,
    NOT_EMPTY,
    NOT_NEGATIVE,
    POSITIVE,
    PRECISIONS,
    SEED,
    SHARE,
    UP_TO_ONE,
    choice,
)
from aegis_cli.recipes.strict_yaml import key

LEARNERS = (
    "zero-shot",
    "sequential",
    "sequential-lora",
    "isolated-lora",
    "moe-adapters",
    "prototype",
    "igsp",
)
ROBOT_LEARNERS = ("sequential", "isolated-lora", "igsp")  # of a stream of robot tasks
SPLITS = ("evaluation", "validation")  # of episodes and questions
PARTS = TEST, VALIDATION = "test", "validation"  # of a task's images, that accuracies are of


@dataclass(frozen=True)
class StreamTrain:
    method: str = key(choice(*LEARNERS), "igsp")
    steps: int = key(POSITIVE, 150)  # a task
    batch_size: int = key(POSITIVE, 64)
    lr: float = key(NOT_NEGATIVE, 2e-3)  # of experts
    router_lr: float = key(
        NOT_NEGATIVE, 5e-2
    )  # of routers and scales, whose logits have further to go
    warmup: int = key(NOT_NEGATIVE, 10)  # steps
    weight_decay: float = key(NOT_NEGATIVE, 0.01)  # not of routers and scales
    clip_norm: float = key(POSITIVE, 1.0)
    final_lr_share: float = key(UP_TO_ONE, 0.1)
    label_smoothing: float = key(BELOW_ONE, 0.2)
    checkpoint_every: int = key(POSITIVE, 100)  # steps, and after every task
    log_every: int = key(POSITIVE, 25)
    precision: str = key(
        choice(*PRECISIONS), "float32"
    )  # of training; evaluation is always in float32


@dataclass(frozen=True)
class RobotTrain:
    method: str = key(choice(*ROBOT_LEARNERS), "igsp")
    steps: int = key(POSITIVE, 400)  # a task
    batch_size: int = key(POSITIVE, 32)
    chunk: int = key(POSITIVE, 8)  # actions predicted at once
    flow_samples: int = key(POSITIVE, 8)  # flow times and noises an image
    lr: float = key(NOT_NEGATIVE, 2e-3)  # of low-rank experts
    router_lr: float = key(NOT_NEGATIVE, 5e-2)  # of routers and scales
    expert_lr: float = key(NOT_NEGATIVE, 1e-3)  # of the action expert's own weights
    warmup: int = key(NOT_NEGATIVE, 40)  # steps
    weight_decay: float = key(NOT_NEGATIVE, 0.01)  # not of routers and scales
    clip_norm: float = key(POSITIVE, 1.0)
    normalization: str = key(
        choice(*NORMALIZATIONS), "mean_std"
    )  # of each task's own positions and actions
    final_lr_share: float = key(UP_TO_ONE, 0.1)
    validation_share: float = key(SHARE, 0.05)  # of each task's episodes
    checkpoint_every: int = key(POSITIVE, 100)  # steps, and after every task
    log_every: int = key(POSITIVE, 25)
    precision: str = key(choice(*PRECISIONS), "auto")


@dataclass(frozen=True)
class RobotDemos:
    """Of each task of a stream."""

    episodes: int = key(POSITIVE, 300)
    noise: float = key(NOT_NEGATIVE, 0.3)
    seed: int = key(SEED, 0)
    paths: tuple[str, ...] | None = key(
        NOT_EMPTY, None
    )  # one a task, in their order, instead of recording


@dataclass(frozen=True)
class RobotRollout:
    """How success is measured after each task of a stream."""

    episodes: int = key(POSITIVE, 50)
    colors: str = key(choice(*COLOR_SETS), "seen")
    replan: int = key(POSITIVE, 4)  # actions executed before the next prediction
    split: str = key(
        choice(*SPLITS), "evaluation"
    )  # validation: other episodes and questions, to choose settings on


@dataclass(frozen=True)
class Inference:
    """Which task is an image of? A Gaussian a task over the bare encoder's early features."""

    rank: int = key(
        NOT_NEGATIVE, 16
    )  # directions with a variance of their own; all others share one
    shrinkage: float = key(
        UP_TO_ONE, 0.03
    )  # share of each variance that is replaced by the mean of all
    quantile: float = key(
        BELOW_ONE, 0.05
    )  # share of a task's own training images that count as no task's


@dataclass(frozen=True)
class Sequential:
    lr: float = key(NOT_NEGATIVE, 3e-4)  # of all weights, instead of train.lr


@dataclass(frozen=True)
class SequentialLora:
    rank: int = key(POSITIVE, 8)


@dataclass(frozen=True)
class IsolatedLora:
    rank: int = key(POSITIVE, 8)


@dataclass(frozen=True)
class MoeAdapters:
    rank: int = key(POSITIVE, 4)
    experts_per_task: int = key(POSITIVE, 2)  # the pool holds as many for each task of the stream
    top: int = key(POSITIVE, 2)  # experts an example uses, and that are frozen after a task
    router_lr: float = key(
        NOT_NEGATIVE, 2e-3
    )  # of its linear routers and scales, instead of train.router_lr


@dataclass(frozen=True)
class Prototype:
    rank: int = key(POSITIVE, 8)
    similarity: float = key(
        UP_TO_ONE, 0.9
    )  # cosine of mean features from which two tasks share their expert


@dataclass(frozen=True)
class Igsp:
    rank: int = key(POSITIVE, 4)
    candidates: int = key(POSITIVE, 2)  # new experts a task and map, before pruning
    history: float = key(SHARE, 0.2)  # routing mass that earlier tasks' experts begin with
    reuse: float = key(
        NOT_NEGATIVE, 0.1
    )  # weight of the share of new numbers asked for in phase 1; 0: an ablation
    norm: float = key(NOT_NEGATIVE, 0.01)  # weight of the new experts' squared norms in phase 1
    kappa: float = key(SHARE, 0.5)  # of the uniform weight, under which an expert may go
    load: float = key(
        SHARE, 0.1
    )  # of the summed p ||f||, under which an expert may go; both are needed
    identify: float = key(SHARE, 0.5)  # share of a task's steps that phase 1 takes at most
    tolerance: float = key(
        NOT_NEGATIVE, 0.03
    )  # total variation between checks under which routers stand still
    checks: int = key(POSITIVE, 3)  # on end, that they have to stand still
    check_every: int = key(POSITIVE, 10)  # steps
    prune: bool = True  # false: an ablation
    orthogonal: bool = False  # phase 2 off the columns of earlier tasks' experts


@dataclass(frozen=True)
class Towers:
    width: int = key(POSITIVE, 128)
    depth: int = key(POSITIVE, 3)  # of the image tower
    text_depth: int = key(POSITIVE, 2)
    heads: int = key(POSITIVE, 4)
