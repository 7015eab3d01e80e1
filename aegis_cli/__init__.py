"""Aegis: fine-tune a vision-language model into a robot policy without losing what it knew."""

from typing import TYPE_CHECKING

from aegis_cli.common.version import __version__

if TYPE_CHECKING:
    from aegis_cli.deploy import load_policy
    from aegis_cli.guard import Guard
    from aegis_cli.serving.real_time import RealTime

__all__ = ["Guard", "RealTime", "__version__", "load_policy"]


def __getattr__(name: str) -> object:
    """The others, loaded when they are asked for: `aegis --help` must not load torch."""
    if name == "Guard":
        from aegis_cli.guard import Guard

        return Guard
    if name == "RealTime":
        from aegis_cli.serving.real_time import RealTime

        return RealTime
    if name == "load_policy":
        from aegis_cli.deploy import load_policy

        return load_policy
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")


def __dir__() -> list[str]:
    """What there is, so that a notebook offers them before they are loaded."""
    return sorted({*globals(), *__all__})
