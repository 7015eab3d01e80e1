"""The methods, for use in a user's own training loop."""

from aegis_cli.guard.guard import Guard

__all__ = ["Guard"]
