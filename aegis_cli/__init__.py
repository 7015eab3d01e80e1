"""Aegis: fine-tune a vision-language model into a robot policy without losing what it knew."""

__version__ = "0.1.0"
__all__ = ["Guard"]


def __getattr__(name: str) -> object:
    """`Guard`, loaded when it is asked for: `aegis --help` must not load torch."""
    if name != "Guard":
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    from aegis_cli.guard import Guard

    return Guard
