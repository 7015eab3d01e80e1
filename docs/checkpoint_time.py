"""How long a checkpoint takes to save, beside a plain write: the table of docs/performance.md.

    python docs/checkpoint_time.py --backbone random:smolvlm2-256m

One step of `stop-gradient` on frames of noise is taken, and the checkpoint after it saved. Then as
many bytes are written to one file of the same disk, which is waited for. What is printed: MB, and
the seconds of both.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path

from aegis_cli import methods, recipes
from aegis_cli.common.events import ignore
from aegis_cli.evaluation import bench_runs
from aegis_cli.training import assemble, folder, train

METHOD = "stop-gradient"
PART = 2**26  # bytes that are written at a time


def saved(backbone: str, place: Path) -> tuple[int, float]:
    """Bytes of a checkpoint, and the seconds that it took to save."""
    raw = {"name": "x", "backbone": backbone, "train": {"method": METHOD, "batch_size": 2}}
    recipe = recipes.from_mapping(raw, [])
    bench_runs.save_demos(place, recipe.task)
    demos, out = bench_runs.demos_file(place, recipe.task), place / "run"
    run = assemble.build(recipe, methods.get(METHOD), demos, None, out, ignore)
    folder.begin(out, recipe)
    with train.batches_of(run, range(1)) as batches:
        train.update(run, 0, next(batches), train.Window())
    started = time.perf_counter()
    run.save_checkpoint(1)
    seconds = time.perf_counter() - started
    files = [path for path in out.rglob("*") if path.is_file() and not path.is_symlink()]
    return sum(path.stat().st_size for path in files), seconds


def written(size: int, place: Path) -> float:
    """Seconds in which so many bytes reach the disk, written one after the other."""
    part = os.urandom(PART)
    started = time.perf_counter()
    with open(place / "plain", "wb") as file:
        for first in range(0, size, PART):
            file.write(part[: size - first])
        file.flush()
        os.fsync(file.fileno())
    return time.perf_counter() - started


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--backbone", default="embedded")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        size, seconds = saved(given.backbone, Path(place))
        plain = written(size, Path(place))
    print(f"{size / 1e6:,.0f} MB: saved in {seconds:.1f} s, written plainly in {plain:.1f} s")


if __name__ == "__main__":
    main()
