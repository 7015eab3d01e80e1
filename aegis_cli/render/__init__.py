"""What a user sees: progress and messages on stderr, reports as tables or JSON on stdout, plots."""

from __future__ import annotations

from aegis_cli.render.output import error, note, show
from aegis_cli.render.plot import energy_plot
from aegis_cli.render.progress import progress
from aegis_cli.render.tables import facts, inspect, pipeline, pretrain, probe, rollout

__all__ = ["energy_plot", "error", "facts", "inspect", "note", "pipeline", "pretrain", "probe", "progress", "rollout", "show"]
