"""Aegis's policies and optimizers for LeRobot, which imports this package by its name.

Only the configurations are imported here, so that they are registered; LeRobot imports the policy
and its processors when it creates one.
"""

from lerobot_policy_aegis.configuration_aegis import AegisConfig
from lerobot_policy_aegis.optimizers_aegis import AegisKfacConfig, AegisNullspaceConfig
from lerobot_policy_aegis.schedulers_aegis import AegisSchedulerConfig

__all__ = ["AegisConfig", "AegisKfacConfig", "AegisNullspaceConfig", "AegisSchedulerConfig"]
