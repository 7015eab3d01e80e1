"""The differences of runs from one of them, on a page."""

from __future__ import annotations

from collections.abc import Sequence

from aegis_cli.cli.page.cursor import At, between, shown
from aegis_cli.cli.page.html import Child, Markup, element
from aegis_cli.cli.page.runs import note, section
from aegis_cli.cli.page.tables import table
from aegis_cli.cli.render.paired import NO_PAIRS, ONE_TRAINING, TITLE, end_as, excludes_zero
from aegis_cli.cli.render.studies import shown_as
from aegis_cli.reporting.paired import PairedRun
from aegis_cli.studies.metrics import Column, columns


def differences(found: At, runs: Sequence[At]) -> Markup | None:
    """Each run's differences from the run `against`; nothing without any pair."""
    pairs, declared = list(found["paired"]), columns(PairedRun)
    names = [name for name in declared if any(one[name] for one in pairs)]
    if not names:
        return None
    labels = {str(run["path"]): run["label"] for run in runs}
    rows: list[list[Child]] = []
    for one in pairs:
        cells = [_difference(one[name], declared[name]) for name in names]
        rows.append([labels[str(one["run"])], *cells])
    gap = any(not one[name] for one in pairs for name in names)
    explained = "Paired: on the same questions, episodes or frames, each with its 95 % interval; "
    explained += f"in bold where it excludes 0. {ONE_TRAINING}"
    explained += f" A dash: {NO_PAIRS}." * gap
    return section(
        f"{TITLE} {labels[str(found['against'])]}",
        note(explained),
        table(["Run", *(declared[name].header for name in names)], rows),
    )


def _difference(difference: At, column: Column) -> Child:
    if not difference:
        return "–"

    mean, interval = shown(difference["mean"], shown_as(column)), difference["interval"]
    if excludes_zero(interval.value):
        mean = element("strong", mean)
    return [mean, between(interval, lambda end: shown(end, end_as(column)))]
