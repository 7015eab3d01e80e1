"""Load models with transformers: offline, without a folder's own code, and with one clear error."""

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

# What transformers raises for folders that are incomplete, damaged, or refused by its classes.
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
    """Turn transformers' errors about a folder into the one error that a user sees."""
    try:
        yield
    except _UNLOADABLE as error:
        # A Git LFS pointer in place of weights has its own error, which says what to do.
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
            # In that case, earlier releases of transformers do not know the processor.
            fix += ", or `pip install torchvision`, which its images may need"
        raise AegisError(
            f"the {what} in '{folder}' does not load: {in_short(error)}",
            f"a complete {what} folder of the Hugging Face hub",
            fix,
        ) from error


def complete(kind: Any, folder: Path, config: Any) -> Any:
    """The model of class `kind` in a folder, in float32.

    Raises:
        AegisError: weights that are missing, unexpected, or of another shape than in the config.
    """
    model, report = kind.from_pretrained(
        folder,
        config=config,
        dtype=torch.float32,
        use_safetensors=True,
        output_loading_info=True,
        ignore_mismatched_sizes=True,  # refused below, by name
        **SAFE,
    )
    model_folder.check_complete(folder, report)
    return model


@contextlib.contextmanager
def quiet() -> Generator[None]:
    """Silence transformers' warnings and progress bars; those that matter are errors here."""
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
    """Set every dropout of the model to 0; the configuration that is saved does not change.

    This also holds in training mode, which gradient checkpointing needs. So the expert reads what
    the anchor was measured on, a step depends only on its number, and validation is deterministic.
    """
    for module in model.modules():
        # Attention modules store their rate as a plain number, without an `nn.Dropout`.
        for name, value in list(vars(module).items()):
            is_rate = name.endswith("dropout") or (name == "p" and isinstance(module, nn.Dropout))
            if is_rate and isinstance(value, float):
                setattr(module, name, 0.0)
    return model
