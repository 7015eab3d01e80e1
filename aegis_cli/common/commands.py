"""Commands in messages, quoted so that a shell accepts them as printed."""

from __future__ import annotations

import shlex


def aegis(*words: object) -> str:
    """A call of `aegis` with these words, quoted where necessary."""
    return shell("aegis", *words)


def shell(*words: object) -> str:
    """A call of any program, likewise."""
    return shlex.join(map(str, words))
