"""AEGIS (arXiv 2604.16067): remove from each layer's task gradient what would move it off its anchor.

Per parameter group, d = <g, a>; where d < 0, g <- g - (d / <a, a>) a.
"""

from aegis_cli.core import projection
from aegis_cli.methods.base import Method, train_all

METHOD = Method("aegis", "per-layer projection against the anchor gradient", train_all, combine=projection.aegis)
