"""Commands that a message names, so that a shell takes them as they are printed."""

from __future__ import annotations

import shlex


def aegis(*words: object) -> str:
    """A call of `aegis` with these words, each quoted where it has to be."""
    return shell("aegis", *words)


def shell(*words: object) -> str:
    """A call of any program, likewise."""
    return shlex.join(map(str, words))
