"""The settings of an Aegis policy in LeRobot."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.configs import FeatureType, NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig, OptimizerConfig

from aegis_cli.common.errors import AegisError
from aegis_cli.core import ensemble
from lerobot_policy_aegis.optimizers_aegis import AegisKfacConfig, AegisNullspaceConfig
from lerobot_policy_aegis.schedulers_aegis import AegisSchedulerConfig

METHODS = ("naive", "stop-gradient", "kfac", "nullspace")


def _unscaled() -> dict[str, NormalizationMode]:
    return dict.fromkeys(("VISUAL", "STATE", "ACTION"), NormalizationMode.IDENTITY)


@PreTrainedConfig.register_subclass("aegis")
@dataclass
class AegisConfig(PreTrainedConfig):
    """A backbone with an action expert.

    Attributes:
        normalization_mapping: identity for everything, because the policy scales its own inputs
            and outputs.
        backbone: VLM of a new policy: 'embedded', a folder, or an id on the hub; with `anchor`, the
            VLM that the anchor was measured on.
        normalization: how a new policy scales: mean_std or quantiles.
        expert_width, expert_mlp_ratio: sizes of a new policy's action expert.
        chunk_size: H, the number of actions predicted at once.
        n_action_steps: how many of them are executed.
        temporal_ensemble_coeff: decay of a temporal ensemble as in ACT; it predicts at every step,
            so `n_action_steps` has to be 1. None: chunks are executed as they are.
        noise_seed: seed of the flow's initial noise, used at every reset.
        flow_samples: number of flow times drawn per frame in training.
        method: how `lerobot-train` fine-tunes the backbone; kfac and nullspace need `anchor`.
        decay_steps: step at which the decay of the learning rates ends; None: the end of training.
        action_feature_names: names of a loaded policy's actions, if known; read by LeRobot. It is
            not a setting and is not in the settings file.
    """

    normalization_mapping: dict[str, NormalizationMode] = field(default_factory=_unscaled)

    backbone: str = "embedded"
    normalization: str = "mean_std"
    expert_width: int = 128
    expert_mlp_ratio: int = 4
    chunk_size: int = 8
    n_action_steps: int = 4
    temporal_ensemble_coeff: float | None = None
    noise_seed: int = 0

    flow_samples: int = 8
    method: str = "naive"
    anchor: str | None = None
    backbone_lr: float = 1e-4
    expert_lr: float = 1e-3
    weight_decay: float = 0.01
    clip_norm: float = 1.0
    warmup_steps: int = 100
    decay_steps: int | None = None
    final_lr_share: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        self.action_feature_names: list[str] | None = None
        if not 1 <= self.n_action_steps <= self.chunk_size:
            raise AegisError(
                f"n_action_steps {self.n_action_steps} of a chunk of {self.chunk_size}",
                "at least 1, and at most the chunk",
                f"--policy.n_action_steps={self.chunk_size}",
            )
        if self.temporal_ensemble_coeff is not None:
            ensemble.check(self.temporal_ensemble_coeff)
            if self.n_action_steps != 1:
                raise AegisError(
                    f"temporal_ensemble_coeff {self.temporal_ensemble_coeff:g} with n_action_steps "
                    f"{self.n_action_steps}",
                    "a prediction at every step",
                    "--policy.n_action_steps=1",
                )
        if self.method not in METHODS:
            raise AegisError(
                f"method '{self.method}'", f"one of {', '.join(METHODS)}", "--policy.method=naive"
            )
        if self.normalization not in ("mean_std", "quantiles"):
            raise AegisError(
                f"normalization '{self.normalization}'",
                "mean_std or quantiles",
                "--policy.normalization=mean_std",
            )

    def validate_features(self) -> None:
        """Raise AegisError unless there are pictures, positions and actions."""
        missing = [
            name
            for name, found in (
                ("a picture", self.image_features),
                ("observation.state", self.robot_state_feature),
                ("action", self.action_feature),
            )
            if not found
        ]
        if missing:
            raise AegisError(
                f"features without {', '.join(missing)}",
                "at least one picture, observation.state and action",
                "use a dataset or an environment that has them",
            )
        if any(ft.type is FeatureType.ENV for ft in self.input_features.values()):
            raise AegisError(
                "the environment's state among the features",
                "what a robot can see",
                "leave it out",
            )

    def get_optimizer_preset(self) -> OptimizerConfig:
        """AdamW, or for kfac and nullspace the protecting optimizer.

        Raises:
            AegisError: a protecting method has no anchor.
        """
        common = {
            "lr": self.expert_lr,
            "weight_decay": self.weight_decay,
            "grad_clip_norm": self.clip_norm,
        }
        protecting = {"kfac": AegisKfacConfig, "nullspace": AegisNullspaceConfig}
        if self.method in protecting:
            kind = protecting[self.method]
            chosen = kind(**common, anchor=self.anchor or "", base=self.backbone)
            chosen.check_anchor("--policy")
            return chosen
        return AdamWConfig(**common)

    def get_scheduler_preset(self) -> AegisSchedulerConfig:
        """The learning-rate schedule of `aegis train`."""
        return AegisSchedulerConfig(self.warmup_steps, self.decay_steps, self.final_lr_share)

    @property
    def observation_delta_indices(self) -> None:
        """A single frame, without a time dimension."""
        return None

    @property
    def action_delta_indices(self) -> list[int]:
        """The chunk that follows a frame."""
        return list(range(self.chunk_size))

    @property
    def reward_delta_indices(self) -> None:
        """No rewards."""
        return None
