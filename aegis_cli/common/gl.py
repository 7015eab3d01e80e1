"""Headless rendering: choose an OpenGL backend before importing MuJoCo, or say what is missing."""

from __future__ import annotations

import contextlib
import ctypes.util
import importlib
import os
import sys

from aegis_cli.common import interrupts
from aegis_cli.common.errors import AegisError

# For each backend, the library that it loads and the Debian or Ubuntu package that provides it.
_LIBRARY = {
    "egl": ("EGL", "libegl1"),
    "osmesa": ("OSMesa", "libosmesa6"),
    "glfw": ("glfw", "libglfw3"),
}


def choose_backend() -> str:
    """Set and return `MUJOCO_GL`: the user's value if set, else `egl`, else `osmesa`.

    Raises:
        AegisError: the library the backend needs is not on this machine.
    """
    # For pictures of 64 x 64 pixels, threads in Mesa's software renderer do not pay off.
    os.environ.setdefault("LP_NUM_THREADS", "0")
    chosen = os.environ.get("MUJOCO_GL", "").strip().lower()
    if sys.platform != "linux":  # other systems render without a window by themselves
        return chosen or "default"
    _import_triton()
    if chosen:
        _check_library(chosen)
        return chosen
    for backend in ("egl", "osmesa"):
        if ctypes.util.find_library(_LIBRARY[backend][0]):
            os.environ["MUJOCO_GL"] = backend
            return backend
    raise AegisError(
        "neither libEGL nor libOSMesa on this machine",
        "an OpenGL library that renders without a screen",
        "sudo apt-get install libegl1 libegl-mesa0   (or libosmesa6)",
    )


def _import_triton() -> None:
    """Import triton, if it is installed, before Mesa's renderer.

    It comes with PyTorch for GPUs, and transformers imports it. Triton and Mesa each contain a copy
    of LLVM: once Mesa's is in use, importing triton crashes the process with a segmentation fault.
    """
    with contextlib.suppress(ImportError):
        importlib.import_module("triton")


def _check_library(backend: str) -> None:
    if backend not in _LIBRARY:
        raise AegisError(
            f"MUJOCO_GL={backend}",
            f"one of {', '.join(_LIBRARY)}",
            "unset MUJOCO_GL, or: export MUJOCO_GL=egl",
        )
    library, package = _LIBRARY[backend]
    if not ctypes.util.find_library(library):
        raise AegisError(
            f"MUJOCO_GL={backend}, but lib{library} is not installed",
            f"an OpenGL library for the '{backend}' backend",
            f"sudo apt-get install {package}" + (" libegl-mesa0" if backend == "egl" else ""),
        )


def check() -> None:
    """Open an OpenGL context once, so that a missing driver is found before any work starts.

    Raises:
        AegisError: no OpenGL context can be created; the message names the package to install.
    """
    backend = choose_backend()
    try:
        import mujoco

        with interrupts.deferred():  # a half-created context cannot be closed
            context = mujoco.GLContext(8, 8)
            context.make_current()
            context.free()
    except Exception as error:
        # Each backend fails in its own way, down to an AttributeError on None.
        raise AegisError(
            f"MUJOCO_GL={backend} cannot open an OpenGL context ({type(error).__name__}: {error})",
            "an OpenGL driver that renders without a screen",
            "sudo apt-get install libegl1 libegl-mesa0   (or libosmesa6, with MUJOCO_GL=osmesa); "
            "if that is installed, memory may be short: see ulimit -v",
        ) from error
