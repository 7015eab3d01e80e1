"""The results of a campaign's cases, as a table for docs/reliability.md."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

_BEGIN, _END = "<!-- figures of the campaign -->", "<!-- end of the figures -->"
Line = dict[str, Any]


def read(states: Iterable[Path]) -> list[Line]:
    """The results in some files; for a case that was tried again, the last one."""
    found: dict[tuple[str, int], Line] = {}
    for state in states:
        for text in state.read_text().splitlines() if state.exists() else ():
            line = json.loads(text)
            found[line["kind"], line["case"]] = line
    return list(found.values())


def failures(lines: Iterable[Line]) -> list[Line]:
    """The cases with an outcome that is not allowed."""
    return [line for line in lines if line["problem"]]


def table(lines: Sequence[Line]) -> str:
    """A row for each kind of file, of signal and of trouble."""
    rows: dict[str, list[Line]] = defaultdict(list)
    for line in sorted(lines, key=lambda line: line["kind"] != "mutations"):
        rows[_name(line)].append(line)
    text = ["| what | cases | done | refused | ended by a signal | failures |"]
    text.append("|---|---|---|---|---|---|")
    text += [_row(name, own) for name, own in rows.items()]
    text.append(_row("all", lines))
    return "\n".join(text)


def write(page: Path, lines: Sequence[Line]) -> None:
    """Put the table into a page, between its markers."""
    before, _, rest = page.read_text(encoding="utf-8").partition(_BEGIN)
    after = rest.partition(_END)[2]
    made = f"{before}{_BEGIN}\n\n{table(lines)}\n\n{_END}{after}"
    page.write_text(made, encoding="utf-8")


def _name(line: Line) -> str:
    if line["kind"] == "mutations":
        return f"damaged: {line['subject']}"
    if line["kind"] == "kills":
        return f"signals: {line['work']}"
    return f"trouble: {line['trouble']}"


def _row(name: str, lines: Sequence[Line]) -> str:
    """Counts of cases, but for signals of the processes that they came to."""
    codes = Counter(code for line in lines for code in line.get("codes", [line.get("code")]))
    refused = codes[1] + codes[2]
    by_signal = sum(count for code, count in codes.items() if code < 0 or code > 128)
    failed = len(failures(lines))
    return f"| {name} | {len(lines)} | {codes[0]} | {refused} | {by_signal} | {failed} |"
