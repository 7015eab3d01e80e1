"""The device to compute on, and the precision."""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Generator

import torch
from torch import Tensor

from aegis_cli.common import launch
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Warned

# The wanted device. Child processes inherit it with the environment.
VARIABLE = "AEGIS_DEVICE"
AUTO = "auto"
EXPECTED = "auto, cpu, cuda, or cuda:N with the number of a GPU"


@contextlib.contextmanager
def chosen(name: str | None) -> Generator[None]:
    """Inside the block, `pick` takes this device; None leaves the choice as it is.

    Raises:
        AegisError: there is no such device.
    """
    if name is None:
        yield
        return
    before = os.environ.get(VARIABLE)
    os.environ[VARIABLE] = name
    try:
        pick()  # raises here, not in the middle of the work
        yield
    finally:
        if before is None:
            del os.environ[VARIABLE]
        else:
            os.environ[VARIABLE] = before


@contextlib.contextmanager
def cpu_by_default() -> Generator[None]:
    """Make the CPU the default device inside the block, or in a function that it decorates.

    A user of the library may have set another one with `torch.set_default_device`. Otherwise
    nothing is done: the mode would slow down every call of PyTorch a little.
    """
    if torch.get_default_device().type == "cpu":
        yield
        return
    with torch.device("cpu"):
        yield


def pick() -> torch.device:
    """The device that was chosen, else the GPU if there is one, else the CPU.

    It also disables TF32, to which cuDNN would round in float32 convolutions.

    Raises:
        AegisError: the chosen device does not exist.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # PyTorch 2.9 calls the setting deprecated, 2.13 does not
        torch.backends.cudnn.allow_tf32 = False
    name = os.environ.get(VARIABLE) or AUTO
    if name == AUTO:
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    kind, _, number = name.partition(":")
    if kind not in ("cpu", "cuda") or (":" in name and not (kind == "cuda" and number.isdecimal())):
        fix = f"--device cpu, or unset {VARIABLE}"
        raise AegisError(f"the device '{name}'", EXPECTED, fix)
    if kind == "cpu":
        return torch.device("cpu")
    _check_gpu(name, number)
    if number:
        torch.cuda.set_device(int(number))  # so that torch's current GPU is this one
    return torch.device(name)


def _check_gpu(name: str, number: str) -> None:
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if int(number or 0) >= count:
        found = f"the device '{name}' on a machine with {count or 'no'} GPU{'s' * (count > 1)}"
        raise AegisError(found, "a GPU that PyTorch finds", "--device cpu, or see aegis doctor")
    if number and launch.world_size() > 1:
        raise AegisError(
            f"the device '{name}' for {launch.world_size()} processes",
            "a GPU of its own for each process",
            "use --device cuda, and name the GPUs to use in CUDA_VISIBLE_DEVICES",
        )


def on_gpu() -> bool:
    """Whether `pick` takes a GPU."""
    return pick().type == "cuda"


def reading_stalls(device: torch.device) -> bool:
    """Whether reading a number from the device is a *sync*: it waits until all queued work is done.

    A GPU then idles until it gets more. So the results of steps are read only now and then, and
    whatever depends on a number within a step is computed on the device.
    """
    return device.type != "cpu"


def send(x: Tensor, device: torch.device) -> Tensor:
    """Copy a CPU tensor to a device; for a GPU, asynchronously."""
    if device.type != "cuda" or not x.is_cpu:
        return x.to(device)
    return x.pin_memory().to(device, non_blocking=True)  # only pinned memory copies asynchronously


def autocast(device: torch.device, precision: str) -> contextlib.AbstractContextManager[object]:
    """A context in which matrix products run in the dtype that `precision` names.

    `bf16` means matrix products in bfloat16, `float32` changes nothing, and `auto` is bf16 if the
    hardware multiplies in it. With AMX or on a GPU bf16 is several times faster than float32; a CPU
    without AMX took 1.7 times as long.
    """
    return torch.autocast(device.type, torch.bfloat16, enabled=takes_bf16(device, precision))


def acting_precision(device: torch.device, wanted: str) -> str:
    """The precision a policy acts in: `auto` is bf16 on a GPU that supports it, else float32.

    Raises:
        AegisError: `wanted` is not a precision.
    """
    if wanted in ("bf16", "float32"):
        return wanted
    if wanted != AUTO:
        raise AegisError(f"the precision '{wanted}'", "auto, bf16 or float32", "leave it out: auto")
    return "bf16" if device.type == "cuda" and multiplies_bf16(device) else "float32"


def takes_bf16(device: torch.device, precision: str) -> bool:
    """Whether `autocast` uses bfloat16 matrix products on the device."""
    return precision == "bf16" or (precision == "auto" and multiplies_bf16(device))


def precision_taken(device: torch.device, precision: str) -> str:
    """The precision of `autocast` on the device: bf16 or float32, with `auto` resolved."""
    return "bf16" if takes_bf16(device, precision) else "float32"


def multiplies_bf16(device: torch.device) -> bool:
    """Whether the hardware multiplies in bfloat16.

    NVIDIA GPUs do since Ampere, as do other vendors' GPUs and processors with AMX. ARM's list of
    features has no such entry, and an older torch has no list at all; both count as no.
    """
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    asked = getattr(torch.cpu, "get_capabilities", dict)
    return device.type != "cpu" or bool(asked().get("amx_bf16", False))


# torch's names for processor instructions for products in bfloat16.
_BF16_INSTRUCTIONS = ("amx_bf16", "avx512_bf16")


def warn_of_slow_bf16(device: torch.device, precision: str, on_event: OnEvent) -> None:
    """Warn if bf16 is requested explicitly and the processor is known to lack instructions for it.

    A processor whose list has no such entries, such as ARM's, may have instructions with other
    names.
    """
    if device.type != "cpu" or precision != "bf16":
        return
    listed = getattr(torch.cpu, "get_capabilities", dict)()
    known = [listed[name] for name in _BF16_INSTRUCTIONS if name in listed]
    if known and not any(known):
        text = (
            "train.precision: bf16 on a processor without instructions for it (AMX or AVX-512 "
            "BF16): a step may take many times as long as in float32; --set train.precision=auto "
            "takes bf16 only where it is faster"
        )
        on_event(Warned("train", text))


@contextlib.contextmanager
def single_threaded() -> Generator[None]:
    """Use one CPU thread inside the block.

    LAPACK's eigensolver waits at thousands of small barriers. On two cores shared with other work,
    two threads took from 3 to 280 times as long as one. The same holds for sums of thousands of
    tensors.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
