"""The recipes of streams: their sections, each key with its default and meaning."""

from __future__ import annotations

from collections.abc import Mapping

from aegis_cli.data import renaming
from aegis_cli.data.selection import ACTION, STATE, Selection
from aegis_cli.data.streams.names import STREAMS
from aegis_cli.recipes.keys import (
    BELOW_ONE,
    FOLDER_NAME,
    MADE,
    NAMES,
    NOT_EMPTY,
    NOT_EMPTY_EACH,
    NOT_NEGATIVE,
    POSITIVE,
    SEED,
    SHARE,
    UP_TO_ONE,
    Check,
    choice,
    key,
    section,
)
from aegis_cli.recipes.policy import (
    AUGMENTATIONS,
    COLOR_SETS,
    COSINE,
    NORMALIZATIONS,
    PART,
    PRECISIONS,
    SCHEDULES,
    TASK,
    TASKS,
    WEIGHTS,
    Expert,
    Probe,
)

LEARNERS = (
    "zero-shot",
    "sequential",
    "sequential-lora",
    "isolated-lora",
    "moe-adapters",
    "prototype",
    "igsp",
)
ROBOT_LEARNERS = ("sequential", "isolated-lora", "igsp")  # for streams of robot tasks
# Rates of `train` that a learner never reads -> the key that it reads instead, or None.
UNREAD_RATES: Mapping[str, Mapping[str, str | None]] = {
    "zero-shot": {"train.lr": None, "train.router_lr": None},
    "sequential": {"train.lr": "sequential.lr", "train.router_lr": None},
    "moe-adapters": {"train.router_lr": "moe_adapters.router_lr"},
}
# A task's name in a stream: that of a simulated task, or the user's own. The cross-checks decide
# which of both a stream may have.
STREAM_TASK = Check(
    f"{TASK.expected}; or where no simulator has them, names of your own ({FOLDER_NAME.expected})",
    lambda v: TASK.accepts(v) or FOLDER_NAME.accepts(v),
    TASKS,
)
SPLITS = ("evaluation", "validation")  # of episodes and questions
PARTS = TEST, VALIDATION = "test", "validation"  # parts of a task's images, to measure accuracies


@section
class StreamTrain:
    """The training on each task of a stream of images."""

    method: str = key(choice(*LEARNERS), default="igsp", doc="Learner of the stream.")
    steps: int = key(POSITIVE, default=150, doc="Optimizer steps per task.")
    batch_size: int = key(POSITIVE, default=64, doc="Images per step.")
    lr: float = key(NOT_NEGATIVE, default=2e-3, doc="Peak learning rate of experts.")
    router_lr: float = key(
        NOT_NEGATIVE,
        default=5e-2,
        doc="Peak learning rate of routers and scales, whose logits have further to go.",
    )
    warmup: int = key(
        NOT_NEGATIVE, default=10, doc="Steps over which the learning rates rise to their peaks."
    )
    schedule: str = key(
        choice(*SCHEDULES),
        default=COSINE,
        later=True,
        doc="How the learning rates continue after their peaks in each task: down to "
        "`final_lr_share` along a cosine or a straight line, or constant at the peaks.",
    )
    weight_decay: float = key(
        NOT_NEGATIVE, default=0.01, doc="AdamW's weight decay; routers and scales have none."
    )
    clip_norm: float = key(POSITIVE, default=1.0, doc="Norm to which gradients are clipped.")
    final_lr_share: float = key(
        UP_TO_ONE,
        default=0.1,
        doc="Share of the peak learning rates to which they fall. The step after a task's last "
        "would have it; the last is a little above. `schedule: constant` takes none.",
    )
    label_smoothing: float = key(
        BELOW_ONE, default=0.2, doc="Share of each label that is spread over all classes."
    )
    checkpoint_every: int = key(
        POSITIVE, default=100, doc="Steps between two checkpoints; every task ends with one too."
    )
    log_every: int = key(POSITIVE, default=25, doc="Steps between two lines of metrics.jsonl.")
    precision: str = key(
        choice(*PRECISIONS),
        default="float32",
        doc="Number format of training; accuracies are always measured in float32.",
    )


@section
class RobotTrain:
    """The training on each task of a stream of robot tasks."""

    method: str = key(choice(*ROBOT_LEARNERS), default="igsp", doc="Learner of the stream.")
    steps: int = key(POSITIVE, default=400, doc="Optimizer steps per task.")
    batch_size: int = key(POSITIVE, default=32, doc="Frames per step.")
    chunk: int = key(POSITIVE, default=8, doc="Actions that are predicted at once.")
    flow_samples: int = key(
        POSITIVE, default=8, doc="Flow times, each with its noise, that are drawn per image."
    )
    lr: float = key(NOT_NEGATIVE, default=2e-3, doc="Peak learning rate of low-rank experts.")
    router_lr: float = key(
        NOT_NEGATIVE, default=5e-2, doc="Peak learning rate of routers and scales."
    )
    expert_lr: float = key(
        NOT_NEGATIVE, default=1e-3, doc="Peak learning rate of the action expert's own weights."
    )
    warmup: int = key(
        NOT_NEGATIVE, default=40, doc="Steps over which the learning rates rise to their peaks."
    )
    schedule: str = key(
        choice(*SCHEDULES),
        default=COSINE,
        later=True,
        doc="How the learning rates continue after their peaks in each task: down to "
        "`final_lr_share` along a cosine or a straight line, or constant at the peaks.",
    )
    weight_decay: float = key(
        NOT_NEGATIVE, default=0.01, doc="AdamW's weight decay; routers and scales have none."
    )
    clip_norm: float = key(POSITIVE, default=1.0, doc="Norm to which gradients are clipped.")
    normalization: str = key(
        choice(*NORMALIZATIONS),
        default="mean_std",
        doc="How each task's positions and actions are scaled: to mean 0 and standard deviation "
        "1, or by their 1 % and 99 % quantiles.",
    )
    relative_actions: bool = key(
        default=False,
        later=True,
        doc="Predict each task's actions relative to the robot's position when their chunk begins, "
        "as in a policy's recipe. The policies add the position again.",
    )
    relative_exclude: tuple[str, ...] | None = key(
        NOT_EMPTY,
        default=None,
        later=True,
        doc="Words in the names of actions that stay absolute under `relative_actions`, such as "
        "gripper. Each word has to be in an action's name in at least one task.",
    )
    final_lr_share: float = key(
        UP_TO_ONE,
        default=0.1,
        doc="Share of the peak learning rates to which they fall. The step after a task's last "
        "would have it; the last is a little above. `schedule: constant` takes none.",
    )
    freeze: str | tuple[str, ...] | None = key(
        PART,
        default=None,
        later=True,
        doc="Parts of the backbone that do not learn, as in a policy's recipe; a learner with "
        "experts adds none to their maps. Null freezes nothing beyond what the learner itself "
        "does.",
    )
    validation_share: float = key(
        SHARE,
        default=0.05,
        doc="Share of each task's episodes that is kept for the validation loss.",
    )
    checkpoint_every: int = key(
        POSITIVE,
        default=100,
        adjusts=True,
        doc="Steps between two checkpoints; every task ends with one too.",
    )
    log_every: int = key(
        POSITIVE, default=25, adjusts=True, doc="Steps between two lines of metrics.jsonl."
    )
    precision: str = key(
        choice(*PRECISIONS),
        default="auto",
        doc="Number format of training; auto is bf16 where the hardware multiplies in it, else "
        "float32.",
    )
    weights: str = key(
        choice(*WEIGHTS[:2]),
        default="float32",
        later=True,
        doc="Number format of the weights of a Hugging Face backbone that does not learn; bf16 "
        "takes half the memory, also when the policies are measured and act. Experts, routers and "
        "the action expert stay in float32.",
    )
    augment: tuple[str, ...] | None = key(
        choice(*AUGMENTATIONS),
        default=None,
        later=True,
        doc="Transformations, with LeRobot's ranges, that change training frames; null changes "
        "none. Measurements, also those of routers, see frames as they are.",
    )
    augment_count: int = key(
        POSITIVE,
        default=3,
        later=True,
        doc="How many of `augment` are applied to one image, drawn anew each time.",
    )
    gradient_checkpointing: bool = key(
        default=False,
        later=True,
        adjusts=True,
        doc="Recompute activations in the backward pass, also the action expert's: less memory at "
        "the price of a second forward pass. Hugging Face backbones only.",
    )
    accumulate: int = key(
        POSITIVE,
        default=1,
        later=True,
        adjusts=True,
        doc="Number of passes that a step's frames are split into, to save memory (gradient "
        "accumulation).",
    )
    workers: int | None = key(
        POSITIVE,
        default=None,
        later=True,
        shapes=False,
        doc="Threads that read and prepare batches for a GPU, as in a policy's recipe; the trained "
        "weights are the same. Null: the number of cores minus one, at most 16.",
    )


@section
class RobotDemos:
    """The demonstrations of each task of a stream."""

    episodes: int = key(MADE, default=300, doc="Number of episodes that are recorded per task.")
    noise: float = key(
        NOT_NEGATIVE,
        default=0.3,
        doc="Standard deviation of the noise on executed actions; 1 is their full range.",
    )
    seed: int = key(SEED, default=0, doc="Seed of the recording; equal seeds give equal bytes.")
    paths: str | tuple[str, ...] | None = key(
        NOT_EMPTY_EACH,
        default=None,
        doc="Demonstrations to use instead of recording: one file, folder or id on the hub per "
        "task, in the order of `tasks`, or a single one for all of them.",
    )
    only: tuple[str, ...] | None = key(
        NOT_EMPTY_EACH,
        default=None,
        later=True,
        doc="Episodes that each task learns from and validates on, in the order of `tasks`, each "
        "as `demos.only` of a policy names them. Null: a task of LIBERO takes those with its own "
        "instructions, and any other task all.",
    )
    camera: str | tuple[str, ...] | None = key(
        NOT_EMPTY,
        default=None,
        later=True,
        doc="Camera of LeRobot datasets that have several; a list gives the policy one image of "
        "each.",
    )
    state: str | tuple[str, ...] = key(
        NOT_EMPTY,
        default=STATE,
        later=True,
        doc="Feature of LeRobot datasets that has the robot's positions; a list joins several.",
    )
    action: str | tuple[str, ...] = key(
        NOT_EMPTY,
        default=ACTION,
        later=True,
        doc="Feature of LeRobot datasets that has the actions; a list joins several.",
    )

    rename: dict[str, str] | None = key(
        NAMES,
        default=None,
        later=True,
        doc="Names of cameras, features or joints in the demonstrations, each with the policy's, "
        "as in a policy's recipe. Each is renamed in every one of `paths` where it occurs.",
    )
    cache: bool | None = key(
        default=None,
        later=True,
        shapes=False,
        doc="Whether to decode all frames of a LeRobot dataset's videos into a cache on disk "
        "before training, or each frame when a batch needs it, as in a policy's recipe.",
    )

    @property
    def named(self) -> tuple[str, ...]:
        """All demonstrations that `paths` names, each once; () if they are recorded."""
        paths = (self.paths,) if isinstance(self.paths, str) else self.paths or ()
        return tuple(dict.fromkeys(paths))

    def of_task(self, number: int) -> str:
        """The demonstrations that `paths` names for task `number`."""
        assert self.paths is not None
        return self.paths if isinstance(self.paths, str) else self.paths[number]

    def selection(self, only: str | None) -> Selection:
        """The part of the demonstrations in `paths` that a task learns, with its own `only`."""
        rename = renaming.of(self.rename)
        return Selection(self.camera, only, self.state, self.action, rename)


@section
class RobotRollout:
    """How all tasks learned so far are measured after each task of a stream.

    Simulated tasks are played; for others, actions are predicted at held-out frames.
    """

    episodes: int = key(MADE, default=50, doc="Number of episodes per task.")
    seed: int = key(
        SEED, default=0, later=True, doc="Seed of the episodes, none of which is a demonstration's."
    )
    colors: str = key(
        choice(*COLOR_SETS), default="seen", doc="Set of colours that the targets are drawn from."
    )
    replan: int = key(
        POSITIVE, default=4, doc="Actions that are executed before the next prediction."
    )
    ensemble: float | None = key(
        default=None,
        later=True,
        doc="Temporal ensembling as in a policy's recipe, which predicts at every step, so that "
        "`replan` has to be 1. The error at held-out frames has none. Null: chunks are executed as "
        "they are.",
    )
    split: str = key(
        choice(*SPLITS),
        default="evaluation",
        doc="Episodes and questions that are measured; validation uses others, for choosing "
        "settings.",
    )
    frames: int = key(
        POSITIVE,
        default=1000,
        later=True,
        doc="Largest number of held-out frames per task at which actions are predicted, for tasks "
        "that no simulator has.",
    )


@section
class Inference:
    """How the task of an image is inferred.

    There is one Gaussian per task over the bare encoder's early features.
    """

    rank: int = key(
        NOT_NEGATIVE,
        default=16,
        doc="Directions with a variance of their own; all others share one.",
    )
    shrinkage: float = key(
        UP_TO_ONE, default=0.03, doc="Share of each variance that is replaced by the mean of all."
    )
    quantile: float = key(
        BELOW_ONE,
        default=0.05,
        doc="Share of a task's own training images that count as belonging to no task.",
    )


@section
class Sequential:
    """Options of the learner sequential, which trains all weights, task after task."""

    lr: float = key(
        NOT_NEGATIVE, default=3e-4, doc="Peak learning rate of all weights, instead of `train.lr`."
    )


@section
class SequentialLora:
    """Options of the learner sequential-lora, which trains one LoRA, task after task."""

    rank: int = key(POSITIVE, default=8, doc="Rank of the LoRA.")


@section
class IsolatedLora:
    """Options of the learner isolated-lora, which trains one LoRA per task."""

    rank: int = key(POSITIVE, default=8, doc="Rank of each LoRA.")


@section
class MoeAdapters:
    """Options of the learner moe-adapters."""

    rank: int = key(POSITIVE, default=4, doc="Rank of each expert.")
    experts_per_task: int = key(
        POSITIVE, default=2, doc="Experts that the pool holds for each task of the stream."
    )
    top: int = key(
        POSITIVE,
        default=2,
        doc="Experts that an example uses, and that are frozen after a task.",
    )
    router_lr: float = key(
        NOT_NEGATIVE,
        default=2e-3,
        doc="Peak learning rate of its linear routers and scales, instead of `train.router_lr`.",
    )


@section
class Prototype:
    """Options of the learner prototype."""

    rank: int = key(POSITIVE, default=8, doc="Rank of each expert.")
    similarity: float = key(
        UP_TO_ONE,
        default=0.9,
        doc="Cosine of two tasks' mean features from which they share their expert.",
    )


@section
class Igsp:
    """Options of the learner igsp."""

    rank: int = key(POSITIVE, default=4, doc="Rank of each expert.")
    candidates: int = key(POSITIVE, default=2, doc="New experts per task and map, before pruning.")
    history: float = key(
        SHARE, default=0.2, doc="Routing mass that the experts of earlier tasks begin with."
    )
    reuse: float = key(
        NOT_NEGATIVE,
        default=0.1,
        doc="Weight of the share of new parameters that phase 1 asks for; 0 is an ablation.",
    )
    norm: float = key(
        NOT_NEGATIVE, default=0.01, doc="Weight of the new experts' squared norms in phase 1."
    )
    kappa: float = key(
        SHARE,
        default=0.5,
        doc="Share of the uniform routing weight under which an expert may be pruned, if its "
        "`load` is small too.",
    )
    load: float = key(
        SHARE,
        default=0.1,
        doc="Share of the summed p ||f|| (routing weight times output norm) under which an expert "
        "may be pruned, if its weight is small too.",
    )
    identify: float = key(
        SHARE, default=0.5, doc="Share of a task's steps that phase 1 takes at most."
    )
    tolerance: float = key(
        NOT_NEGATIVE,
        default=0.03,
        doc="Total variation of the routing between two checks below which routers count as still.",
    )
    checks: int = key(
        POSITIVE,
        default=3,
        doc="Successive checks at which routers have to be still to end phase 1.",
    )
    check_every: int = key(POSITIVE, default=10, doc="Steps between two checks.")
    prune: bool = key(default=True, doc="Whether experts are pruned; false is an ablation.")
    orthogonal: bool = key(
        default=False,
        doc="Whether phase 2 keeps updates orthogonal to the columns of earlier tasks' experts.",
    )


@section
class StreamRecipe:
    """Trains a dual encoder on a stream of classification tasks, one after the other."""

    name: str = key(FOLDER_NAME, doc="Name of the run.")
    stream: str = key(
        NOT_EMPTY,
        doc=f"Name of the stream: one of {', '.join(STREAMS)}, or with `path` any name.",
    )
    path: str | None = key(
        NOT_EMPTY,
        default=None,
        doc="Folder of a stream of image files: TASK/{train,test}/CLASS/IMAGE.",
    )
    order: tuple[str, ...] | None = key(
        NOT_EMPTY,
        default=None,
        doc="Tasks of the stream as they come; null takes all of them in the stream's own order.",
    )
    encoder: str = key(
        NOT_EMPTY,
        default="embedded-dual",
        doc="'embedded-dual', the folder of a checkpoint, or the folder or id of a CLIP model.",
    )
    seed: int = key(SEED, default=0, doc="Seed of the training.")
    split: str = key(
        choice(*PARTS),
        default=TEST,
        doc="Part of each task's images that accuracies are measured on; validation is for "
        "choosing settings.",
    )
    train: StreamTrain = StreamTrain()
    inference: Inference = Inference()
    sequential: Sequential = Sequential()
    sequential_lora: SequentialLora = SequentialLora()
    isolated_lora: IsolatedLora = IsolatedLora()
    moe_adapters: MoeAdapters = MoeAdapters()
    prototype: Prototype = Prototype()
    igsp: Igsp = Igsp()


@section
class RobotStreamRecipe:
    """Trains a policy on several robot tasks, one after the other."""

    name: str = key(FOLDER_NAME, doc="Name of the run.")
    tasks: tuple[str, ...] = key(
        STREAM_TASK,
        doc="Tasks in the order in which they are learned: simulated ones, or with `demos.paths` "
        "names of your own for those that no simulator has.",
    )
    backbone: str = key(
        NOT_EMPTY,
        default="embedded",
        doc="'embedded', 'embedded-easy', the folder or file of a checkpoint, or the folder or id "
        "of a Hugging Face model.",
    )
    seed: int = key(SEED, default=0, doc="Seed of the training.")
    demos: RobotDemos = RobotDemos()
    train: RobotTrain = RobotTrain()
    expert: Expert = Expert()
    rollout: RobotRollout = RobotRollout()
    probe: Probe = Probe()
    sequential: Sequential = Sequential()
    isolated_lora: IsolatedLora = IsolatedLora()
    igsp: Igsp = Igsp()

    @property
    def simulated(self) -> bool:
        """Whether the tasks are simulated; the first task decides, since all or none are."""
        return TASK.accepts(self.tasks[0])
