"""The output of `aegis run --dry-run`: the stages that would run, and the trainings' needs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rich.console import Group, RenderableType
from rich.text import Text

from aegis_cli.cli.render.layout import number, plain_table


def plan(report: Any) -> RenderableType:
    """The plan of a recipe's job, or of a study."""
    return Group(*(_of_job(report) if hasattr(report, "stages") else _of_study(report)))


def _of_job(report: Any) -> Iterator[RenderableType]:
    rows = [(one.stage, one.command, _state(one)) for one in report.stages]
    yield plain_table(("Stage", "Command", "State"), rows, left=3)
    asked = {method: one for method, one in report.trainings.items() if one is not None}
    if asked:
        yield _trainings(asked)
    unknown = [method for method, one in report.trainings.items() if one is None]
    if unknown:
        yield Text(
            f"{', '.join(unknown)}: memory, disk and hours can be told once the demonstrations and "
            "the anchor are there"
        )
    due = sum(one.due is not None for one in report.stages)
    told = f"{due} of {len(report.stages)} stages would run"
    if report.hours is not None:
        told += f"; their trainings take about {number(report.hours, 2)} hours"
    if report.disk_free_mb is not None:
        told += f" and {report.disk_mb:,.0f} MB of the {report.disk_free_mb:,.0f} MB that are free"
    yield Text(f"{told}, in '{report.out}'")


def _trainings(asked: dict[str, Any]) -> RenderableType:
    """What each training needs."""
    shown = {
        "Memory MB": lambda r: f"{r.memory_needed_mb:,.0f}",
        "Free MB": lambda r: number(r.memory_free_mb),
        "Disk MB": lambda r: f"{r.disk_mb:,.0f}",
        "Step s": lambda r: number(r.step_s),
        "Hours": lambda r: number(r.hours, 2),
    }
    rows = [(method, *(show(one) for show in shown.values())) for method, one in asked.items()]
    return plain_table(("Training", *shown), rows)


def _of_study(report: Any) -> Iterator[RenderableType]:
    rows = [(one.cell, _state(one)) for one in report.cells]
    yield plain_table(("Cell", "State"), rows, left=2)
    left = len(report.cells) - report.finished
    yield Text(f"{left} of {len(report.cells)} cells would be measured, in '{report.out}'")


def _state(one: Any) -> str:
    """Whether a stage or cell would be skipped, or why it would run."""
    return "up to date" if one.due is None else f"would run: {one.due}"
