"""Knowledge insulation by isolation: the backbone never sees the action loss, and never changes."""

from aegis_cli.methods.base import Method, freeze

METHOD = Method(
    "stop-gradient", "frozen backbone, only the expert learns", freeze, stop_gradient=True
)
