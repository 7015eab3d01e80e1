"""The methods by name."""

from aegis_cli.common.errors import AegisError
from aegis_cli.methods import (
    aegis,
    cotrain,
    distill,
    ewc,
    kfac,
    l2sp,
    lora,
    maps,
    naive,
    nullspace,
    stop_gradient,
)
from aegis_cli.methods.base import Method

_MODULES = (naive, stop_gradient, lora, aegis, nullspace, kfac, l2sp, maps, ewc, distill, cotrain)
METHODS: dict[str, Method] = {m.METHOD.name: m.METHOD for m in _MODULES}


def get(name: str) -> Method:
    """The method of that name."""
    if name not in METHODS:
        raise AegisError(f"method '{name}'", f"one of {', '.join(METHODS)}", "choose with --method")
    return METHODS[name]
