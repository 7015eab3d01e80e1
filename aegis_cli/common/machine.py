"""The machine and the versions that a result was made with."""

from __future__ import annotations

import contextlib
import os
import platform
from functools import cache
from importlib import metadata
from pathlib import Path

from aegis_cli.common.version import __version__

NAME = "machine.json"
_PACKAGES = ("torch", "numpy", "mujoco", "dm-control", "transformers")


def describe() -> dict[str, str | int]:
    """The facts needed to compare times or digits with those of another machine."""
    import torch

    found: dict[str, str | int] = {
        "aegis": __version__,
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()}",
        "processor": processor(),
        "cores": os.cpu_count() or 1,
        "threads": torch.get_num_threads(),
    }
    from aegis_cli.common import devices  # imports torch

    if devices.on_gpu():
        found["gpu"] = torch.cuda.get_device_name()
    return found | versions(_PACKAGES)


def name() -> str:
    """The GPU's name, else the processor's and the cores used; times compare only if equal."""
    about = describe()
    if "gpu" in about:
        return str(about["gpu"])
    cores, threads = about["cores"], about["threads"]
    used = cores if threads == cores else f"{threads} of {cores}"
    return f"{about['processor']}, {used} cores"


@cache
def versions(packages: tuple[str, ...]) -> dict[str, str]:
    """The versions of the installed packages; cached, as finding one parses all its metadata."""
    found: dict[str, str] = {}
    for package in packages:
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[package] = metadata.version(package)
    return found


def processor() -> str:
    """The processor's model, if the system reports it."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            name, _, value = line.partition(":")
            if name.strip() == "model name":
                return value.strip()
    return platform.processor() or platform.machine()
