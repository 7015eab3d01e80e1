"""Open a robot policy that another program trained, and the VLM that it was made from."""

from __future__ import annotations

import contextlib
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from pathlib import Path

from aegis_cli import recipes
from aegis_cli.common import commands, files, hub
from aegis_cli.common.errors import AegisError, in_short
from aegis_cli.models import backbones
from aegis_cli.models.backbones import model_folder
from aegis_cli.publishing import policy_copy, tensor_files, vlm_names
from aegis_cli.publishing.tensor_files import Tensors
from aegis_cli.publishing.vlm_names import Asked, Match
from aegis_cli.training import checkpoint

_EXPECTED = "a policy's weights as safetensors: LeRobot's pretrained_model folder, or openpi's"
_INSIDE = ("pretrained_model", "checkpoints/last/pretrained_model")  # in LeRobot's output folders
_OTHER_WEIGHTS = (".bin", ".pt", ".pth", ".ckpt")


@dataclass(frozen=True)
class Pair:
    """A policy and a VLM, both open, and what they have in common.

    Attributes:
        policy_at: the policy's folder, or its file.
        vlm_at: the VLM's folder.
        layers: the path of the VLM's language layers, if the user gave one.
    """

    policy: Tensors
    policy_at: Path
    vlm: Tensors
    vlm_at: Path
    layers: str | None
    match: Match


@contextlib.contextmanager
def opened(asked: Asked) -> Generator[Pair]:
    """Open both, and find the VLM's tensors in the policy's.

    Args:
        asked: the policy, as a folder, a file or a hub id, and the VLM, as `backbones.load` takes
            it.

    Raises:
        AegisError: either is missing, damaged or something else, or the policy was made from
            another VLM, or has several of them.
    """
    policy, vlm = asked.policy, asked.vlm
    at, (folder, layers) = locate(policy), _vlm(vlm)
    with (
        tensor_files.opened(_weights(at, policy)) as own,
        tensor_files.opened(tensor_files.paths(folder)) as other,
    ):
        if any("aegis" in (part.metadata or {}) for part in own.parts):
            raise _of_ours(policy)
        if not vlm_names.is_vlm(other.specs):
            raise AegisError(
                f"'{vlm}', in which no layers of a language model and of a vision model are "
                "told apart by their names",
                "a vision-language model in the layout of the Hugging Face hub",
                "give the VLM that the policy was made from",
            )
        tables = vlm_names.pair_of_tables(other.specs)
        tied = tables is None or tensor_files.equal(other, *tables)
        found = vlm_names.match(other.specs, own.specs, tied, asked)
        yield Pair(own, at, other, folder, layers, found)


def locate(name: str) -> Path:
    """The folder or file of a policy, downloaded if it is an id on the hub.

    Raises:
        AegisError: neither here nor downloadable.
    """
    path = Path(name)
    if path.exists():
        return path
    if hub.is_local(name) or not hub.is_installed():
        fix = f"check the path{hub.not_asked(name)}"
        if not hub.is_local(name):
            fix += ", or pip install 'aegis-vla[hub]', which asks the hub for it"
        raise AegisError(f"no policy '{name}'", f"{_EXPECTED}, or a hub id", fix)
    try:
        return hub.snapshot(name, "model", ["*"], policy_copy.STALE_ON_HUB)
    except (OSError, ValueError) as error:
        raise AegisError(
            f"no folder '{name}', and no policy of that name from the Hugging Face hub: "
            f"{in_short(error)}",
            f"{_EXPECTED}, or a hub id with a network (and, for a private policy, a token)",
            f"check the path; or, on a machine with a network: hf download {name} "
            "--local-dir POLICY; then give POLICY",
        ) from error


def _weights(at: Path, name: str) -> Sequence[Path]:
    """The files of a policy's weights.

    Raises:
        AegisError: a policy of ours, an adapter, or no weights in safetensors.
    """
    files.refuse_special(at)
    if at.is_file():
        if at.suffix != ".safetensors":
            raise AegisError(f"'{name}', no .safetensors file", _EXPECTED, "give its folder")
        return [at]
    own = recipes.is_stream_run(at) or (at / "recipe.yaml").is_file()
    if own or checkpoint.is_one(at) or model_folder.is_policy(at):
        raise _of_ours(name)
    model_folder.refuse_adapter(at)
    if found := tensor_files.paths(at):
        return found
    fix = "check the path"
    others = [p.name for p in sorted(at.iterdir()) if p.suffix in _OTHER_WEIGHTS]
    inside = next((at / part for part in _INSIDE if (at / part).is_dir()), None)
    if inside is not None:
        fix = f"give '{inside}'"
    elif (at / "params").is_dir():
        fix = (
            "of a checkpoint of openpi in JAX, convert it first, by openpi's own "
            "examples/convert_jax_model_to_pytorch.py"
        )
    elif others:
        fix = "save its state_dict by safetensors.torch.save_file, with the names of its modules"
    found_there = f", but {', '.join(others[:3])}" if others else ""
    raise AegisError(f"no *.safetensors in '{name}'{found_there}", _EXPECTED, fix)


def _of_ours(name: str) -> AegisError:
    return AegisError(
        f"'{name}', which Aegis has trained",
        "a policy that another program trained",
        f"its VLM is a model already: {commands.aegis('probe', name)}, and --backbone takes it, "
        f"too; for LeRobot: {commands.aegis('export', name, '--out', 'FOLDER')}",
    )


def _vlm(name: str) -> tuple[Path, str | None]:
    """The folder of a Hugging Face VLM, and the path of its layers, if the name has one.

    Raises:
        AegisError: no model, or another kind of model.
    """
    path = backbones.locate(name)
    if not path.is_dir():
        raise AegisError(
            f"'{name}', which is no Hugging Face model",
            "the vision-language model that the policy was made from, as a folder or a hub id",
            "give that one, e.g. HuggingFaceTB/SmolVLM2-500M-Video-Instruct of SmolVLA, or "
            "google/paligemma-3b-pt-224 of pi0",
        )
    backbones.need_transformers(name)
    from aegis_cli.models.backbones import hf

    hf.check(path)
    return path, backbones.divided(name)[1]
