"""Aegis's simulated tasks for LeRobot, which imports this package by its name."""

from lerobot_env_aegis.configuration_aegis import AegisEnvConfig

__all__ = ["AegisEnvConfig"]
