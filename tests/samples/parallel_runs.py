"""Trainings and whole jobs with several processes, which find these by their module."""

from __future__ import annotations

import contextlib
import io
import os
import random
import socket
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Protocol

import pytest
import torch
from torch import nn

from aegis_cli.anchors import kept_work, measure
from aegis_cli.cli.app import app
from aegis_cli.common import cache, files, kept_tensors, launch, leading, ranks
from aegis_cli.common.errors import AegisError, Diverged, PeerLost
from aegis_cli.common.events import Event, OnEvent, Progress, ignore
from aegis_cli.evaluation import probe
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.recipes import Anchor, Recipe
from aegis_cli.studies import pipeline
from aegis_cli.training import dry_run, loading, train
from samples import processes


class Runnable(Protocol):
    """What processes do together; it is pickled and sent to them."""

    def run(self) -> None:
        """Do it here."""


@dataclass(frozen=True)
class Job:
    """One training.

    Attributes:
        killed_after: step after which its first process is killed without a message.
        resume: whether it resumes what is there.
    """

    recipe: Recipe
    method: str
    demos: Path
    anchor: Path | None
    out: Path
    killed_after: int | None = None
    resume: bool = False

    def run(self) -> None:
        """Train here, alone or with the processes that the environment describes."""

        def die(event: Event) -> None:
            if not isinstance(event, Progress) or event.stage != "train":
                return
            if event.done == self.killed_after:
                os._exit(1)

        train.run(
            self.recipe,
            self.method,
            self.demos,
            self.anchor,
            self.out,
            resume=self.resume,
            on_event=die,
        )


@dataclass(frozen=True)
class Averaging(Job):
    """A training of a backbone that averages the pixels it reads."""

    def run(self) -> None:
        """Train here, alone or with the processes that the environment describes."""
        load = loading.backbones.load

        def averaging(name: str) -> Backbone:
            backbone = load(name)
            backbone.stem.norm = nn.BatchNorm2d(3)
            backbone.stem.register_forward_pre_hook(lambda stem, given: stem.norm(*given))
            return backbone

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(loading.backbones, "load", averaging)
            super().run()


@dataclass(frozen=True)
class Planning:
    """A dry run of a training.

    Attributes:
        said: folder in which each process writes its report.
    """

    job: Job
    said: Path

    def run(self) -> None:
        """Plan here, alone or with the processes that the environment describes."""
        job = self.job
        report = dry_run.run(job.recipe, job.method, job.demos, job.anchor, job.out)
        files.make_folder(self.said)
        files.save_json(self.said / f"{launch.rank()}.json", report.to_json())


@dataclass(frozen=True)
class Measuring:
    """An anchor, and a probe of the model on which it was measured."""

    model: Path
    out: Path

    def run(self) -> None:
        """Measure here, alone or with the processes that the environment describes."""
        self.out.mkdir(exist_ok=True, parents=True)
        parts = ("moments", "inputs", "fisher", "curvature")
        settings = Anchor(samples=35, batch_size=4, parts=parts, fisher_samples=5)
        measure.run(str(self.model), settings, self.out / "anchor.safetensors")
        predictions = self.out / "predictions.jsonl"
        probe.run(
            str(self.model), "scenes", 21, None, None, None, batch_size=4, predictions=predictions
        )


@dataclass(frozen=True)
class MeasuringAgain:
    """An anchor that is interrupted, and measured again.

    Attributes:
        cache: where what is measured is kept.
        memory: bytes of a group of maps' sums.
        stops: how often each process has kept something when it ends; None: none ends.
        lost: whether the last process finds nothing of its own.
    """

    model: Path
    out: Path
    cache: Path
    settings: Anchor
    memory: int
    stops: Sequence[int] | None
    lost: bool

    def run(self) -> None:
        """Measure here, alone or with the processes that the environment speaks of."""
        self.out.mkdir(exist_ok=True, parents=True)
        # The two measurements share one meeting. At a second one by the same port, a process might
        # still find the first.
        with ranks.joined(), pytest.MonkeyPatch.context() as patch:
            patch.setenv("AEGIS_CACHE", str(self.cache))
            patch.setattr(measure._PartMeasurement, "_memory", self.memory)
            patch.setattr(kept_work, "_EVERY_S", 0.0)
            patch.setattr(kept_work, "_TIMES", 0)
            if self.stops is not None:
                self._begin(self.stops)
            begun: dict[str, int] = {}

            def note(event: Event) -> None:
                if isinstance(event, Progress) and event.stage.startswith("anchor"):
                    begun.setdefault(event.stage, event.done)

            measure.run(str(self.model), self.settings, self.out / "anchor.safetensors", note)
            assert any(begun.values()) == (self.stops is not None)

    def _begin(self, stops: Sequence[int]) -> None:
        """Keep so many times; what comes later is not kept, as if this process had ended."""
        plain, written = kept_tensors.write, 0

        def write(path: Path, kept: kept_tensors.Kept) -> None:
            nonlocal written
            written += 1
            if written <= stops[launch.rank()]:
                plain(path, kept)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(kept_tensors, "write", write)
            patch.setattr(kept_work.Work, "remove", lambda _: None)
            patch.setattr(kept_work.Work, "forget", lambda *_: None)
            measure.run(str(self.model), self.settings, self.out / "begun.safetensors")
        own = list(cache.folder("anchors").glob(f"*process-{launch.rank()}"))
        assert own
        if self.lost and launch.rank():
            for path in own:
                path.unlink()


@dataclass(frozen=True)
class Waiting:
    """An anchor of moments or Fisher information, each of which the last process begins late.

    The others seem to have resumed further on.

    Attributes:
        limit_s: how long a process waits for the others' share of a sum.
        late_s: how late it is.
    """

    model: Path
    out: Path
    settings: Anchor
    limit_s: float
    late_s: float

    def run(self) -> None:
        """Measure here, alone or with the processes that the environment describes."""
        self.out.mkdir(exist_ok=True, parents=True)
        late = set[str]()

        def wait(event: Event) -> None:
            if not isinstance(event, Progress) or event.unit != "samples" or not launch.rank():
                return
            if event.stage not in late:
                late.add(event.stage)
                time.sleep(self.late_s)

        plain = torch.distributed.init_process_group
        limited = partial(plain, timeout=timedelta(seconds=self.limit_s))
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("AEGIS_CACHE", str(self.out / "cache"))
            patch.setattr(torch.distributed, "init_process_group", limited)
            measure.run(str(self.model), self.settings, self.out / "anchor.safetensors", wait)
        assert len(late) == (len(self.settings.parts) if launch.rank() else 0)


@dataclass(frozen=True)
class Piping:
    """All stages of a recipe.

    Attributes:
        said: folder in which each process writes its result: the table or the error.
    """

    recipe: Recipe
    root: Path
    said: Path

    def run(self) -> None:
        """Run it here, alone or with the processes that the environment describes."""
        events: list[str] = []
        try:
            report = pipeline.run(self.recipe, self.root, lambda event: events.append(event.stage))
            told = {"report": report.to_json()}
        except AegisError as error:
            told = {"error": [type(error).__name__, *error.args]}
        files.make_folder(self.said)
        files.save_json(self.said / f"{launch.rank()}.json", {**told, "events": events})


@dataclass(frozen=True)
class Failing:
    """The command line on a recipe that passes no gate.

    Attributes:
        said: folder in which each process writes its exit code and what it printed.
    """

    recipe: Path
    root: Path
    said: Path

    def run(self) -> None:
        """Run it here, alone or with the processes that the environment describes."""
        printed = io.StringIO()
        with (
            pytest.MonkeyPatch.context() as patch,
            contextlib.redirect_stdout(printed),
            contextlib.redirect_stderr(printed),
            pytest.raises(SystemExit) as end,
        ):
            patch.setattr(pipeline, "passes", lambda *_: False)
            app(["run", str(self.recipe), "--out", str(self.root)], prog_name="aegis")
        files.make_folder(self.said)
        told = {"code": end.value.code, "printed": printed.getvalue()}
        files.save_json(self.said / f"{launch.rank()}.json", told)


@dataclass(frozen=True)
class Leading:
    """A job with a shared part in its middle; each process notes what it did."""

    out: Path
    fails: str = ""

    def run(self) -> None:
        """Do it here, alone or with the processes that the environment describes."""
        files.make_folder(self.out)
        try:
            told = leading.led(self._job)
        except AegisError as error:
            told = error.found
        self.note(f"ended: {told}")

    def _job(self) -> str:
        self.note("alone")
        with ranks.joined() as found:
            self.note(f"one of {found.count}")
        shared = leading.together(share, self, 3, on_event=ignore, twice=True)
        if self.fails == "after":
            raise AegisError("broken", "whole", "mend it")
        return f"{shared}"

    def note(self, what: str) -> None:
        """Add a line to this process's notes."""
        with (self.out / f"{launch.rank()}.txt").open("a") as notes:
            notes.write(what + "\n")


def share(job: Leading, number: int, on_event: OnEvent, twice: bool) -> int:
    """The sum of every process's number, which is one larger in each."""
    with ranks.joined() as found:
        if job.fails == "within":
            raise Diverged("nothing finite", "numbers", "less", number)
        own = torch.tensor(number + found.rank)
        total = int(found.total(own))
    job.note(f"shared {own}, twice: {twice}")
    return total


def run_together(count: int, jobs: Sequence[Runnable]) -> None:
    """Let `count` processes do the jobs, one after the other, as if torchrun had started them."""
    processes.start(_run, (count, jobs, free_ports(len(jobs))), count)


def _run(rank: int, count: int, jobs: Sequence[Runnable], ports: Sequence[int]) -> None:
    torch.set_num_threads(1)
    for job, port in zip(jobs, ports, strict=True):
        _be_launched(rank, count, port)
        job.run()


def lose_one(rank: int, count: int, port: int) -> None:
    """The last process ends; the others notice it."""
    _be_launched(rank, count, port)
    with pytest.raises(PeerLost, match="another process"), ranks.joined() as joined:
        if rank == count - 1:
            os._exit(0)
        joined.total(torch.ones(1))


def _be_launched(rank: int, count: int, port: int) -> None:
    """Set the environment variables that torchrun sets for a process."""
    os.environ |= {
        "GLOO_SOCKET_IFNAME": "lo",
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(port),
        "RANK": str(rank),
        "LOCAL_RANK": str(rank),
        "WORLD_SIZE": str(count),
    }


def free_ports(count: int) -> list[int]:
    """Ports that are free, and that the system does not give to connections in the meantime.

    The ports that systems assign are above 32,767.
    """
    found: list[int] = []
    while len(found) < count:
        port = random.SystemRandom().randrange(20_000, 32_000)
        with contextlib.suppress(OSError), socket.socket() as tried:
            tried.bind(("127.0.0.1", port))
            if port not in found:
                found.append(port)
    return found
