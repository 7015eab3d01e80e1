"""Optimizers that preserve what a policy's VLM knows, for `lerobot-train --optimizer.type=...`.

LeRobot gives an optimizer parameters without names. How they are identified nevertheless is
explained in aegis_cli/guard/optimizer.py.
"""

from __future__ import annotations

import abc
from dataclasses import dataclass
from typing import Any, ClassVar

from lerobot.optim import OptimizerConfig

from aegis_cli.common.errors import AegisError
from aegis_cli.guard.optimizer import ProtectedAdamW
from aegis_cli.models import backbones


@dataclass
class _ProtectingConfig(OptimizerConfig, abc.ABC):
    """The settings of AdamW and of the VLM's protection.

    Attributes:
        anchor: file from `aegis anchor`, measured on `base`.
        base: the VLM that the policy starts from: 'embedded', a folder, or an id on the hub.
    """

    method: ClassVar[str]

    lr: float = 1e-4
    betas: tuple[float, float] = (0.9, 0.999)
    eps: float = 1e-8
    weight_decay: float = 1e-2
    grad_clip_norm: float = 1.0
    anchor: str = ""
    base: str = "embedded"

    @abc.abstractmethod
    def options(self) -> dict[str, Any]:
        """The method's own options."""

    def check_anchor(self, option: str) -> None:
        """Raise AegisError if no anchor is given.

        Args:
            option: the command-line option that `.anchor` is appended to.
        """
        if self.anchor:
            return
        part = "curvature" if self.method == "kfac" else "inputs"
        raise AegisError(
            f"the method {self.method} without {option}.anchor",
            "what was measured of the VLM on questions",
            f"aegis anchor --backbone {self.base} --parts {part} --out anchor.safetensors; "
            f"then {option}.anchor=anchor.safetensors",
        )

    def build(self, params: Any) -> ProtectedAdamW:
        """The optimizer for these parameters.

        Raises:
            AegisError: there is no anchor, or `ProtectedAdamW` refuses its arguments.
        """
        self.check_anchor("--optimizer")
        return ProtectedAdamW(
            params,
            self.method,
            self.anchor,
            backbones.load(self.base),
            self.options(),
            lr=self.lr,
            betas=tuple(self.betas),
            eps=self.eps,
            weight_decay=self.weight_decay,
        )


@OptimizerConfig.register_subclass("aegis_kfac")
@dataclass
class AegisKfacConfig(_ProtectingConfig):
    """The VLM's maps are drawn back along the curvature of its answers.

    Attributes:
        weight: weight of the penalty per step; 0 with `balance` 0 is plain AdamW.
        damping: added to the curvature of each output, whose mean is 1.
        balance: how much less maps with small gradients move.
        protect: kinds of maps to protect: maps, stem.
    """

    method: ClassVar[str] = "kfac"

    weight: float = 0.03
    damping: float = 0.1
    balance: float = 1.0
    protect: tuple[str, ...] = ("maps", "stem")

    def options(self) -> dict[str, Any]:
        own = {"weight": self.weight, "damping": self.damping, "balance": self.balance}
        return own | {"protect": tuple(self.protect)}


@OptimizerConfig.register_subclass("aegis_nullspace")
@dataclass
class AegisNullspaceConfig(_ProtectingConfig):
    """The applied update is kept out of the span of the VLM maps' inputs on questions.

    Attributes:
        soft: fraction of the energy of a map's inputs at which a direction is half protected.
        energy: instead of `soft`, protect the leading directions that hold this fraction of the
            energy completely; 0 is plain AdamW.
        protect: kinds of modules to protect: maps, norms, embeddings, stem.
    """

    method: ClassVar[str] = "nullspace"

    soft: float = 1e-4
    energy: float | None = None
    protect: tuple[str, ...] = ("maps", "norms", "embeddings", "stem")

    def options(self) -> dict[str, Any]:
        return {"soft": self.soft, "energy": self.energy, "protect": tuple(self.protect)}
