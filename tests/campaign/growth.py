"""Memory over a long training: `python tests/campaign/growth.py --steps 20000`.

What may grow is the ledger: a row per step, in buffers that double.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import resource
import sys
import tempfile
from pathlib import Path

TESTS = Path(__file__).parent.parent
sys.path.insert(0, str(TESTS))
os.environ["OMP_NUM_THREADS"] = "1"

from samples import small_run  # noqa: E402
from samples.tiny import make_tiny  # noqa: E402

from aegis_cli.anchors import measure as anchors  # noqa: E402
from aegis_cli.common import artifacts  # noqa: E402
from aegis_cli.common.events import Progress  # noqa: E402
from aegis_cli.data import record  # noqa: E402
from aegis_cli.recipes import Anchor, Rollout  # noqa: E402
from aegis_cli.training import train  # noqa: E402


def resident_bytes() -> int:
    """What this process has in memory."""
    pages = Path("/proc/self/statm").read_text(encoding="utf-8").split()[1]
    return int(pages) * resource.getpagesize()


def measure(folder: Path, steps: int, points: int) -> tuple[dict[int, int], int]:
    """Train tiny steps with method aegis.

    Returns:
        Resident memory [bytes] after as many steps, at `points` steps; and the ledger's [bytes].
    """
    make_tiny().save(folder / "model")
    demos, anchor, out = (folder / name for name in ("demos.sft", "anchor.sft", "run"))
    record.run("point", 4, 0, demos, workers=1)
    settings = Anchor(samples=14, batch_size=14, parts=("moments",))
    anchors.run(str(folder / "model"), settings, anchor)
    recipe = small_run.recipe(
        folder / "model",
        steps=steps,
        batch_size=1,
        flow_samples=1,
        chunk=2,
        checkpoint_every=max(steps // 4, 1),
        validate_every=steps,
        log_every=10,
    )
    recipe = dataclasses.replace(recipe, task="point", rollout=Rollout(replan=2))
    found: dict[int, int] = {}

    def note(event: Progress) -> None:
        if event.stage == "train" and event.done and event.done % (steps // points) == 0:
            found[event.done] = resident_bytes()

    train.run(recipe, "aegis", demos, anchor, out, on_event=note)
    ledger = artifacts.load(out / train.LEDGER, "ledger")
    return found, sum(tensor.nbytes for tensor in ledger.tensors.values())


def main() -> None:
    parser = argparse.ArgumentParser(prog="python tests/campaign/growth.py", description=__doc__)
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--points", type=int, default=20)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found, ledger = measure(Path(folder), options.steps, options.points)
    for step, size in found.items():
        print(f"{step} {size}")
    print(f"ledger {ledger}")


if __name__ == "__main__":
    main()
