"""Loading what transformers loads: offline, without a folder's own code, and with one error."""

from __future__ import annotations

import contextlib
from collections.abc import Generator
from pathlib import Path
from typing import Any, TypeVar

import torch
from huggingface_hub.errors import StrictDataclassError
from safetensors import SafetensorError
from torch import nn
from transformers.utils import is_torchvision_available, logging

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError, in_short
from aegis_cli.models.backbones import model_folder

T = TypeVar("T", bound=nn.Module)
# Arguments of `from_pretrained`: no network, and no code out of a model folder.
SAFE: dict[str, Any] = {"local_files_only": True, "trust_remote_code": False}

# What transformers raises on folders that lack something, are damaged, or hold what its classes
# refuse.
_UNLOADABLE = (
    OSError,
    ValueError,
    RuntimeError,
    KeyError,
    TypeError,
    AttributeError,
    ImportError,
    SafetensorError,
    StrictDataclassError,
)


@contextlib.contextmanager
def loading(folder: Path, what: str) -> Generator[None]:
    """What transformers finds wrong with a folder, as the one error a user sees."""
    try:
        yield
    except _UNLOADABLE as error:
        # A Git LFS pointer in the place of weights has an error of its own, with its cure.
        for path in model_folder.weights(folder):
            files.refuse_pointer(path)
        if "torchvision" in str(error).lower():
            raise AegisError(
                f"the {what} in '{folder}' needs torchvision, which is not installed",
                "torchvision, of the version that belongs to the installed torch",
                "pip install torchvision",
            ) from error
        fix = "download or export the model again"
        if what == "processor" and not is_torchvision_available():
            # Earlier releases of transformers do not know such a processor then.
            fix += ", or `pip install torchvision`, which its images may need"
        raise AegisError(
            f"the {what} in '{folder}' does not load: {in_short(error)}",
            f"a complete {what} folder of the Hugging Face hub",
            fix,
        ) from error


def complete(kind: Any, folder: Path, config: Any) -> Any:
    """The model of class `kind` in a folder, in float32.

    Raises:
        AegisError: weights that are missing, left over, or of another shape than the config's.
    """
    model, report = kind.from_pretrained(
        folder,
        config=config,
        dtype=torch.float32,
        use_safetensors=True,
        output_loading_info=True,
        ignore_mismatched_sizes=True,  # they are refused below, with their names
        **SAFE,
    )
    model_folder.check_complete(folder, report)
    return model


@contextlib.contextmanager
def quiet() -> Generator[None]:
    """Without transformers' warnings and bars: what matters of them is an error here."""
    level, bars = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity_error()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        logging.set_verbosity(level)
        if bars:
            logging.enable_progress_bar()


def without_dropout(model: T) -> T:
    """Set every dropout of the model to 0; the configuration that is saved stays as it is.

    This holds in training mode too, which checkpointing needs. So the expert reads what the anchor
    was measured on, a step depends on nothing but its number, and validation is not left to chance.
    """
    for module in model.modules():
        # Attention modules keep their rate as a number of their own, without an `nn.Dropout`.
        for name, value in list(vars(module).items()):
            is_rate = name.endswith("dropout") or (name == "p" and isinstance(module, nn.Dropout))
            if is_rate and isinstance(value, float):
                setattr(module, name, 0.0)
    return model
