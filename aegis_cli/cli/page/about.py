"""The end of a page: videos, the commands to reproduce the results, the machine, the recipe."""

from __future__ import annotations

import base64
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from aegis_cli.cli.page.cursor import At
from aegis_cli.cli.page.html import Child, Markup, element
from aegis_cli.cli.page.runs import note, section
from aegis_cli.cli.page.tables import table
from aegis_cli.recipes.strict_yaml import dump

_TYPES = {".mp4": "video/mp4", ".webm": "video/webm", ".gif": "image/gif"}
_EMBEDDED_BYTES = 8_000_000  # of a video; larger ones are linked


def videos(found: At, folder: Path, page: Path, title: str = "Videos") -> Markup | None:
    """The videos of a folder; small ones are embedded in the page.

    Args:
        page: the folder of the page; links to large videos are relative to it.
    """
    if not found:
        return None
    return section(title, *(_film(video, folder, page) for video in found))


def _film(video: At, folder: Path, page: Path) -> Markup:
    name = str(video["name"])
    kind = _TYPES[Path(name).suffix.lower()]
    if video["size_bytes"].value > _EMBEDDED_BYTES:
        place = Path(os.path.relpath(folder / name, page)).as_posix()
        link = element("a", place, href=quote(place))
        return note(link, " is too large to embed in this page, so it is only linked.")
    encoded = base64.b64encode((folder / name).read_bytes()).decode()
    source = f"data:{kind};base64,{encoded}"
    if kind.startswith("video"):
        # Without `autoplay`, because a page with many videos would play all of them at once.
        film = element("video", src=source, controls="", muted="", loop="", playsinline="")
    else:
        film = element("img", src=source, alt=name, class_="film")
    return element("figure", film, element("figcaption", name))


def commands(page: At) -> Markup:
    """The commands that reproduce the results."""
    return section("Repeat it", command_lines(page))


def command_lines(found: At) -> Markup:
    lines = "\n".join(str(line) for line in found["commands"])
    return element("pre", element("code", lines))


def machine(runs: Sequence[At]) -> Markup:
    """The machines and versions that trained the runs, with a column for each machine."""
    # Keyed by text, because a mapping cannot be a key.
    found: dict[str, tuple[dict[str, Any], list[str]]] = {}
    for run in runs:
        about = run["machine"].value
        _, names = found.setdefault(str(sorted(about.items())), (about, []))
        names.append(str(run["label"]))
    known = [(about, names) for about, names in found.values() if about]
    if not known:
        return section("Machine and versions", note("Not recorded: an earlier Aegis trained this."))
    keys = list(dict.fromkeys(key for about, _ in known for key in about))
    header = ["", *(", ".join(names) if len(known) > 1 else "" for _, names in known)]
    rows: list[list[Child]] = []
    for key in keys:
        rows.append([key, *(str(about.get(key, "–")) for about, _ in known)])
    return section("Machine and versions", table(header, rows, left=1 + len(known)))


def recipe(run: At) -> Markup:
    """Every key of the recipe with its value, in a collapsed section."""
    return section("Recipe", recipe_keys(run, "Every key"))


def recipe_keys(run: At, summary: str) -> Markup:
    listed = element("pre", element("code", dump(run["recipe"].value)))
    return element("details", element("summary", summary), listed)
