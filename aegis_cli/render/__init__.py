"""What a user sees: progress and messages on stderr, reports as tables or JSON on stdout, plots."""

from __future__ import annotations

from aegis_cli.render.comparison import study
from aegis_cli.render.frontier import frontier_plot
from aegis_cli.render.output import error, note, show
from aegis_cli.render.plot import can_plot, energy_plot
from aegis_cli.render.progress import progress
from aegis_cli.render.tables import bench, dual, facts, inspect, pipeline, pretrain, probe, rollout

__all__ = [
    "bench", "can_plot", "dual", "energy_plot", "error", "facts", "frontier_plot", "inspect", "note", "pipeline", "pretrain", "probe",
    "progress", "rollout", "show", "study",
]  # fmt: skip
