"""Download a policy that `aegis push` has sent to the hub into the hub's own cache."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from aegis_cli.common import files, hub
from aegis_cli.common.errors import AegisError, in_short
from aegis_cli.models import lerobot_folder
from aegis_cli.models.backbones import model_folder

_EXPERT = "expert.safetensors"  # of a checkpoint's layout
# All files of a checkpoint's layout, and the small ones of LeRobot's. In other repositories, hardly
# more than a configuration matches.
_PARTS = (lerobot_folder.CONFIG, _EXPERT, f"{lerobot_folder.BACKBONE}/*")
_CARDS = ("*.md",)


def locate(name: str | Path) -> Path:
    """The folder of a run, a checkpoint or an exported policy, downloaded from the hub if needed.

    A path that does not exist and cannot be an id is returned unchanged: its reader reports what is
    missing.

    Args:
        name: a path as the user wrote it, or the id of a policy on the hub, which is downloaded.

    Raises:
        AegisError: it is not here and cannot be downloaded, or the repository has no policy of
            Aegis.
    """
    # A path on the disk takes precedence over a hub id of the same name, which needs the network.
    path = Path(name)
    return path if path.exists() or hub.is_local(str(name)) else fetch(str(name))


def fetch(name: str) -> Path:
    """The local folder of a policy on the hub, with its newest files except its model card.

    Raises:
        AegisError: neither in the cache nor downloadable, or a repository without a policy of ours.
    """
    if not hub.is_installed():
        raise AegisError(
            f"no run or policy '{name}', and no package 'huggingface_hub' to ask the hub for it",
            "a local folder, or the package that downloads one",
            "check the path, or pip install 'aegis-vla[hub]'",
        )
    folder = _snapshot(name, _PARTS)
    config = folder / lerobot_folder.CONFIG
    if config.is_file() and lerobot_folder.is_own_config(config.read_bytes()):
        # Its weights have the same file name as any model's, so they are requested only now.
        return _snapshot(name, (*_PARTS, lerobot_folder.MODEL))
    if (folder / _EXPERT).is_file() and (folder / lerobot_folder.BACKBONE).is_dir():
        return folder
    fix = (
        "check the name; if the policy is in a folder of the repository: "
        f"hf download {name} --include 'FOLDER/*' --local-dir POLICY; then give POLICY/FOLDER"
    )
    if model_folder.foreign_policy(folder) is not None:
        fix += f"; {model_folder.take_out(name)}"
    raise AegisError(
        f"the repository '{name}' of the hub has no policy of Aegis{_instead(config)}",
        f"what aegis push sends: {_EXPERT} and {lerobot_folder.BACKBONE}/, or LeRobot's layout "
        f"with {lerobot_folder.CONFIG} of the type {lerobot_folder.TYPE}",
        fix,
    )


def _instead(config: Path) -> str:
    """What a repository without a policy of Aegis contains instead, by its configuration."""
    if not config.is_file():
        return f", nor a {config.name}"
    try:
        said = files.parse_json(config.read_bytes())
    except ValueError:
        return f", and a {config.name} that is not JSON"
    for key, what in (("type", "a policy of the type"), ("model_type", "a model of the family")):
        if isinstance(said, dict) and isinstance(said.get(key), str):
            return f", but {what} '{said[key]}'"
    return ""


def _snapshot(name: str, wanted: Sequence[str]) -> Path:
    try:
        return hub.snapshot(name, "model", wanted, unwanted=_CARDS)
    except (OSError, ValueError) as error:
        raise AegisError(
            f"no run or folder '{name}', and no policy of that name from the Hugging Face hub: "
            f"{in_short(error)}",
            "the folder of a run, a checkpoint or an exported policy, or a hub id with a network "
            "(and, for a private policy, a token)",
            f"check the path; or, on a machine with a network: hf download {name} --local-dir "
            "POLICY; then give POLICY",
        ) from error
