"""Tables of a VLM that was taken out of another program's policy, or put back into it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.console import Group, RenderableType
from rich.text import Text

from aegis_cli.cli.render.layout import plain_table
from aegis_cli.cli.render.tables import pairs
from aegis_cli.common import commands
from aegis_cli.common.errors import few

Row = tuple[str, str, str]


def extracted(report: Any) -> RenderableType:
    """How much of the VLM comes from the policy, and the command to probe it."""
    facts = {
        "policy": report.policy,
        "type": report.type,
        "base": report.base,
        "prefix": report.prefix,
        "dtype": report.dtype,
        "out": report.out,
    }
    rows = [
        _row("the VLM", report.tensors, report.parameters),
        _row("of which the policy's", report.taken, report.taken_parameters),
        _row("that differ from the base's", report.moved, report.moved_parameters),
        *_shares("the base's", report.kept),
    ]
    lines = _whys(report.kept)
    if report.more:
        lines.append(f"only the policy has, and left out here: {few(report.more)}")
    if report.rounded:
        lines.append(f"{report.rounded:,} tensors have lost digits in {report.dtype}")
    lines.append(
        "what it has forgotten: "
        + commands.aegis("probe", report.out, "--baseline", report.base, "--vqa", "SET")
    )
    return Group(pairs(facts), _table(rows), Text("\n".join(lines)))


def inserted(report: Any) -> RenderableType:
    """How much of the policy now comes from the VLM."""
    facts = {
        "vlm": report.vlm,
        "policy": report.policy,
        "prefix": report.prefix,
        "out": report.out,
    }
    rows = [
        _row("the policy", report.tensors, report.parameters),
        _row("of which the VLM's", report.put, report.put_parameters),
        (f"of these {report.changed:,} differ from before", "", ""),
        *_shares("left out", report.left_out),
    ]
    lines = _whys(report.left_out)
    if report.rounded:
        lines.append(f"{report.rounded:,} tensors have lost digits in the policy's types")
    return Group(pairs(facts), _table(rows), *([Text("\n".join(lines))] if lines else []))


def _row(what: str, tensors: int, parameters: int) -> Row:
    return what, f"{tensors:,}", f"{parameters:,}"


def _shares(kind: str, shares: Sequence[Any]) -> list[Row]:
    return [_row(f"{kind}: {share.what}", share.tensors, share.parameters) for share in shares]


def _whys(shares: Sequence[Any]) -> list[str]:
    return [f"{share.what}: {share.why}" for share in shares]


def _table(rows: Sequence[Row]) -> RenderableType:
    return plain_table(("", "Tensors", "Parameters"), rows)
