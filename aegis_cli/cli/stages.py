"""Which stage does a command's work for each kind of recipe, and how its report is shown.

Stages are named here and imported only when they run, so that `aegis --help` needs neither torch
nor OpenGL.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Generator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any, NamedTuple

from rich.console import RenderableType

from aegis_cli.cli import render
from aegis_cli.common import garbage, launch
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import ignore
from aegis_cli.recipes import (
    DualRecipe,
    PretrainRecipe,
    Recipe,
    RobotStreamRecipe,
    RobotStreamStudyRecipe,
    StreamRecipe,
    StreamStudyRecipe,
    StudyRecipe,
)


class Stage(NamedTuple):
    """A module with a function `run`, and the view of its report.

    Attributes:
        shared: whether processes started by torchrun share its work; the first one shows the
            report.
    """

    name: str
    view: Callable[[Any], RenderableType]
    shared: bool = False

    @property
    def module(self) -> Any:
        """The stage's module, imported on first use."""
        name = f"aegis_cli.{self.name}"
        if name in sys.modules:
            return sys.modules[name]
        with garbage.left_out():
            return importlib.import_module(name)

    def run(
        self,
        *args: Any,
        as_json: bool,
        device: str | None = None,
        wide: bool = False,
        **options: Any,
    ) -> Any:
        """Run the stage with a progress display, show its report and return it.

        Args:
            device: the device to compute on; None chooses by what the machine has.
            wide: whether a table's lines may be wider than the terminal.

        Raises:
            AegisError: there are several processes but the stage is for one, or there is no such
                device.
        """
        if not self.shared:
            launch.check_one()  # before the import, which takes seconds
        with computing_on(device):
            if launch.rank() > 0:  # only the first process prints
                return self.module.run(*args, on_event=ignore, **options)
            with render.progress() as on_event:  # shown while the stage is imported, too
                report = self.module.run(*args, on_event=on_event, **options)
        render.show(report, self.view, as_json, wide)  # after the progress bar has ended
        return report


def computing_on(device: str | None) -> AbstractContextManager[None]:
    """A context in which stages compute on this device; None leaves the choice unchanged."""
    if device is None:
        return nullcontext()
    from aegis_cli.common import devices  # imports torch

    return devices.chosen(device)


def joined(device: str | None) -> AbstractContextManager[None]:
    """Let no process of a launcher leave the block before the first one has finished writing.

    If a process ends with an exit code other than 0, torchrun ends all others.
    """
    if launch.world_size() == 1:
        return nullcontext()  # the same as below for one process, but without torch
    return _joined(device)


@contextmanager
def _joined(device: str | None) -> Generator[None]:
    from aegis_cli.common import ranks  # imports torch

    # The device first, because processes on GPUs use another backend than those on CPUs.
    with computing_on(device), ranks.joined():
        yield


DEMOS = Stage("data.record", render.measured)
ANCHOR = Stage("anchors.measure", render.facts, shared=True)
PLAN = Stage("studies.plan", render.plan)
DRY_RUN = Stage("training.dry_run", render.facts, shared=True)
DRY_RUN_STREAM = Stage("continual.dry_run", render.facts)
MERGE = Stage("merging.merge", render.merge)
PROBE = Stage("evaluation.probe", render.probe, shared=True)
PROBE_STREAM = Stage("continual.probe", render.stream_probe)
EXPORT = Stage("publishing.export", render.facts)
PUSH = Stage("publishing.push", render.facts)
EXTRACT = Stage("publishing.extract", render.extracted)
INSERT = Stage("publishing.insert", render.inserted)
ROLLOUT = Stage("evaluation.rollout", render.measured)
EVALUATE = Stage("evaluation.open_loop", render.open_loop)
EVALUATE_STREAM = Stage("continual.evaluate", render.open_loop)
DOCTOR = Stage("cli.doctor", render.doctor)
SCORES = Stage("evaluation.harness_scores", render.scores)
COMPARE = Stage("reporting.compare", render.compared)
COMPARE_STREAMS = Stage("reporting.compare_streams", render.compared_streams)
BENCH = Stage("evaluation.bench", render.bench)
BENCH_SHAPES = Stage("evaluation.bench_shapes", render.bench_shape)
LATENCY = Stage("serving.latency", render.facts)

# The stages of `train`, `pretrain` and `run` for each kind of recipe.
TRAIN: dict[type, Stage] = {
    Recipe: Stage("training.train", render.trained, shared=True),
    StreamRecipe: Stage("continual.train", render.stream),
    RobotStreamRecipe: Stage("continual.train", render.stream),
}
PRETRAIN: dict[type, Stage] = {
    PretrainRecipe: Stage("pretraining.vlm", render.pretrain),
    DualRecipe: Stage("pretraining.dual", render.dual),
}
RUN: dict[type, Stage] = {
    Recipe: Stage("studies.pipeline", render.pipeline, shared=True),
    StudyRecipe: Stage("studies.study", render.study),
    StreamStudyRecipe: Stage("studies.study", render.stream_study),
    RobotStreamStudyRecipe: Stage("studies.study", render.robot_stream_study),
}


def refuse_options(given: Sequence[str], stream: str) -> None:
    """Raise AegisError if options are given that have no meaning for a stream."""
    if given:
        names = ", ".join(given)
        found = f"{names} with the stream {stream}"
        raise AegisError(found, "no such option for a stream", f"leave out {names}")
