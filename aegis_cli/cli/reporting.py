"""`aegis report`, and the page that `aegis run` writes at its end."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from aegis_cli.cli import render
from aegis_cli.common import commands, files
from aegis_cli.common.errors import AegisError

NAME = "report.html"


def write(
    paths: Sequence[Path], out: Path | None, as_json: bool, against: str | None = None
) -> None:
    """Write the page of a folder or of several, and print where; with `as_json`, its document too.

    Args:
        against: the run that the others' paired differences are from, as in `compare.run`.

    Raises:
        AegisError: there is nothing to report on, several folders have no `out`, or the page cannot
            be written.
    """
    if out is not None and out.suffix.lower() not in (".html", ".htm"):
        found, fix = f"--out {out}", f"--out {out.with_suffix('.html')}"
        raise AegisError(found, "a file name ending in .html", fix)
    if out is not None:
        files.check_writable(out)  # before anything is read
    elif len(paths) > 1:
        fix = commands.aegis("report", *paths, "--out", "compared.html")
        found = f"{len(paths)} folders without --out, whose page belongs in none of them"
        raise AegisError(found, "the file to write", fix)
    # Imported here, because the pages need torch through the artifacts.
    from aegis_cli.cli import page
    from aegis_cli.reporting import gather

    with render.progress() as on_event:
        if len(paths) > 1:
            found = gather.of_runs(paths, on_event, against)
        else:
            found = gather.run(paths[0], on_event, against)
    target = paths[0] / NAME if out is None else out
    page.save(found, target)
    if as_json:
        render.show(found, render.facts, as_json)  # the view is not used
    render.note(f"report: {target}")


def write_of(folder: Path) -> None:
    """Write the page of an `aegis run` into its folder."""
    write([folder], None, as_json=False)
