"""Trainings that several processes share; a spawned process finds these by their module."""

from __future__ import annotations

import os
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import multiprocessing

from aegis_cli.common.events import Progress
from aegis_cli.recipes import Recipe
from aegis_cli.training import train


@dataclass(frozen=True)
class Job:
    """One training.

    Attributes:
        stop_at: step after which it is interrupted.
        resume: whether it goes on with what is there.
    """

    recipe: Recipe
    method: str
    demos: Path
    anchor: Path
    out: Path
    stop_at: int | None = None
    resume: bool = False

    def run(self) -> None:
        """Train here, alone or with the processes that the environment speaks of."""

        def interrupt(event: Progress) -> None:
            if event.done == self.stop_at:
                raise KeyboardInterrupt

        options: dict[str, Any] = {"resume": self.resume, "on_event": interrupt}
        train.run(self.recipe, self.method, self.demos, self.anchor, self.out, **options)


def run_together(count: int, jobs: Sequence[Job]) -> None:
    """Let `count` processes do the jobs, one after the other, as torchrun would start them."""
    multiprocessing.spawn(_run, args=(count, jobs, [_free_port() for _ in jobs]), nprocs=count)


def _run(rank: int, count: int, jobs: Sequence[Job], ports: Sequence[int]) -> None:
    torch.set_num_threads(1)
    os.environ |= {
        "GLOO_SOCKET_IFNAME": "lo",
        "MASTER_ADDR": "127.0.0.1",
        "RANK": str(rank),
        "LOCAL_RANK": str(rank),
        "WORLD_SIZE": str(count),
    }
    for job, port in zip(jobs, ports, strict=True):
        os.environ["MASTER_PORT"] = str(port)
        job.run()


def _free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])
