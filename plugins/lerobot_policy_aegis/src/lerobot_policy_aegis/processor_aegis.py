"""LeRobot's processing steps before and after the policy: the default ones, which scale nothing."""

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
    """The processing steps before and after the policy, which takes and returns raw values.

    The statistics of the dataset became part of the policy when it was created.
    """
    return make_default_pre_post_processors(config)
