"""Recipes of streams of tasks, and of the dual encoder that learns them; `reader.load_training`
reads them.
"""

from __future__ import annotations

from dataclasses import dataclass

from aegis_cli.data.streams.names import TASKS as STREAM_TASKS
from aegis_cli.recipes.policy import (
    FOLDER_NAME,
    NOT_EMPTY,
    NOT_NEGATIVE,
    POSITIVE,
    PRECISIONS,
    SEED,
    TASK,
    Expert,
    Probe,
    choice,
)
from aegis_cli.recipes.streams import (
    PARTS,
    TEST,
    Igsp,
    Inference,
    IsolatedLora,
    MoeAdapters,
    Prototype,
    RobotDemos,
    RobotRollout,
    RobotTrain,
    Sequential,
    SequentialLora,
    StreamTrain,
    Towers,
)
from aegis_cli.recipes.strict_yaml import key


@dataclass(frozen=True)
class StreamRecipe:
    """What `aegis train` reads to learn a stream of classification tasks one after the other."""

    name: str = key(FOLDER_NAME)
    stream: str = key(NOT_EMPTY)
    path: str | None = key(NOT_EMPTY, None)  # of image folders: TASK/{train,test}/CLASS/IMAGE
    order: tuple[str, ...] | None = key(
        NOT_EMPTY, None
    )  # tasks of the stream as they come; without it, all in its own order
    encoder: str = key(NOT_EMPTY, "embedded-dual")
    seed: int = key(SEED, 0)
    split: str = key(
        choice(*PARTS), TEST
    )  # that accuracies are of; validation: to choose settings on
    train: StreamTrain = StreamTrain()
    inference: Inference = Inference()
    sequential: Sequential = Sequential()
    sequential_lora: SequentialLora = SequentialLora()
    isolated_lora: IsolatedLora = IsolatedLora()
    moe_adapters: MoeAdapters = MoeAdapters()
    prototype: Prototype = Prototype()
    igsp: Igsp = Igsp()


@dataclass(frozen=True)
class RobotStreamRecipe:
    """What `aegis train` reads to let a policy learn several robot tasks one after the other."""

    name: str = key(FOLDER_NAME)
    tasks: tuple[str, ...] = key(TASK)
    backbone: str = key(NOT_EMPTY, "embedded")
    seed: int = key(SEED, 0)
    demos: RobotDemos = RobotDemos()
    train: RobotTrain = RobotTrain()
    expert: Expert = Expert()
    rollout: RobotRollout = RobotRollout()
    probe: Probe = Probe()
    sequential: Sequential = Sequential()
    isolated_lora: IsolatedLora = IsolatedLora()
    igsp: Igsp = Igsp()


@dataclass(frozen=True)
class DualRecipe:
    """What `aegis pretrain` reads for the embedded dual encoder."""

    name: str = key(FOLDER_NAME)
    seed: int = key(SEED, 0)
    pictures: int = key(POSITIVE, 60_000)
    tasks: tuple[str, ...] = key(
        choice(*STREAM_TASKS), tuple(STREAM_TASKS)
    )  # the finished model names their validation parts
    steps: int = key(POSITIVE, 3000)
    batch_size: int = key(POSITIVE, 256)  # pictures, each with one caption
    lr: float = key(NOT_NEGATIVE, 2e-3)
    warmup: int = key(NOT_NEGATIVE, 100)  # steps
    weight_decay: float = key(NOT_NEGATIVE, 0.02)
    precision: str = key(choice(*PRECISIONS), "auto")
    checkpoint_every: int = key(POSITIVE, 500)
    towers: Towers = Towers()
