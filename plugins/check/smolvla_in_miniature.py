"""SmolVLM2 and SmolVLA of their true architectures, a few thousand weights large and untrained."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import torch
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig
from safetensors.torch import load_file

sys.path.append(str(Path(__file__).parents[2] / "tests"))

from samples import hf


def save_vlm(folder: Path) -> None:
    """A folder as `aegis anchor` and SmolVLA load it."""
    hf.write("smolvlm", folder)
    path = folder / "tokenizer_config.json"
    # SmolVLA asks its tokenizer for this one too.
    named = {"global_image_token": "<global-img>"}
    path.write_text(json.dumps({**json.loads(path.read_text()), **named}))


def save_smolvla(folder: Path, vlm: Path, dataset: Path, layers: int = 2) -> None:
    """A SmolVLA that begins with the weights of the VLM, in float32.

    Args:
        layers: how many of the VLM's language layers it computes.
    """
    torch.manual_seed(0)
    meta = LeRobotDatasetMetadata("local/reach", root=dataset)
    config = SmolVLAConfig(
        vlm_model_name=str(vlm),
        load_vlm_weights=False,  # LeRobot would load them in bfloat16
        num_vlm_layers=layers,
        num_expert_layers=layers,
        expert_width_multiplier=0.75,
        resize_imgs_with_padding=(hf.SIZE, hf.SIZE),
        chunk_size=8,
        n_action_steps=4,
        tokenizer_max_length=16,
        device="cpu",
        push_to_hub=False,
    )
    policy = make_policy(config, ds_meta=meta)
    own = policy.model.vlm_with_expert.vlm
    weights = load_file(vlm / "model.safetensors")
    wanted = own.state_dict()
    own.load_state_dict({name: t for name, t in weights.items() if name in wanted})
    policy.save_pretrained(folder)
    for steps in make_pre_post_processors(config, dataset_stats=meta.stats):
        steps.save_pretrained(folder)
