"""The sections of a recipe: each key with its default and what it may be."""

from __future__ import annotations

import re
from dataclasses import dataclass

from aegis_cli.recipes.strict_yaml import Check, key

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
    "cotrain",
)
TASKS = ("reach", "point")
PRECISIONS = ("auto", "bf16", "float32")
NORMALIZATIONS = ("mean_std", "quantiles")
WEIGHTS = ("float32", "bf16")
COLOR_SETS = ("seen", "held-out")
WEIGHTINGS = ("none", "variance")
SCOPES = ("all", "image", "text", "each")
PROJECTED = ("gradient", "update", "both")
GROUPS = ("all", "language")
SITE_KINDS = ("maps", "norms", "embeddings", "stem")
ANCHOR_PARTS = ("moments", "inputs", "curvature", "fisher")
# method -> the parts of an anchor that it reads
NEEDS = {
    "aegis": ("moments",),
    "nullspace": ("inputs",),
    "kfac": ("curvature",),
    "ewc": ("fisher",),
}
# what the names of dm_control's suite tasks begin with; which there are, the stages know
SUITE = "suite/"


def choice(*choices: str) -> Check:
    return Check("one of " + ", ".join(choices), lambda v: v in choices, choices)


POSITIVE = Check("above 0", lambda v: v > 0)
EVEN = Check("above 0 and even", lambda v: v > 0 and v % 2 == 0)
NOT_NEGATIVE = Check("0 or more", lambda v: v >= 0)
SEED = Check("from 0 to 4294967295", lambda v: 0 <= v < 2**32)
SHARE = Check("above 0 and below 1", lambda v: 0 < v < 1)
UP_TO_ONE = Check("from 0 to 1", lambda v: 0 <= v <= 1)
SHARE_OR_ONE = Check("above 0 and up to 1", lambda v: 0 < v <= 1)
NOT_EMPTY = Check("not empty", lambda v: bool(v.strip()))
_SUITE_TASK = re.compile(SUITE + r"\w+-\w+")
TASK = Check(
    f"one of {', '.join(TASKS)}, or {SUITE}DOMAIN-TASK",
    lambda v: v in TASKS or bool(_SUITE_TASK.fullmatch(v)),
    TASKS,
)
BELOW_ONE = Check("0 or more and below 1", lambda v: 0 <= v < 1)
FOLDER_NAME = Check("letters, digits, '.', '_', '-'", lambda v: bool(re.fullmatch(r"\w[\w.-]*", v)))


@dataclass(frozen=True)
class Demos:
    episodes: int = key(POSITIVE, 300)
    noise: float = key(
        NOT_NEGATIVE, 0.3
    )  # standard deviation of the executed action, in action units
    seed: int = key(SEED, 0)
    path: str | None = key(
        NOT_EMPTY, None
    )  # demonstrations to use, a file or a LeRobot folder, instead of recording
    camera: str | tuple[str, ...] | None = key(
        NOT_EMPTY, None
    )  # of a LeRobot folder that has several; a list: an image each
    drop_below: float | None = key(
        BELOW_ONE, None
    )  # of a suite task, the quantile of returns below which; none: a quarter


@dataclass(frozen=True)
class Anchor:
    vqa: str = key(
        NOT_EMPTY, "scenes"
    )  # or a file or folder of questions, of which anchors get a share of the images
    skip_bad: bool = False  # leave bad questions of files out and count them
    samples: int = key(POSITIVE, 3000)
    batch_size: int = key(POSITIVE, 64)
    seed: int = key(SEED, 0)
    parts: tuple[str, ...] = key(choice(*ANCHOR_PARTS), ("moments", "inputs"))
    energy: float = key(
        SHARE_OR_ONE, 0.9999
    )  # of each map's inputs, up to which eigenvectors are kept
    fisher_samples: int = key(POSITIVE, 1000)


@dataclass(frozen=True)
class Train:
    method: str = key(choice(*METHODS), "naive")
    steps: int = key(POSITIVE, 1500)
    batch_size: int = key(POSITIVE, 32)
    chunk: int = key(POSITIVE, 8)  # actions predicted at once
    flow_samples: int = key(POSITIVE, 8)  # flow times and noises an image
    backbone_lr: float = key(NOT_NEGATIVE, 1e-4)
    expert_lr: float = key(NOT_NEGATIVE, 1e-3)
    warmup: int = key(NOT_NEGATIVE, 100)  # steps
    weight_decay: float = key(NOT_NEGATIVE, 0.01)
    clip_norm: float = key(POSITIVE, 1.0)
    normalization: str = key(
        choice(*NORMALIZATIONS), "mean_std"
    )  # of proprioception and actions; quantiles: 1 %, 99 %
    final_lr_share: float = key(UP_TO_ONE, 0.1)
    validation_share: float = key(SHARE, 0.05)  # of the episodes
    validate_every: int = key(POSITIVE, 250)
    checkpoint_every: int = key(POSITIVE, 500)
    log_every: int = key(POSITIVE, 25)
    leak_every: int = key(
        POSITIVE, 10
    )  # steps between two measurements of the leak, each about 5 % of a step
    leak_energy: float = key(
        SHARE_OR_ONE, 0.999
    )  # of each map's VQA inputs, whose directions the leak is measured in
    precision: str = key(choice(*PRECISIONS), "auto")
    weights: str = key(
        choice(*WEIGHTS), "float32"
    )  # of a Hugging Face backbone; bf16: half the memory, small steps are lost
    gradient_checkpointing: bool = (
        False  # of a Hugging Face backbone: less memory, a second forward pass
    )
    compile: bool = False


@dataclass(frozen=True)
class Expert:
    width: int = key(
        EVEN, 128
    )  # heads and their size are the backbone's, whose keys and values it reads
    mlp_ratio: int = key(POSITIVE, 4)


@dataclass(frozen=True)
class Lora:
    rank: int = key(POSITIVE, 16)
    alpha: float = key(POSITIVE, 32.0)


@dataclass(frozen=True)
class Aegis:
    weighting: str = key(choice(*WEIGHTINGS), "none")  # of the layers in the transport penalty
    scope: str = key(
        choice(*SCOPES), "all"
    )  # tokens that are compared; each: one Gaussian a token type
    projects: str = key(choice(*PROJECTED), "gradient")  # what the conflict is removed from
    restoration: float = key(NOT_NEGATIVE, 0.0)  # weight of the anchor gradient added to the task's
    groups: str = key(
        choice(*GROUPS), "all"
    )  # which parameter groups are projected; language: the layers


@dataclass(frozen=True)
class Nullspace:
    soft: float = key(
        POSITIVE, 1e-4, first=0.0
    )  # share of a map's VQA input energy at which a direction is half protected
    energy: float | None = key(
        UP_TO_ONE, None
    )  # instead of soft: the leading directions that hold this share, wholly
    protect: tuple[str, ...] = key(choice(*SITE_KINDS), SITE_KINDS)
    every: int = key(
        POSITIVE, 4
    )  # steps between two projections, each of all the steps since the last


@dataclass(frozen=True)
class Kfac:
    weight: float = key(
        NOT_NEGATIVE, 0.03, first=0.05
    )  # of the penalty a step, whose curvature has mean 1 in each map
    damping: float = key(
        NOT_NEGATIVE, 0.1, first=0.0
    )  # added to how much each output is minded, whose mean is 1
    balance: float = key(
        NOT_NEGATIVE, 1.0
    )  # how much less maps of small gradients move; 0: Adam's steps
    every: int = key(
        POSITIVE, 4
    )  # steps between two proximal steps, each of all the steps since the last


@dataclass(frozen=True)
class L2sp:
    weight: float = key(NOT_NEGATIVE, 0.1, first=0.01)


@dataclass(frozen=True)
class Maps:
    weight: float = key(
        NOT_NEGATIVE, 2.0, first=1.0
    )  # of the first module; it falls linearly to 0 at the last


@dataclass(frozen=True)
class Ewc:
    weight: float = key(NOT_NEGATIVE, 0.1, first=100.0)


@dataclass(frozen=True)
class Distill:
    weight: float = key(NOT_NEGATIVE, 1.0)


@dataclass(frozen=True)
class Cotrain:
    weight: float = key(NOT_NEGATIVE, 0.1)  # of the VQA cross-entropy
    vqa: str = key(NOT_EMPTY, "scenes")  # of files, it trains on the anchor's share
    skip_bad: bool = False
    questions: int = key(POSITIVE, 14_000)
    batch_size: int = key(POSITIVE, 32)  # questions a step


@dataclass(frozen=True)
class Probe:
    vqa: str = key(NOT_EMPTY, "scenes")  # may be the anchor's: probes get other images
    skip_bad: bool = False
    questions: int = key(POSITIVE, 5000)
    batch_size: int = key(POSITIVE, 64)
    max_drop: float | None = key(
        NOT_NEGATIVE, None
    )  # percentage points past which `aegis run` exits 1


@dataclass(frozen=True)
class Rollout:
    episodes: int = key(POSITIVE, 50)
    colors: tuple[str, ...] = key(choice(*COLOR_SETS), COLOR_SETS)
    replan: int = key(POSITIVE, 4)  # actions executed before the next prediction


@dataclass(frozen=True)
class Model:
    width: int = key(POSITIVE, 192)
    depth: int = key(POSITIVE, 6)
    heads: int = key(POSITIVE, 6)


@dataclass(frozen=True)
class Recipe:
    """What `aegis run` and `aegis train` read."""

    name: str = key(FOLDER_NAME)
    task: str = key(TASK, "reach")
    backbone: str = key(NOT_EMPTY, "embedded")
    seed: int = key(SEED, 0)
    methods: tuple[str, ...] = key(choice(*METHODS), METHODS[:5])
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
    cotrain: Cotrain = Cotrain()
    probe: Probe = Probe()
    rollout: Rollout = Rollout()
