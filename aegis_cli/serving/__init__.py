"""A trained policy for other programs: over a network, or while its robot moves."""

from __future__ import annotations

from importlib.util import find_spec

from aegis_cli.common.errors import AegisError


def require() -> None:
    """Raise AegisError unless the packages that a server needs are installed."""
    for package in ("websockets", "msgpack"):
        if find_spec(package) is None:
            raise AegisError(
                f"no package '{package}'",
                "the packages of a policy server",
                "pip install 'aegis-vla[serve]'",
            )
