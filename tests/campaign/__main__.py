"""The whole campaign: `python -m tests.campaign --mutations 10000 --kills 200`.

Cases are numbered, and what became of each is a line of --state; those that are there are not tried
again, so that a campaign goes on where it was stopped.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

TESTS = Path(__file__).parent.parent
sys.path.insert(0, str(TESTS))
os.environ["OMP_NUM_THREADS"] = "1"  # a process that has threads does not fork well
os.environ["HF_HUB_OFFLINE"] = "1"
os.environ["AEGIS_CACHE"] = "cache"  # in the folder of each case
os.environ.pop("COLUMNS", None)

from campaign import kills, subjects, troubles, warm, world  # noqa: E402


def main() -> int:
    options = _options()
    with tempfile.TemporaryDirectory(dir=options.scratch) as folder:
        root = world.build(Path(folder) / "world")
        warm.up(root)
        chosen = [each for each in subjects.SUBJECTS if options.only in each.name]
        chosen = chosen or list(subjects.SUBJECTS)
        cases = subjects.Cases(root, Path(folder) / "mutations", options.seed, chosen)
        ends = kills.Cases(root, Path(folder) / "kills", options.seed)
        others = troubles.Cases(root, Path(folder) / "troubles", options.seed, options.only)
        kinds: dict[str, Callable[[int], Any]] = {
            "mutations": cases.run,
            "kills": ends.run,
            "troubles": others.run,
        }
        if options.one is not None:
            kind, _, number = options.one.partition(":")
            print(kinds[kind](int(number)))
            return 0
        part, _, parts = options.share.partition("/")
        for kind, run in kinds.items():
            numbers = range(int(part), getattr(options, kind), int(parts))
            _each(kind, numbers, run, options.state)
    return _report(options.state)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.campaign", description=__doc__)
    parser.add_argument("--mutations", type=int, default=10_000, help="damaged files to read")
    parser.add_argument("--kills", type=int, default=200, help="trainings to end by signals")
    parser.add_argument("--troubles", type=int, default=200, help="neighbours, full disks, ...")
    parser.add_argument("--seed", type=int, default=0, help="another seed is another campaign")
    parser.add_argument("--state", type=Path, default=Path("campaign.jsonl"), help="the results")
    parser.add_argument("--scratch", type=Path, default=None, help="where cases are tried")
    parser.add_argument("--only", default="", help="damages and troubles with this in their names")
    parser.add_argument("--share", default="0/1", help="the cases of one of several processes")
    parser.add_argument("--one", default=None, help="try one case alone, e.g. mutations:17")
    return parser.parse_args()


def _each(kind: str, numbers: Iterable[int], run: Callable[[int], Any], state: Path) -> None:
    """Try the cases that the state does not know yet."""
    known = {line["case"] for line in _lines(state) if line["kind"] == kind}
    for number in numbers:
        if number in known:
            continue
        started = time.monotonic()
        verdict = dataclasses.asdict(run(number))
        verdict |= {"kind": kind, "seconds": round(time.monotonic() - started, 2)}
        with open(state, "a") as file:
            file.write(json.dumps(verdict) + "\n")
        if verdict["problem"]:
            print(json.dumps(verdict), flush=True)


def _lines(state: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in state.read_text().splitlines()] if state.exists() else []


def _report(state: Path) -> int:
    """Print what became of all cases; 1 if one of them failed."""
    found = _lines(state)
    for kind in ("mutations", "kills", "troubles"):
        own = [line for line in found if line["kind"] == kind]
        codes = Counter(code for line in own for code in line.get("codes", [line.get("code")]))
        failed = sum(bool(line["problem"]) for line in own)
        shown = ", ".join(f"exit {code}: {count}" for code, count in sorted(codes.items()))
        print(f"{len(own)} {kind}, {failed} failures ({shown})")
    return int(any(line["problem"] for line in found))


if __name__ == "__main__":
    raise SystemExit(main())
