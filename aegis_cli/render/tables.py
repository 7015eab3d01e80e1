"""Reports as plain, aligned tables: units in the headers, shares in percent."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import Any

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

_SHARES = {"accuracy", "success", "conflict", "wrong_target", "majority", "energy_shed"}


def facts(report: Any) -> Table:
    """Every plain value of a report, one a line."""
    return _pairs({f.name: getattr(report, f.name) for f in dataclasses.fields(report)})


def probe(report: Any) -> RenderableType:
    parts = [_pairs(_scalars(report)), _families(report.families)]
    if report.layers:
        parts.append(_table(("Layer", "W2"), [(str(x.layer), _number(x.w2)) for x in report.layers]))
    return Group(*parts)


def pretrain(report: Any) -> RenderableType:
    families = [(name, _percent(accuracy)) for name, accuracy in report.families.items()]
    return Group(_pairs(_scalars(report)), _table(("Family", "Accuracy %"), families))


def rollout(report: Any) -> Table:
    return _pairs(_scalars(report))


def pipeline(report: Any) -> RenderableType:
    header = ("Method", "VQA %", "Drop (points)", "Cross-entropy (nats)", "Success seen %", "Success held-out %", "W2",
              "Energy shed %", "Step time (x naive)", "Validation loss")  # fmt: skip
    rows = [
        (r.method, _percent(r.accuracy), _fixed(r.drop_points, 2), _fixed(r.cross_entropy, 3), _percent(r.success_seen),
         _percent(r.success_held_out), _number(r.w2), _percent(r.energy_shed, 2), _fixed(r.step_time_ratio, 2),
         _fixed(r.validation_loss, 4))
        for r in report.rows
    ]  # fmt: skip
    before = f"before fine-tuning: VQA {_percent(report.baseline_accuracy)} %"
    majority = f"always the commonest answer: {_percent(report.majority_accuracy)} %"
    return Group(Text(report.name, "bold"), _table(header, rows), Text(f"{before}; {majority}\nfiles: {report.out}"))


def inspect(report: Any) -> RenderableType:
    shed = {} if report.energy_shed_mean is None else {"energy_shed_mean": report.energy_shed_mean}
    parts: list[RenderableType] = [_pairs({"kind": report.kind, "path": report.path, **report.facts, **shed})]
    if report.tensors:
        rows = [(t.name, " x ".join(map(str, t.shape)) or "scalar", t.dtype, t.unit) for t in report.tensors]
        parts.append(_table(("Tensor", "Shape", "Type", "Unit"), rows, left=4))
    if report.moments:
        rows = [(m.name, _number(m.mean_norm), _number(m.variance_trace)) for m in report.moments]
        parts.append(_table(("Layer", "|mean|", "Trace of variance"), rows))
    if report.layers:
        rows = [(x.name, _percent(x.energy_shed, 3), _percent(x.energy_shed_max), _percent(x.conflict)) for x in report.layers]
        parts.append(_table(("Group", "Energy shed, mean %", "Largest step %", "Steps in conflict %"), rows))
        parts.append(_over_time(report.over_time))
    elif report.kind in ("run", "ledger"):
        parts.append(Text("no anchor gradient in this method: nothing is projected, no energy is shed"))
    return Group(*parts)


def _over_time(bins: Sequence[Any], rows: int = 8) -> Table:
    size = max(1, math.ceil(len(bins) / rows))
    chunks = [bins[i : i + size] for i in range(0, len(bins), size)]
    lines = [
        (f"{c[0].first_step} to {c[-1].last_step}", _percent(sum(b.energy_shed for b in c) / len(c), 3)) for c in chunks
    ]
    return _table(("Steps", "Energy shed, mean %"), lines)


def _families(families: dict[str, Any]) -> Table:
    header = ("Family", "Questions", "Accuracy %", "95 % interval", "Majority %", "Baseline %")
    rows = [
        (name, *(_cell(getattr(f, key, None), key) for key in ("questions", "accuracy", "interval", "majority", "baseline_accuracy")))
        for name, f in families.items()
    ]  # fmt: skip
    return _table(header, rows)


def _table(header: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1) -> Table:
    """Plain and aligned: the first `left` columns to the left, figures to the right."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, header_style="bold")
    for i, name in enumerate(header):
        table.add_column(name, justify="left" if i < left else "right")
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    return table


def _pairs(values: dict[str, Any]) -> Table:
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(style="bold")
    table.add_column(overflow="fold")
    for name, value in values.items():
        table.add_row(_label(name), Text(_cell(value, name) + _unit(name, value)))
    return table


def _scalars(report: Any) -> dict[str, Any]:
    names = [f.name for f in dataclasses.fields(report) if f.name not in ("families", "layers")]
    return {name: getattr(report, name) for name in names}


_UNITS = {"_s": " s", "_m": " m", "_points": " points", "cross_entropy": " nats"}


def _label(name: str) -> str:
    """`final_distance_m` -> final distance; `frames_per_s` -> frames per second."""
    if name.endswith("_per_s"):
        return name.removesuffix("_s").replace("_", " ") + " second"
    suffix = next((s for s in _UNITS if s.startswith("_") and name.endswith(s)), "")
    return name.removesuffix(suffix).replace("_", " ")


def _unit(name: str, value: Any) -> str:
    if value is None or isinstance(value, str) or name.endswith("_per_s"):
        return ""
    if _is_share(name) or name == "interval":
        return " %"
    return next((unit for suffix, unit in _UNITS.items() if name.endswith(suffix)), "")


def _is_share(name: str) -> bool:
    return name in _SHARES or name.endswith(("_accuracy", "accuracy")) or name.startswith(("energy_shed", "success"))


def _cell(value: Any, name: str = "") -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if name == "interval":
        return " to ".join(_percent(v) for v in value)
    if isinstance(value, dict):
        return _list([f"{k} {_cell(v)}" for k, v in value.items()])
    if isinstance(value, (tuple, list)):
        return _list([_cell(v) for v in value])
    if isinstance(value, float):
        return _percent(value) if _is_share(name) else _number(value)
    return f"{value:,}" if isinstance(value, int) and name != "seed" else str(value)


def _list(items: Sequence[str], most: int = 12) -> str:
    return ", ".join(items) if len(items) <= most else f"{', '.join(items[:most])}, ... ({len(items)})"


def _percent(value: float | None, digits: int = 1) -> str:
    return "-" if value is None else f"{100 * value:.{digits}f}"


def _fixed(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"
