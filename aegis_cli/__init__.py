"""Aegis: fine-tune a vision-language model into a robot policy without losing what it knew."""

__version__ = "0.1.0"
__all__ = ["Guard", "load_policy"]


def __getattr__(name: str) -> object:
    """The two, loaded when they are asked for: `aegis --help` must not load torch."""
    if name == "Guard":
        from aegis_cli.guard import Guard

        return Guard
    if name == "load_policy":
        from aegis_cli.deploy import load_policy

        return load_policy
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
