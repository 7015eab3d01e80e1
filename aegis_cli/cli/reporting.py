"""`aegis report`, and the page that `aegis run` writes at its end."""

from __future__ import annotations

from pathlib import Path

from aegis_cli.cli import render
from aegis_cli.common import files
from aegis_cli.common.errors import AegisError

NAME = "report.html"


def write(path: Path, out: Path | None, as_json: bool) -> None:
    """Write the page of a folder, and print where; with `as_json`, print its document too.

    Raises:
        AegisError: there is nothing to report on, or the page cannot be written.
    """
    if out is not None and out.suffix.lower() not in (".html", ".htm"):
        found, fix = f"--out {out}", f"--out {out.with_suffix('.html')}"
        raise AegisError(found, "a file name ending in .html", fix)
    if out is not None:
        files.check_writable(out)  # before anything is read
    # Imported here, because the pages need torch through the artifacts.
    from aegis_cli.cli import page
    from aegis_cli.reporting import gather

    found = gather.run(path)
    target = path / NAME if out is None else out
    page.save(found, target)
    if as_json:
        render.show(found, render.facts, as_json)  # the view is not used
    render.note(f"report: {target}")


def write_of(folder: Path) -> None:
    """Write the page of an `aegis run` into its folder."""
    write(folder, None, as_json=False)
