"""`aegis doctor`: checks what this machine and this installation can do."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import re
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from aegis_cli.common import gl
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, OnEvent, Progress, ignore
from aegis_cli.common.version import __version__

DISTRIBUTION = "aegis-vla"
OK, MISSING, FAILED = "ok", "missing", "failed"
_LEAST_FREE_GB = 2.0  # a quickstart writes some hundred megabytes
# A whole job in miniature: every stage once, for the method that needs the most stages.
_SELF_TEST = (
    "methods=[aegis]",
    "demos.episodes=4",
    "anchor.samples=14",
    "train.steps=2",
    "train.chunk=20",  # all 20 are executed, so a rollout needs few predictions
    "train.batch_size=4",
    "train.flow_samples=1",
    "train.warmup=1",
    "train.validate_every=2",
    "train.checkpoint_every=2",
    "probe.questions=14",
    "rollout.episodes=1",
    "rollout.replan=20",
)


@dataclass(frozen=True)
class Check:
    """One line of the report.

    Attributes:
        state: "ok", "missing" for an extra that is not installed, or "failed".
        fix: what to do about it; "" if nothing.
    """

    name: str
    state: str
    found: str
    fix: str = ""


@dataclass(frozen=True)
class DoctorReport:
    """All checks, in the order of the table."""

    checks: list[Check]

    @property
    def failed(self) -> list[str]:
        """Names of failed checks; a missing extra is not a failure."""
        return [check.name for check in self.checks if check.state == FAILED]


def run(self_test: bool = True, on_event: OnEvent = ignore) -> DoctorReport:
    """Check the installation, the machine and the disk, and run a job in miniature.

    Args:
        self_test: whether to run the job, which takes half a minute or more.
    """
    checks = [
        Check("aegis", OK, __version__),
        Check("python", OK, f"{platform.python_version()} on {platform.platform(terse=True)}"),
        *_packages(),
        _attempt("torch", _torch, "pip install 'torch>=2.9'"),
        _attempt("opengl", _opengl, ""),
        _disk(Path.cwd()),
        *_extras(),
    ]
    if self_test:
        # Without the extra there is nothing to try, as its own line says.
        if not any(_version(name) is None for name in _required("hf")):
            checks.append(_attempt("hugging face", _hugging_face, "pip install -U 'aegis-vla[hf]'"))
        checks.append(_attempt("self-test", lambda: _self_test(on_event), ""))
    return DoctorReport(checks)


def _attempt(name: str, look: Callable[[], str], fix: str) -> Check:
    """Run a check; any exception is a failed check here."""
    try:
        return Check(name, OK, look())
    except AegisError as error:
        return Check(name, FAILED, error.found, error.fix)
    except Exception as error:
        return Check(name, FAILED, f"{type(error).__name__}: {error}", fix)


# --- installation ---------------------------------------------------------------------------------


def _packages() -> Iterator[Check]:
    """Each package that every command needs."""
    for name in sorted(_required(None)):
        version = _version(name)
        if version is None:
            yield Check(name, FAILED, "not installed", f"pip install {name}")
        elif name != "torch":  # torch has its own line, with the device
            yield Check(name, OK, version)


def _extras() -> Iterator[Check]:
    """Each extra that a user may want, with the packages that it lacks."""
    extras = importlib.metadata.metadata(DISTRIBUTION).get_all("Provides-Extra") or []
    for extra in extras:
        needed = _required(extra)
        if extra in ("test", "docs", "lint") or not needed:  # for developers of Aegis
            continue
        lacking = sorted(name for name in needed if _version(name) is None)
        if lacking:
            install = f"pip install '{DISTRIBUTION}[{extra}]'"
            yield Check(f"[{extra}]", MISSING, f"without {', '.join(lacking)}", install)
        else:
            versions = [f"{name} {_version(name)}" for name in sorted(needed)]
            yield Check(f"[{extra}]", OK, ", ".join(versions))


def _required(extra: str | None) -> set[str]:
    """Names of the packages of an extra; for None, those that are always needed."""
    found = set()
    for line in importlib.metadata.requires(DISTRIBUTION) or []:  # av>=15; extra == "lerobot"
        name = re.match(r"[A-Za-z0-9._-]+", line)
        marker = re.search(r"extra *== *['\"]([^'\"]+)", line)
        of_extra = marker.group(1) if marker else None
        if name and of_extra == extra:
            found.add(name.group())
    return found


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


# --- machine --------------------------------------------------------------------------------------


def _torch() -> str:
    import torch

    from aegis_cli.common import devices

    device = devices.pick()
    if device.type == "cuda":
        found = torch.cuda.get_device_properties(device)
        where = f"{found.name}, {found.total_memory / 2**30:.0f} GiB"
    else:
        where = f"CPU, {torch.get_num_threads()} threads of {os.cpu_count()} processors"
    fast = "bf16" if devices.multiplies_bf16(device) else "float32"
    return f"{torch.__version__}, {where}, matrix products in {fast} by default"


def _opengl() -> str:
    gl.check()
    return f"renders without a screen by {os.environ.get('MUJOCO_GL') or 'the default backend'}"


def _disk(folder: Path) -> Check:
    free_gb = shutil.disk_usage(folder).free / 1e9
    found = f"{free_gb:.1f} GB free in {folder}"
    if free_gb < _LEAST_FREE_GB:
        return Check("disk", FAILED, found, f"free {_LEAST_FREE_GB:g} GB, or work elsewhere")
    return Check("disk", OK, found)


def _hugging_face() -> str:
    """Let a small VLM of transformers' classes read a frame, learn from it, and answer.

    Releases of transformers change the arguments of a model's layers.
    """
    import torch

    from aegis_cli.models.backbones import of_shape, shapes

    backbone = of_shape.make(shapes.SMALL)
    images = torch.zeros(1, 32, 32, 3, dtype=torch.uint8)
    with torch.enable_grad():
        encoding = backbone.encode(backbone.prepare(images, ["reach the red disc"]))
        # The gradient of the last layer's keys and values reaches every layer below it.
        keys, values = encoding.keys_values[-1]
        (keys.sum() + values.sum()).backward()
    learned = sum(p.grad is not None for p in backbone.parameters())
    backbone.answer(images, ["what color is it"])
    return f"a small {shapes.SMALL.family} reads, learns ({learned} tensors) and answers"


def _self_test(on_event: OnEvent) -> str:
    """Record, measure, train, probe and roll out, each as small as possible."""
    from aegis_cli import recipes
    from aegis_cli.recipes import shipped
    from aegis_cli.studies import pipeline

    start_s = time.monotonic()
    recipe = recipes.load(shipped.path("quickstart"), _SELF_TEST)

    def heard(event: Event) -> None:
        if isinstance(event, Progress):  # warnings are about its few questions, on purpose
            on_event(event)

    with tempfile.TemporaryDirectory() as folder:
        pipeline.run(recipe, Path(folder), on_event=heard)
    return f"every stage ran, in {time.monotonic() - start_s:.0f} s"
