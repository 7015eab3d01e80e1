"""The whole campaign: `python tests/campaign --mutations 10000 --kills 200`.

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
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

TESTS = Path(__file__).parent.parent
sys.path.insert(0, str(TESTS))
os.environ["OMP_NUM_THREADS"] = "1"  # a process with threads does not fork well
os.environ["HF_HUB_OFFLINE"] = "1"
os.environ["AEGIS_CACHE"] = "cache"  # in the folder of each case
os.environ.pop("COLUMNS", None)

from campaign import figures, kills, subjects, troubles, warm, world  # noqa: E402


def main() -> int:
    options = _options()
    if not (options.mutations or options.kills or options.troubles or options.one):
        return _report(options)
    with tempfile.TemporaryDirectory(dir=options.scratch) as folder:
        root = world.begin(Path(folder) / "world")
        warm.up(root)  # before the commands of the world too, which are as many as those of cases
        world.finish(root)
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
            _each(kind, numbers, run, options.state, options.again)
    return _report(options)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python tests/campaign", description=__doc__)
    parser.add_argument("--mutations", type=int, default=10_000, help="damaged files to read")
    parser.add_argument("--kills", type=int, default=200, help="trainings to end by signals")
    parser.add_argument("--troubles", type=int, default=200, help="neighbours, full disks, ...")
    parser.add_argument("--seed", type=int, default=0, help="another seed is another campaign")
    parser.add_argument("--state", type=Path, default=Path("campaign.jsonl"), help="the results")
    parser.add_argument("--others", type=Path, nargs="*", default=[], help="more results to show")
    parser.add_argument("--page", type=Path, default=None, help="a page to write the table into")
    parser.add_argument("--scratch", type=Path, default=None, help="where cases are tried")
    parser.add_argument("--only", default="", help="damages and troubles with this in their names")
    parser.add_argument("--share", default="0/1", help="the cases of one of several processes")
    parser.add_argument("--again", action="store_true", help="only the cases that failed")
    parser.add_argument("--one", default=None, help="try one case alone, e.g. mutations:17")
    return parser.parse_args()


def _each(
    kind: str, numbers: Iterable[int], run: Callable[[int], Any], state: Path, again: bool
) -> None:
    """Try the cases that are not in the state yet; with `again`, those that failed alone."""
    own = [line for line in figures.read([state]) if line["kind"] == kind]
    known = {line["case"] for line in own}
    if again:
        numbers = sorted(line["case"] for line in figures.failures(own))
        known = set()
    for number in numbers:
        if number in known:
            continue
        started = time.monotonic()
        verdict = dataclasses.asdict(run(number))
        verdict |= {"kind": kind, "seconds": round(time.monotonic() - started, 2)}
        with open(state, "a", encoding="utf-8") as file:
            file.write(json.dumps(verdict) + "\n")
        if verdict["problem"]:
            print(json.dumps(verdict), flush=True)


def _report(options: argparse.Namespace) -> int:
    """Print the results of all cases; 1 if one of them failed."""
    found = figures.read([options.state, *options.others])
    print(figures.table(found))
    if options.page is not None:
        figures.write(options.page, found)
    return int(bool(figures.failures(found)))


if __name__ == "__main__":
    raise SystemExit(main())
