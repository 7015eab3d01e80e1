"""Recipes: what may be said in a YAML file, as frozen dataclasses, and how such a file is read."""

from __future__ import annotations

from aegis_cli.recipes.policy import (
    ANCHOR_PARTS,
    FOLDER_NAME,
    METHODS,
    NEEDS,
    PROJECTED,
    SCOPES,
    SITE_KINDS,
    TASK,
    TASKS,
    WEIGHTINGS,
    Aegis,
    Anchor,
    Cotrain,
    Demos,
    Expert,
    Kfac,
    Lora,
    Model,
    Nullspace,
    Probe,
    Recipe,
    Rollout,
    Train,
)
from aegis_cli.recipes.pretraining import PretrainRecipe
from aegis_cli.recipes.reader import (
    AnyRecipe,
    anchor_checks,
    changed,
    check_anchor,
    cross_checks,
    describe,
    digest,
    is_robot_stream_run,
    is_stream_run,
    load,
    load_pretrain,
    load_training,
    options,
    read,
    read_anchor,
    to_yaml,
    training_part,
)
from aegis_cli.recipes.stream_recipes import DualRecipe, RobotStreamRecipe, StreamRecipe
from aegis_cli.recipes.streams import (
    LEARNERS,
    ROBOT_LEARNERS,
    TEST,
    VALIDATION,
    Igsp,
    Inference,
    IsolatedLora,
    MoeAdapters,
    Prototype,
    RobotDemos,
    RobotRollout,
    RobotTrain,
    Sequential,
    StreamTrain,
    Towers,
)
from aegis_cli.recipes.studies import Pairs, StreamStudyRecipe, StreamTuning, StreamVariant, StudyRecipe, Tuning, Variant

__all__ = ["ANCHOR_PARTS", "Aegis", "Anchor", "AnyRecipe", "Cotrain", "Demos", "DualRecipe", "Expert", "FOLDER_NAME", "Igsp", "Inference", "IsolatedLora", "Kfac", "LEARNERS", "Lora", "METHODS", "Model", "MoeAdapters", "NEEDS", "Nullspace", "PROJECTED", "Pairs", "PretrainRecipe", "Probe", "Prototype", "ROBOT_LEARNERS", "Recipe", "RobotDemos", "RobotRollout", "RobotStreamRecipe", "RobotTrain", "Rollout", "SCOPES", "SITE_KINDS", "Sequential", "StreamRecipe", "StreamStudyRecipe", "StreamTrain", "StreamTuning", "StreamVariant", "StudyRecipe", "TASK", "TASKS", "TEST", "Towers", "Train", "Tuning", "VALIDATION", "Variant", "WEIGHTINGS", "anchor_checks", "changed", "check_anchor", "cross_checks", "describe", "digest", "is_robot_stream_run", "is_stream_run", "load", "load_pretrain", "load_training", "options", "read", "read_anchor", "to_yaml", "training_part"]
