"""What a dry run says of memory, beside what the training takes: the table of docs/own-data.md.

    python docs/dry_run_memory.py --backbone random:smolvlm2-256m --methods naive,lora
    python docs/dry_run_memory.py --backbone random:smolvlm2-256m --set train.freeze=vision

Each dry run, and each training of three steps with its checkpoint, is in a process of its own. They
train on frames of noise, by anchors of eight questions. What is printed: MB as they were estimated,
as the dry run measured them, and as the training took them.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import torch
import transformers  # noqa: F401 - else a backbone of Hugging Face loads it, as part of its memory

from aegis_cli import methods, recipes
from aegis_cli.anchors import measure
from aegis_cli.common import devices, memory
from aegis_cli.evaluation import bench, bench_runs
from aegis_cli.recipes import Anchor, Recipe
from aegis_cli.training import dry_run, train

Inputs = tuple[Recipe, str, Path, Path | None, Path]


def planned(inputs: Inputs) -> tuple[float, float | None]:
    """MB as a dry run estimates them, and as it measures them."""
    torch.set_num_threads(1)
    report = dry_run.run(*inputs)
    return report.memory_total_mb, report.memory_measured_mb


def taken(inputs: Inputs) -> float:
    """MB that the training takes."""
    torch.set_num_threads(1)
    device = devices.pick()
    before = memory.restart_peak(device)
    train.run(*inputs)
    return (memory.peak(device) - before) / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--backbone", default="embedded")
    parser.add_argument("--methods", default="naive")
    parser.add_argument("--batch-size", type=int, default=2)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    given = parser.parse_args()
    steps = {"steps": 3, "checkpoint_every": 3, "validate_every": 3, "warmup": 0}
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        for method in given.methods.split(","):
            settings = steps | {"method": method, "batch_size": given.batch_size}
            raw = {"name": method, "backbone": given.backbone, "train": settings}
            recipe, anchor = recipes.from_mapping(raw, given.set), None
            bench_runs.save_demos(out, recipe.task)
            if parts := methods.get(method).needs:
                anchor = out / f"{method}.safetensors"
                asked = Anchor(samples=8, fisher_samples=8, batch_size=2, parts=tuple(parts))
                bench.in_new_process(measure.run, given.backbone, asked, anchor)
            demos = bench_runs.demos_file(out, recipe.task)
            inputs = (recipe, method, demos, anchor, out / method)
            estimated, measured = bench.in_new_process(planned, inputs)
            told = "no step" if measured is None else f"{measured:,.0f}"
            really = bench.in_new_process(taken, inputs)
            print(f"{method}: estimated {estimated:,.0f}, measured {told}, taken {really:,.0f} MB")


if __name__ == "__main__":
    main()
