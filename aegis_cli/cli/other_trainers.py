"""Options of LeRobot's training and of transformers' Trainer, with the equivalent recipe keys.

docs/lerobot.md has them as a table, with the options that no key replaces.
"""

from __future__ import annotations

from collections.abc import Mapping

_RATES = ("train.backbone_lr", "train.expert_lr")
_WATCHED = ("rollout.while_training", "train.validate_every")
# name of an option there, without its dashes -> keys here
KEYS: Mapping[str, tuple[str, ...]] = {
    # LeRobot
    "dataset.repo_id": ("demos.path",),
    "dataset.root": ("demos.path",),
    "dataset.episodes": ("demos.only",),
    "dataset.image_transforms.enable": ("train.augment",),
    "dataset.eval_split": ("train.validation_share",),
    "rename_map": ("demos.rename",),
    "policy.chunk_size": ("train.chunk",),
    "policy.n_action_steps": ("rollout.replan",),
    "policy.freeze_vision_encoder": ("train.freeze",),
    "policy.train_expert_only": ("train.method",),
    "policy.use_relative_actions": ("train.relative_actions",),
    "policy.normalization_mapping": ("train.normalization",),
    "policy.use_amp": ("train.precision",),
    "policy.compile_model": ("train.compile",),
    "policy.gradient_checkpointing": ("train.gradient_checkpointing",),
    "num_workers": ("train.workers",),
    "log_freq": ("train.log_every",),
    "save_freq": ("train.checkpoint_every",),
    "optimizer.type": ("train.optimizer",),
    "optimizer.lr": _RATES,
    "optimizer.betas": ("train.betas",),
    "optimizer.eps": ("train.eps",),
    "optimizer.weight_decay": ("train.weight_decay",),
    "optimizer.grad_clip_norm": ("train.clip_norm",),
    "scheduler.type": ("train.schedule",),
    "scheduler.num_warmup_steps": ("train.warmup",),
    "scheduler.decay_lr": ("train.final_lr_share",),
    "wandb.enable": ("train.track",),
    "env_eval_freq": _WATCHED,
    "eval_freq": _WATCHED,
    "eval.n_episodes": ("rollout.while_training",),
    # the Trainer
    "per_device_train_batch_size": ("train.batch_size",),
    "gradient_accumulation_steps": ("train.accumulate",),
    "dataloader_num_workers": ("train.workers",),
    "max_steps": ("train.steps",),
    "logging_steps": ("train.log_every",),
    "save_steps": ("train.checkpoint_every",),
    "save_total_limit": ("train.keep_checkpoints",),
    "eval_steps": ("train.validate_every",),
    "learning_rate": _RATES,
    "adam_beta1": ("train.betas",),
    "adam_beta2": ("train.betas",),
    "adam_epsilon": ("train.eps",),
    "max_grad_norm": ("train.clip_norm",),
    "lr_scheduler_type": ("train.schedule",),
    "warmup_steps": ("train.warmup",),
    "report_to": ("train.track",),
    "bf16": ("train.precision",),
    "optim": ("train.optimizer", "train.states"),
    # common names
    "lr": _RATES,
}
