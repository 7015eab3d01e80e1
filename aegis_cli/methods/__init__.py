"""The methods by name."""

from aegis_cli.errors import AegisError
from aegis_cli.methods import aegis, lora, naive, stop_gradient
from aegis_cli.methods.base import Method

METHODS: dict[str, Method] = {m.METHOD.name: m.METHOD for m in (naive, stop_gradient, lora, aegis)}


def get(name: str) -> Method:
    """The method of that name."""
    if name not in METHODS:
        raise AegisError(f"method '{name}'", f"one of {', '.join(METHODS)}", "choose with --method")
    return METHODS[name]
