"""A policy as a folder in the layout of LeRobot's policies; LeRobot itself is not needed.

config.json                what LeRobot needs to know: features, chunk, executed actions
model.safetensors          all tensors of the policy, under the names of its modules; the header has
                           its sizes, its task and what else a user needs to know
policy_preprocessor.json   LeRobot's steps before and after the policy. They change no number,
policy_postprocessor.json  because the policy has its own scales.
backbone/                  a Hugging Face model's configuration and its processor's files
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from aegis_cli.common import artifacts, files
from aegis_cli.common.errors import AegisError
from aegis_cli.common.state_dicts import check_state, reading_meta, shape_from
from aegis_cli.data.batch import Normalizer
from aegis_cli.data.relative import of_meta as relative_of
from aegis_cli.models import structure
from aegis_cli.models.backbones import model_folder, outline
from aegis_cli.models.backbones.base import FLOAT32, STORED_TYPES
from aegis_cli.models.expert import ActionExpert, ExpertShape, check_fit
from aegis_cli.models.policy import Policy
from aegis_cli.models.policy_meta import PolicyMeta

TYPE, KIND = "aegis", "policy"  # LeRobot's name for the policy, and ours for its file
MODEL, CONFIG, BACKBONE = "model.safetensors", "config.json", "backbone"
PREPROCESSOR, POSTPROCESSOR = "policy_preprocessor.json", "policy_postprocessor.json"
STATE, ACTION, IMAGES = "observation.state", "action", "observation.images."
_OBSERVED = "observation."  # the prefix of LeRobot's full names
CAMERA = "top"  # the camera of our own tasks
# LeRobot requires a size, which a policy exported before sizes were kept does not know.
_ANY_SIZE = 224
# The entries of a checkpoint's meta that are kept.
_SAID = (
    "method",
    "task",
    "replan",
    "ensemble",
    "normalization",
    "relative",
    "cameras",
    "pictures",
    "only",
    "state",
    "action",
    "rename",
    "action_names",
    "proprio_names",
    "action_std",
    "proprio_reach",
    "fps",
    "dataset",
    "base_model",
    "began_as",
    "merge",
)
_UNSCALED = {"VISUAL": "IDENTITY", "STATE": "IDENTITY", "ACTION": "IDENTITY"}

is_policy, is_own_config = model_folder.is_policy, model_folder.is_own_config


def write(folder: Path, policy: Policy, meta: PolicyMeta, cameras: Sequence[str] = ()) -> None:
    """Write the policy and LeRobot's files into an existing folder.

    Args:
        cameras: other names for the pictures, in the backbone's order.
    """
    named = cameras or meta.get("cameras") or (CAMERA,)
    # The names in a LeRobot dataset already have this prefix.
    named = [name.removeprefix(IMAGES) for name in named]
    write_model(folder, policy, cast(PolicyMeta, {**meta, "cameras": named}))
    config = _config(policy, meta, named)
    files.save_json(folder / CONFIG, config)
    for name, content in _processors(config).items():
        files.save_json(folder / name, content)


def write_model(folder: Path, policy: Policy, meta: PolicyMeta) -> None:
    """Write only the policy itself into an existing folder, replacing existing files.

    The backbone's weights are written in their present dtype, which the header names as `stored` if
    it is not float32.
    """
    described = outline.describe(policy.backbone, folder / BACKBONE)
    tensors = {f"model.{name}": tensor for name, tensor in own_tensors(policy).items()}
    sizes = {"expert": policy.expert.shape.to_json(), "backbone": described}
    sizes |= {"positions": len(policy.proprio_scale.mean), "actions": len(policy.action_scale.mean)}
    said = {name: meta[name] for name in _SAID if name in meta}
    stored = str(structure.widest(policy.backbone.parameters())).removeprefix("torch.")
    if stored != FLOAT32:
        said["stored"] = stored
    artifacts.save(
        folder / MODEL,
        KIND,
        tensors,
        fingerprint=policy.backbone.fingerprint(),
        meta={**said, "sizes": sizes},
    )


def load(folder: Path) -> tuple[Policy, PolicyMeta]:
    """Load the policy in a folder, ready to act, and its meta.

    Raises:
        AegisError: a file is missing or damaged, or holds other tensors than the policy's.
    """
    path = folder / MODEL
    artifact = artifacts.load(path, KIND)
    said, count = dict(artifact.header.meta), len(artifact.tensors)
    with reading_meta(path):
        sizes = dict(said.pop("sizes"))
        meta = cast(PolicyMeta, said)
        shape = shape_from(ExpertShape, sizes["expert"], path, count)
    backbone = outline.build(sizes["backbone"], folder / BACKBONE, path, count)
    with reading_meta(path):
        check_fit(shape, backbone.depth, backbone.heads, backbone.head_dim)
        positions, actions = (_unit(int(sizes[name])) for name in ("positions", "actions"))
        relative = relative_of(meta, int(sizes["actions"]), int(sizes["positions"]))
        stored = STORED_TYPES[meta.get("stored", FLOAT32)]
    policy = Policy(backbone, ActionExpert(shape), positions, actions, relative)
    # `fill` needs the file's own dtypes. Afterwards all is float32, as in any loaded backbone.
    backbone.round_weights(stored)
    fill(policy, {n.removeprefix("model."): t for n, t in artifact.tensors.items()}, f"'{path}'")
    backbone.round_weights(torch.float32)
    backbone.stored = meta.get("stored", FLOAT32)
    backbone.hub_id = meta.get("base_model")
    if artifact.header.fingerprint != backbone.fingerprint():
        raise AegisError(
            f"'{path}' whose backbone is not the one that its header names",
            "the file as it was written",
            "export the policy again",
        )
    return policy.eval(), meta


def picture_key(name: str) -> str:
    """LeRobot's name of a picture; a dataset's own name, such as `observation.image`, is kept."""
    return name if name.startswith(_OBSERVED) else f"{IMAGES}{name}"


def own_tensors(policy: Policy) -> dict[str, Tensor]:
    """A policy's parameters and buffers by name; a tied tensor appears under its first name."""
    named = {**dict(policy.named_parameters()), **dict(policy.named_buffers())}
    return {name: tensor for name, tensor in policy.state_dict().items() if name in named}


def fill(policy: Policy, tensors: Mapping[str, Tensor], source: str) -> None:
    """Load tensors into a policy, which must be exactly its own.

    Raises:
        AegisError: one is missing, left over, or of another shape or dtype; nothing was loaded.
    """
    check_state(source, tensors, own_tensors(policy))
    # A tied tensor is there under its first name; its further names are missing.
    policy.load_state_dict(tensors, strict=False)


def _unit(size: int) -> Normalizer:
    """A normalizer of `size` numbers, whose scales are still to be loaded."""
    if size < 1:
        raise ValueError(f"a size of {size}")
    zeros = torch.zeros(size, dtype=torch.float32)
    return Normalizer(zeros, torch.ones_like(zeros))


# --- LeRobot's own files --------------------------------------------------------------------------


def _config(policy: Policy, meta: PolicyMeta, cameras: Sequence[str]) -> dict[str, Any]:
    """The fields of the plugin's configuration that are not at their defaults."""
    side = policy.backbone.image_size or _ANY_SIZE
    sizes = meta.get("pictures") or [(side, side)] * len(cameras)
    pictures = {
        picture_key(name): _feature("VISUAL", 3, *size)
        for name, size in zip(cameras, sizes, strict=True)
    }
    return {
        "type": TYPE,
        "n_obs_steps": 1,  # a policy sees only the current frame
        "input_features": {
            **pictures,
            STATE: _feature("STATE", len(policy.proprio_scale.mean)),
        },
        "output_features": {ACTION: _feature("ACTION", len(policy.action_scale.mean))},
        "normalization_mapping": _UNSCALED,
        "chunk_size": policy.expert.shape.chunk,
        "n_action_steps": meta["replan"],
        **({"temporal_ensemble_coeff": meta["ensemble"]} if "ensemble" in meta else {}),
    }


def _feature(kind: str, *shape: int) -> dict[str, Any]:
    return {"type": kind, "shape": list(shape)}


def _processors(config: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """LeRobot's default processing steps, by file.

    LeRobot's programs override settings of these steps by name, and refuse a policy that lacks one
    of them.
    """
    outputs = config["output_features"]
    before = [
        _step("rename_observations_processor", rename_map={}),
        _step("to_batch_processor"),
        _step("device_processor", device="cpu", float_dtype=None),
        _scaling("normalizer_processor", {**config["input_features"], **outputs}),
    ]
    after = [
        _scaling("unnormalizer_processor", outputs),
        _step("device_processor", device="cpu", float_dtype=None),
    ]
    return {
        PREPROCESSOR: {"name": Path(PREPROCESSOR).stem, "steps": before},
        POSTPROCESSOR: {"name": Path(POSTPROCESSOR).stem, "steps": after},
    }


def _step(name: str, **settings: Any) -> dict[str, Any]:
    return {"registry_name": name, "config": settings}


def _scaling(name: str, features: Mapping[str, Any]) -> dict[str, Any]:
    return _step(name, eps=1e-8, features=features, norm_map=_UNSCALED)
