"""The HTML page of what `reporting` gathers: a single file that loads and runs nothing."""

from __future__ import annotations

from aegis_cli.cli.page.pages import page, save

__all__ = ["page", "save"]
