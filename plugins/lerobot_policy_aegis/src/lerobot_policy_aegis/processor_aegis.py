"""LeRobot's steps before and after the policy: its default ones, which scale nothing here."""

from __future__ import annotations

from typing import Any

from lerobot.processor import (
    PolicyAction,
    PolicyProcessorPipeline,
    make_default_pre_post_processors,
)
from torch import Tensor

from lerobot_policy_aegis.configuration_aegis import AegisConfig


def make_aegis_pre_post_processors(
    config: AegisConfig, dataset_stats: dict[str, dict[str, Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """The steps before and after the policy; it takes and gives raw values.

    The statistics of the dataset have become part of the policy when it was made.
    """
    return make_default_pre_post_processors(config)
