"""AEGIS in a training loop that is not ours."""

from aegis_cli.guard.guard import Guard

__all__ = ["Guard"]
