"""A frozen backbone: no gradient from the action loss reaches it, and it never changes."""

from aegis_cli.methods.base import Method, freeze

METHOD = Method(
    "stop-gradient", "frozen backbone, only the expert learns", freeze, stop_gradient=True
)
