"""The recipe of a policy: its sections, each key with its default and meaning."""

from __future__ import annotations

import dataclasses
import re

from aegis_cli.data import renaming
from aegis_cli.data.selection import Selection
from aegis_cli.data.vqa.gate import MEAN, UPPER
from aegis_cli.recipes.keys import (
    AT_LEAST_MINUS_ONE,
    BELOW_ONE,
    BELOW_ONE_EACH,
    DIVIDES,
    EVEN,
    FOLDER_NAME,
    MADE,
    NAMES,
    NOT_EMPTY,
    NOT_NEGATIVE,
    POSITIVE,
    POSITIVE_EACH,
    SEED,
    SHARE,
    SHARE_OR_ONE,
    TWO_OR_MORE,
    UP_TO_ONE,
    WITH_PLACE,
    Check,
    choice,
    key,
    section,
)
from aegis_cli.recipes.patterns import EXPECTED, is_pattern

# The words that keys take. They are names in files, options and records, so none may ever change.
METHODS = (
    "naive",
    "stop-gradient",
    "lora",
    "aegis",
    "nullspace",
    "kfac",
    "l2sp",
    "maps",
    "ewc",
    "distill",
    "insulate",
    "cotrain",
)
TASKS = ("reach", "point")
PRECISIONS = ("auto", "bf16", "float32")
NORMALIZATIONS = ("mean_std", "quantiles")
WEIGHTS = ("float32", "bf16", "bf16-master")
STATES = ("float32", "8bit")
PARALLEL = ("ddp", "fsdp")
COLOR_SETS = ("seen", "held-out")
WEIGHTINGS = ("none", "variance")
SCOPES = ("all", "image", "text", "each")
PROJECTED = ("gradient", "update", "both")
GROUPS = ("all", "language")
IDLE = ("moved", "kept")
AUGMENTATIONS = ("brightness", "contrast", "saturation", "hue", "sharpness", "affine")
KEPT = ("weights", "coordinates")
TRACKERS = ("tensorboard", "trackio", "wandb")
OPTIMIZERS = ("adamw", "sgd")
SCHEDULES = COSINE, LINEAR, CONSTANT = "cosine", "linear", "constant"
ANCHOR_SOURCES = ("questions", "demos")
PENALTY_STEPS = ("gradient", "proximal")
SITE_KINDS = ("maps", "norms", "embeddings", "stem")
MERGES = ("linear", "kfac-shrink", "inputs", "factors")
ANCHOR_PARTS = ("moments", "inputs", "curvature", "fisher")
# method -> the parts of an anchor that it reads
NEEDS = {
    "aegis": ("moments",),
    "nullspace": ("inputs",),
    "kfac": ("curvature",),
    "ewc": ("fisher",),
}
# Methods whose gradient depends on how a step is split into passes (`train.accumulate`): they
# compare statistics of a pass, or take the mean over its answers.
PASSES_DIFFER = ("aegis", "distill", "insulate", "cotrain")
# merge -> the part of an anchor that it reads
MERGE_NEEDS = {"kfac-shrink": "curvature", "inputs": "inputs", "factors": "curvature"}
# merge -> the keys that it does not read
MERGE_UNREAD = {"linear": ("damping", "frames"), "kfac-shrink": ("frames",)}
# prefixes of the names of tasks of dm_control's suite, MetaWorld and LIBERO; the stages know which
# tasks exist
SUITE, METAWORLD, LIBERO = "suite/", "metaworld/", "libero/"

_BENCHMARK_TASK = re.compile(rf"{SUITE}\w+-\w+|({METAWORLD}|{LIBERO})[a-z0-9-]+")
_RECORDED = f"one of {', '.join(TASKS)}, {SUITE}DOMAIN-TASK"
RECORDED = f"{_RECORDED}, or {METAWORLD}TASK"  # those that have an expert
TASK = Check(
    f"{_RECORDED}, {METAWORLD}TASK, or {LIBERO}SUITE",
    lambda v: v in TASKS or bool(_BENCHMARK_TASK.fullmatch(v)),
    TASKS,
)

PART = Check(EXPECTED, is_pattern)

_AS_IT_IS = "{}"  # value of `ask` that leaves a question unchanged
_ASK = (
    "What a question becomes before the model reads it, with {} for it. Chat models that answer in "
    "sentences need e.g. '{} Answer with a single word or phrase.', because answers are compared "
    "as a whole."
)


@section
class Demos:
    """The demonstrations that are recorded, or that exist already."""

    episodes: int = key(MADE, default=300, doc="Number of episodes that are recorded.")
    noise: float = key(
        NOT_NEGATIVE,
        default=0.3,
        doc="Standard deviation of the noise on executed actions; 1 is their full range.",
    )
    seed: int = key(SEED, default=0, doc="Seed of the recording; equal seeds give equal bytes.")
    path: str | tuple[str, ...] | None = key(
        NOT_EMPTY,
        default=None,
        doc="Demonstrations to use instead of recording: a file, the folder of a LeRobot dataset, "
        "or its id on the hub; a list trains on several sets of one robot together.",
    )
    weights: tuple[float, ...] | None = key(
        POSITIVE_EACH,
        default=None,
        later=True,
        doc="Shares of the training frames that come from each of several sets in `path`, such as "
        "[2, 1] for twice as many from the first. Null: each frame comes equally often.",
    )
    camera: str | tuple[str, ...] | None = key(
        NOT_EMPTY,
        default=None,
        doc="Camera of a LeRobot dataset that has several; a list gives the policy one image of "
        "each.",
    )
    state: str | tuple[str, ...] = key(
        NOT_EMPTY,
        default="observation.state",
        later=True,
        doc="Feature of a LeRobot dataset that has the robot's positions; a list joins several.",
    )
    action: str | tuple[str, ...] = key(
        NOT_EMPTY,
        default="action",
        later=True,
        doc="Feature of a LeRobot dataset that has the actions; a list joins several.",
    )
    rename: dict[str, str] | None = key(
        NAMES,
        default=None,
        later=True,
        doc="Names of cameras, features or joints in the demonstrations, each with the policy's, "
        "such as {overhead: top}. Each is renamed in every set where it occurs; `camera`, `state` "
        "and `action` have the policy's names.",
    )
    only: str | None = key(
        NOT_EMPTY,
        default=None,
        later=True,
        doc="Episodes of a single set in `path` to learn from and validate on; null: all. Numbers "
        "from 0 and ranges such as '0-39,45', the name of a split in a LeRobot dataset's "
        "info.json, or a LIBERO suite or task, such as libero/spatial, for the episodes with "
        "its instructions.",
    )
    cache: bool | None = key(
        default=None,
        later=True,
        shapes=False,
        doc="Whether to decode all frames of a LeRobot dataset's videos into a cache on disk "
        "before training (true), or each frame when a batch needs it (false); the trained "
        "weights are the same. Null decodes them beforehand if they take at most a quarter of "
        "the free disk. Pictures in data files are always decoded beforehand.",
    )
    drop_below: float | None = key(
        BELOW_ONE,
        default=None,
        doc="Suite tasks only: episodes whose return is below this quantile of all returns are "
        "dropped. Null drops the lowest quarter.",
    )

    @property
    def selection(self) -> Selection:
        """The part of the demonstrations in `path` that is learned."""
        rename = renaming.of(self.rename)
        return Selection(self.camera, self.only, self.state, self.action, rename)


@section
class Anchor:
    """What is measured of the backbone before it is fine-tuned."""

    source: str = key(
        choice(*ANCHOR_SOURCES),
        default="questions",
        later=True,
        doc="What the backbone reads while it is measured: questions, or the demonstrations' "
        "frames with their instructions, for which only moments are measured.",
    )
    vqa: str = key(
        NOT_EMPTY,
        default="scenes",
        doc="Questions: 'scenes', which are drawn, 'easy-vqa', or a file, folder or hub id of "
        "questions. Anchors use a share of the images of such a set, and never those that "
        "probes use.",
    )
    skip_bad: bool = key(
        default=False,
        doc="Leave out bad questions in files and count them, instead of refusing the file.",
    )
    ask: str = key(WITH_PLACE, default="{}", later=True, doc=_ASK)
    samples: int = key(
        POSITIVE, default=3000, doc="Number of pairs of an image and a question, or of frames."
    )
    batch_size: int = key(POSITIVE, default=64, doc="Questions, or frames, per forward pass.")
    seed: int = key(SEED, default=0, doc="Seed of the choice of questions, or of frames.")
    parts: tuple[str, ...] = key(
        choice(*ANCHOR_PARTS),
        default=("moments", "inputs"),
        doc="What is measured: activations per layer (moments, for aegis), the directions that "
        "each map reads (inputs, for nullspace), the answers' curvature "
        "(kfac), and their Fisher information (ewc).",
    )
    energy: float = key(
        SHARE_OR_ONE,
        default=0.9999,
        doc="Share of the energy of each map's inputs up to which eigenvectors are kept.",
    )
    fisher_samples: int = key(
        POSITIVE, default=1000, doc="Number of questions for the Fisher information."
    )
    exact_width: int = key(
        POSITIVE,
        default=1024,
        later=True,
        doc="Widest linear map whose directions are found exactly; those of wider ones are found "
        "by a random sketch.",
    )
    tokens: float = key(
        SHARE_OR_ONE,
        default=1.0,
        later=True,
        doc="Share of the tokens and patches that inputs are measured on, drawn anew in each pass; "
        "less takes less time, and blurs the weakest directions.",
    )
    temperature: float = key(
        POSITIVE,
        default=1.0,
        later=True,
        doc="Divides the scores of answers before the words for the curvature are drawn from them. "
        "If the backbone is sure of its answers, only few questions give gradients; 4 spreads "
        "them over all questions.",
    )
    memory: int | None = key(
        POSITIVE,
        default=None,
        later=True,
        doc="MB that the sums of inputs or curvature may take in addition to the model. Maps are "
        "then measured in groups, with separate passes for each group. Null measures all at "
        "once.",
    )


@section
class Train:
    """The training of the backbone and its action expert."""

    method: str = key(
        choice(*METHODS),
        default="naive",
        doc="Method that `aegis train` uses; `aegis run` trains with each of `methods`.",
    )
    steps: int = key(POSITIVE, default=1500, doc="Optimizer steps.")
    extended_from: tuple[int, ...] | None = key(
        POSITIVE,
        default=None,
        later=True,
        doc="Earlier values of `steps` of a run that `aegis train --resume --set train.steps=N` "
        "has made longer; the command writes them here. The learning rate follows each plan to "
        "its end, and then the next.",
    )
    batch_size: int = key(POSITIVE, default=32, doc="Frames per step.")
    chunk: int = key(POSITIVE, default=8, doc="Actions that are predicted at once.")
    flow_samples: int = key(
        POSITIVE, default=8, doc="Flow times, each with its noise, that are drawn per image."
    )
    backbone_lr: float = key(NOT_NEGATIVE, default=1e-4, doc="Peak learning rate of the backbone.")
    expert_lr: float = key(
        NOT_NEGATIVE, default=1e-3, doc="Peak learning rate of the action expert."
    )
    warmup: int = key(
        NOT_NEGATIVE, default=100, doc="Steps over which the learning rates rise to their peaks."
    )
    schedule: str = key(
        choice(*SCHEDULES),
        default=COSINE,
        later=True,
        doc="How the learning rates continue after their peaks: down to `final_lr_share` along a "
        "cosine or a straight line, or constant at the peaks.",
    )
    optimizer: str = key(
        choice(*OPTIMIZERS),
        default="adamw",
        later=True,
        doc="Optimizer of the backbone: AdamW, or SGD with momentum, whose learning rates are some "
        "thirty times larger. The expert, which is trained from scratch, always uses AdamW.",
    )
    momentum: float = key(
        BELOW_ONE,
        default=0.9,
        later=True,
        doc="Momentum of `optimizer: sgd`; AdamW has none to set.",
    )
    betas: tuple[float, float] = key(
        BELOW_ONE_EACH,
        default=(0.9, 0.999),
        later=True,
        doc="Decays of AdamW's two moments; openpi and SmolVLA have [0.9, 0.95]. Under `optimizer: "
        "sgd` they are those of the expert's AdamW alone.",
    )
    eps: float = key(
        DIVIDES,
        default=1e-8,
        later=True,
        doc="Term that AdamW adds to its denominator, the root of the second moment.",
    )
    states: str = key(
        choice(*STATES),
        default="float32",
        later=True,
        doc="Number format of AdamW's two moments; 8bit takes a quarter of their memory and needs "
        "the extra low-memory.",
    )
    weight_decay: float = key(
        NOT_NEGATIVE,
        default=0.01,
        doc="Weight decay: AdamW's, or under SGD an L2 term of the gradient.",
    )
    clip_norm: float = key(POSITIVE, default=1.0, doc="Norm to which gradients are clipped.")
    normalization: str = key(
        choice(*NORMALIZATIONS),
        default="mean_std",
        doc="How proprioception and actions are scaled: to mean 0 and standard deviation 1, or "
        "by their 1 % and 99 % quantiles.",
    )
    relative_actions: bool = key(
        default=False,
        later=True,
        doc="Predict actions relative to the robot's position when their chunk begins, each to the "
        "position of its own name, as LeRobot's use_relative_actions does. The policy adds "
        "the position again, so that its predictions are absolute.",
    )
    relative_exclude: tuple[str, ...] | None = key(
        NOT_EMPTY,
        default=None,
        later=True,
        doc="Words in the names of actions that stay absolute under `relative_actions`, such as "
        "gripper.",
    )
    final_lr_share: float = key(
        UP_TO_ONE,
        default=0.1,
        doc="Share of the peak learning rates to which they fall. The step after the last would "
        "have it; the last is a little above. `schedule: constant` takes none.",
    )
    ema_decay: float | None = key(
        SHARE,
        default=None,
        later=True,
        doc="Decay of an exponential moving average of the weights, such as 0.99: checkpoints hold "
        "the average, and training goes on from the weights themselves. Null keeps none.",
    )
    backbone_until: float = key(
        SHARE_OR_ONE,
        default=1.0,
        later=True,
        doc="Share of the steps after which the backbone is frozen and only the expert trains on.",
    )
    freeze: str | tuple[str, ...] | None = key(
        PART,
        default=None,
        later=True,
        doc="Parts of the backbone that do not learn, whatever the method: names or patterns of "
        "them, such as vision, or [vision, embeddings, layers.0-11], each with all that is "
        "below it. Null freezes nothing beyond what the method itself does.",
    )
    validation_share: float = key(
        SHARE, default=0.05, doc="Share of the episodes that is kept for the validation loss."
    )
    validate_every: int = key(
        POSITIVE, default=250, adjusts=True, doc="Steps between two validation losses."
    )
    validate_actions: int | None = key(
        POSITIVE,
        default=None,
        later=True,
        shapes=False,
        doc="Number of held-out frames at which `aegis train` predicts actions with every "
        "validation loss. Their error, computed as by `aegis evaluate`, goes to the log and to "
        "trackers; always predicting the mean gives 1. For a robot that is not simulated, no "
        "other figure measures whole actions during training. Null: none.",
    )
    checkpoint_every: int = key(
        POSITIVE, default=500, adjusts=True, doc="Steps between two checkpoints."
    )
    keep_checkpoints: int | None = key(
        POSITIVE,
        default=None,
        shapes=False,
        doc="How many of the latest checkpoints to keep, in addition to the one with the lowest "
        "validation loss; the others are removed. Null keeps all. A validation loss counts for "
        "the checkpoint of the same step. With `probe.while_training` and `probe.max_drop`, "
        "the extra one is the best of those that lost no more than `max_drop`, if there is "
        "one.",
    )
    log_every: int = key(
        POSITIVE, default=25, adjusts=True, doc="Steps between two lines of metrics.jsonl."
    )
    # These belonged to a figure that is no longer measured.
    leak_every: int = key(POSITIVE, default=10, retired=True)
    leak_energy: float = key(SHARE_OR_ONE, default=0.999, retired=True)
    augment: tuple[str, ...] | None = key(
        choice(*AUGMENTATIONS),
        default=None,
        later=True,
        doc="Transformations, with LeRobot's ranges, that change training frames; null changes "
        "none. Anchors, probes and the validation loss see frames as they are.",
    )
    augment_count: int = key(
        POSITIVE,
        default=3,
        later=True,
        doc="How many of `augment` are applied to one image, drawn anew each time.",
    )
    precision: str = key(
        choice(*PRECISIONS),
        default="auto",
        doc="Number format of the forward and backward pass; auto is bf16 where the hardware "
        "multiplies in it, else float32.",
    )
    weights: str = key(
        choice(*WEIGHTS),
        default="float32",
        doc="Number format of a Hugging Face backbone's weights; bf16 takes half the memory, and "
        "small steps are lost. bf16-master rounds them only for the forward and backward pass: "
        "the optimizer and the method work on float32 weights.",
    )
    gradient_checkpointing: bool = key(
        default=False,
        adjusts=True,
        doc="Recompute activations in the backward pass, also the action expert's: less memory at "
        "the price of a second forward pass. Hugging Face backbones only.",
    )
    compile: bool = key(
        default=False,
        adjusts=True,
        doc="Compile the backbone and the expert with torch.compile. Of a Hugging Face backbone "
        "the layers are compiled, and prompts are padded to multiples of 32 tokens (the "
        "embedded backbone's: of 4).",
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
        doc="Threads that read and prepare batches for a GPU, in each process; the trained weights "
        "are the same. Null: this process's share of the cores minus one, at most 16. If steps "
        "wait for them, as many batches are in memory at once as fit into half of what is free.",
    )
    parallel: str = key(
        choice(*PARALLEL),
        default="ddp",
        later=True,
        doc="How processes started by torchrun share a training: each holds all weights (ddp), or "
        "some rows of each weight (fsdp).",
    )
    track: tuple[str, ...] | None = key(
        choice(*TRACKERS),
        default=None,
        shapes=False,
        doc="Trackers that also receive each line of metrics.jsonl; they stay offline unless their "
        "own environment variables say otherwise.",
    )

    @property
    def plans(self) -> tuple[int, ...]:
        """The planned numbers of steps, one per plan, in order."""
        return (*(self.extended_from or ()), self.steps)


@section
class Expert:
    """The action expert; its heads and their size are those of the backbone that it reads."""

    width: int = key(EVEN, default=128, doc="Width of the expert's layers.")
    mlp_ratio: int = key(POSITIVE, default=4, doc="Width of its MLPs, as a multiple of `width`.")
    start: str | None = key(
        NOT_EMPTY,
        default=None,
        later=True,
        doc="Folder of a run, checkpoint or exported policy of the same robot, whose expert this "
        "training starts from; null starts with a new one. The backbone is still set by "
        "`backbone`, which may name the same folder.",
    )


@section
class Lora:
    """Options of the method lora."""

    rank: int = key(POSITIVE, default=16, doc="Rank of each low-rank update.")
    alpha: float = key(
        POSITIVE,
        default=32.0,
        doc="Scale of the low-rank updates, which are multiplied by alpha / rank.",
    )


@section
class Aegis:
    """Options of the method aegis."""

    weighting: str = key(
        choice(*WEIGHTINGS),
        default="none",
        doc="How the layers are weighted in the transport penalty: all alike, or each "
        "divided by its anchor's variance.",
    )
    scope: str = key(
        choice(*SCOPES),
        default="all",
        doc="Tokens whose activations are compared; 'each' compares image and text tokens, each "
        "with a Gaussian of their own.",
    )
    projects: str = key(
        choice(*PROJECTED),
        default="gradient",
        doc="What the conflict is removed from: the gradient, the optimizer's update, or both.",
    )
    restoration: float = key(
        NOT_NEGATIVE,
        default=0.0,
        doc="Weight of the anchor gradient that is added to the task's. The anchor gradient is far "
        "larger: on the embedded VLM its norm began at 8,405, the task's at 4.7, so 1e-5 to "
        "1e-2 is the range to try.",
    )
    groups: str = key(
        choice(*GROUPS),
        default="all",
        doc="Parameter groups that are projected: all, or only the language model's layers.",
    )
    idle: str = key(
        choice(*IDLE),
        default="moved",
        later=True,
        doc="What happens to parameters that the task's gradient does not reach: the projection "
        "moves them along the anchor gradient (moved), or they are trained as under naive "
        "(kept).",
    )
    refresh: int = key(
        POSITIVE,
        default=1,
        later=True,
        doc="Number of steps that share one anchor gradient; the first of them pays for a second "
        "backward pass.",
    )
    fraction: float = key(
        SHARE_OR_ONE,
        default=1.0,
        later=True,
        doc="Share of the batch on which the anchor gradient is computed. Below 1, these frames go "
        "through the backbone a second time, in a small graph of their own.",
    )


@section
class Nullspace:
    """Options of the method nullspace."""

    soft: float = key(
        POSITIVE,
        default=1e-4,
        first=0.0,
        doc="Share of the energy of a map's VQA inputs at which a direction is half protected.",
    )
    energy: float | None = key(
        UP_TO_ONE,
        default=None,
        doc="Instead of `soft`: the leading directions that hold this share of the energy are "
        "fully protected.",
    )
    protect: tuple[str, ...] = key(
        choice(*SITE_KINDS), default=SITE_KINDS, doc="Kinds of modules that are protected."
    )
    every: int = key(
        POSITIVE,
        default=4,
        doc="Steps between two projections; each projects all the steps since the last one.",
    )
    keeps: str = key(
        choice(*KEPT),
        default="weights",
        later=True,
        doc="What is kept of the weights from before the steps that a projection covers: the "
        "weights themselves, or their coordinates along the protected directions, which take "
        "less memory and more time.",
    )


@section
class Kfac:
    """Options of the method kfac."""

    weight: float = key(
        NOT_NEGATIVE,
        default=0.03,
        first=0.05,
        doc="Weight of the penalty per step; its curvature has mean 1 in each map.",
    )
    damping: float = key(
        NOT_NEGATIVE,
        default=0.1,
        first=0.0,
        doc="Added to the curvature of each output, whose mean is 1.",
    )
    balance: float = key(
        NOT_NEGATIVE,
        default=1.0,
        doc="How much less maps with small gradients move; 0 takes Adam's steps as they are.",
    )
    every: int = key(
        POSITIVE,
        default=4,
        doc="Steps between two proximal steps; each covers all the steps since the last one.",
    )
    step: str = key(
        choice(*PENALTY_STEPS),
        default="proximal",
        later=True,
        doc="How the penalty acts: by a proximal step on the weights after the optimizer's, or by "
        "its gradient, which is added to the task's.",
    )
    growth: float = key(
        AT_LEAST_MINUS_ONE,
        default=0.0,
        later=True,
        doc="Power by which the weight grows as the learning rate falls: it is multiplied by "
        "(peak rate / rate) ** growth once the peak is reached. -1: it falls with the rate, as "
        "AdamW's weight decay does.",
    )


@section
class L2sp:
    """Options of the method l2sp."""

    weight: float = key(
        NOT_NEGATIVE,
        default=0.1,
        first=0.01,
        doc="Weight of the squared distance to the pre-trained weights.",
    )


@section
class Maps:
    """Options of the method maps."""

    weight: float = key(
        NOT_NEGATIVE,
        default=2.0,
        first=1.0,
        doc="Weight of the penalty at the first module; it falls linearly to 0 at the last.",
    )


@section
class Ewc:
    """Options of the method ewc."""

    weight: float = key(
        NOT_NEGATIVE,
        default=0.1,
        first=100.0,
        doc="Weight of the penalty, in which each parameter counts by its Fisher information.",
    )
    step: str = key(
        choice(*PENALTY_STEPS),
        default="gradient",
        later=True,
        doc="How the penalty acts: by its gradient, which is added to the task's, or by a proximal "
        "step on the weights after the optimizer's.",
    )


@section
class Distill:
    """Options of the method distill."""

    weight: float = key(
        NOT_NEGATIVE,
        default=1.0,
        doc="Weight of the distance to the pre-trained backbone's features.",
    )


@section
class Insulate:
    """Options of the method insulate."""

    weight: float = key(
        NOT_NEGATIVE,
        default=1.0,
        doc="Weight of the cross-entropy of actions as text. The backbone has no other loss on "
        "robot frames, so its learning rate matters more.",
    )
    bins: int | None = key(
        TWO_OR_MORE,
        default=None,
        doc="Number of equal bins that a normalised action can fall into. Null: as many as the "
        "backbone has numbers for, 256, or 64 of an embedded VLM.",
    )
    limit: float = key(
        POSITIVE,
        default=2.0,
        doc="The bins lie between -limit and limit, in normalised units; the outer ones are open.",
    )
    horizon: int = key(
        POSITIVE,
        default=2,
        doc="Number of the chunk's actions that are written as text: the first, and others evenly "
        "spaced after it; all of a shorter chunk.",
    )
    prompt: str = key(
        WITH_PLACE,
        default="{}",
        doc="Prompt that asks the backbone for the actions, with {} for the instruction. Words "
        "that no question contains tell the two apart.",
    )
    vqa_weight: float = key(
        NOT_NEGATIVE,
        default=0.0,
        doc="Weight of the cross-entropy on questions. Above 0 the method trains on VQA data, and "
        "is a ceiling.",
    )
    vqa: str = key(
        NOT_EMPTY,
        default="scenes",
        doc="Questions that are trained on, with `vqa_weight`; of files, those of the anchor's "
        "share of the images.",
    )
    skip_bad: bool = key(
        default=False,
        doc="Leave out bad questions in files and count them, instead of refusing the file.",
    )
    ask: str = key(WITH_PLACE, default="{}", later=True, doc=_ASK)
    questions: int = key(POSITIVE, default=14_000, doc="Number of questions that are drawn from.")
    batch_size: int = key(POSITIVE, default=32, doc="Questions per step.")


@section
class Cotrain:
    """Options of the method cotrain."""

    weight: float = key(NOT_NEGATIVE, default=0.1, doc="Weight of the cross-entropy on questions.")
    vqa: str = key(
        NOT_EMPTY,
        default="scenes",
        doc="Questions that are trained on; of files, those of the anchor's share of the images.",
    )
    skip_bad: bool = key(
        default=False,
        doc="Leave out bad questions in files and count them, instead of refusing the file.",
    )
    ask: str = key(WITH_PLACE, default="{}", later=True, doc=_ASK)
    questions: int = key(POSITIVE, default=14_000, doc="Number of questions that are drawn from.")
    batch_size: int = key(POSITIVE, default=32, doc="Questions per step.")


@section
class Probe:
    """How Aegis measures what the VLM still knows."""

    vqa: str | tuple[str, ...] = key(
        NOT_EMPTY,
        default="scenes",
        doc="Questions that are asked; they may be the anchor's, since probes get other images. "
        "Each set of a list is probed, reported and held to `max_drop` on its own; knobs are "
        "chosen by the first.",
    )
    skip_bad: bool = key(
        default=False,
        doc="Leave out bad questions in files and count them, instead of refusing the file.",
    )
    ask: str = key(WITH_PLACE, default="{}", later=True, doc=_ASK)
    questions: int = key(POSITIVE, default=5000, doc="Number of questions; for files, the maximum.")
    seed: int = key(SEED, default=0, doc="Seed of the choice of questions.")
    batch_size: int = key(POSITIVE, default=64, doc="Questions per forward pass.")
    max_drop: float | None = key(
        NOT_NEGATIVE,
        default=None,
        doc="Largest drop of the accuracy, in percentage points: beyond it `aegis run`, and `aegis "
        "probe` of the run, exit with 1.",
    )
    gate: str = key(
        choice(MEAN, UPPER),
        default=MEAN,
        later=True,
        doc="Which figure `max_drop` limits: mean, the drop as measured, or upper, the upper end "
        "of its 95 % interval, so that too few questions cannot pass.",
    )
    while_training: int | None = key(
        POSITIVE,
        default=None,
        later=True,
        doc="Number of validation questions of each set that `aegis train` asks before the first "
        "step and with every validation loss, so that its log and trackers show a loss of VQA "
        "as it happens. Neither anchors nor probes use their images. Null: none.",
    )

    @property
    def sets(self) -> tuple[str, ...]:
        """The names of its question sets, in their order."""
        return (self.vqa,) if isinstance(self.vqa, str) else self.vqa

    @property
    def only_set(self) -> str:
        """The name of the only question set, as in a stream's probe or one of `of_each_set`."""
        (name,) = self.sets  # with several sets, taking one would ignore the others
        return name

    def of_each_set(self) -> tuple[Probe, ...]:
        """This probe with each of its question sets separately, in their order."""
        return tuple(dataclasses.replace(self, vqa=name) for name in self.sets)

    @property
    def asking(self) -> tuple[str, ...]:
        """Options of `aegis probe` that ask the questions of this one set as this probe does.

        They do so even if the policy has no recipe. If it has one, its `skip_bad` would not apply
        to a set that is named.
        """
        words: tuple[str, ...] = ("--vqa", str(self.vqa))
        if self.ask != _AS_IT_IS:
            words += ("--ask", self.ask)
        return (*words, "--skip-bad") if self.skip_bad else words


@section
class Rollout:
    """How a policy's success is measured."""

    episodes: int = key(MADE, default=50, doc="Number of episodes for each set of colours.")
    seed: int = key(
        SEED, default=0, doc="Seed of the episodes, none of which is a demonstration's."
    )
    colors: tuple[str, ...] = key(
        choice(*COLOR_SETS),
        default=COLOR_SETS,
        doc="Sets of colours that the targets are drawn from.",
    )
    replan: int = key(
        POSITIVE, default=4, doc="Actions that are executed before the next prediction."
    )
    ensemble: float | None = key(
        default=None,
        later=True,
        doc="Temporal ensembling as in ACT: an action is the mean of all chunks that predicted it, "
        "weighted by exp(-ensemble * i), i = 0 for the oldest; ACT has 0.01. A chunk is predicted "
        "at every step, so `replan` has to be 1. Null: chunks are executed as they are.",
    )
    while_training: int | None = key(
        MADE,
        default=None,
        later=True,
        doc="Number of validation episodes, on seen colours, that `aegis train` plays with every "
        "validation loss, so that its log and trackers show the success as it grows. Neither "
        "demonstrations nor evaluations use these episodes. Null: none.",
    )


@section
class Merge:
    """Moves the backbone back towards the pre-trained one, after training and before measuring.

    `aegis run` does what `aegis merge` does; `aegis train` alone does not.
    """

    method: str | None = key(
        choice(*MERGES),
        default=None,
        doc="Rule that decides how much of the backbone's change is kept; null keeps all of it and "
        "merges nothing.",
    )
    strength: float = key(
        NOT_NEGATIVE,
        default=10.0,
        doc="How far back; for linear the share of the way, from 0 to 1.",
    )
    damping: float = key(
        SHARE_OR_ONE,
        default=0.01,
        doc="Added to each eigenvalue of every curvature, whose mean is 1.",
    )
    frames: int = key(
        POSITIVE, default=1000, doc="Robot frames that the task's factors are measured on."
    )


@section
class Recipe:
    """Fine-tunes a backbone on the demonstrations of one task, by each of several methods."""

    name: str = key(FOLDER_NAME, doc="Name of the run; `aegis run` writes runs/NAME.")
    task: str = key(TASK, default="reach", doc="Task that is demonstrated and rolled out.")
    backbone: str = key(
        NOT_EMPTY,
        default="embedded",
        doc="'embedded', 'embedded-easy', the folder or file of a checkpoint, or the folder or id "
        "of a Hugging Face model.",
    )
    seed: int = key(SEED, default=0, doc="Seed of the training.")
    methods: tuple[str, ...] = key(
        choice(*METHODS), default=METHODS[:5], doc="Methods that `aegis run` trains and compares."
    )
    demos: Demos = Demos()
    anchor: Anchor = Anchor()
    train: Train = Train()
    expert: Expert = Expert()
    lora: Lora = Lora()
    aegis: Aegis = Aegis()
    nullspace: Nullspace = Nullspace()
    kfac: Kfac = Kfac()
    l2sp: L2sp = L2sp()
    maps: Maps = Maps()
    ewc: Ewc = Ewc()
    distill: Distill = Distill()
    insulate: Insulate = Insulate()
    cotrain: Cotrain = Cotrain()
    merge: Merge = Merge()
    probe: Probe = Probe()
    rollout: Rollout = Rollout()

    def reads_anchor(self, method: str) -> bool:
        """Whether the weights depend on an anchor, by the method or by the merge after it."""
        return method in NEEDS or self.merge.method in MERGE_NEEDS
