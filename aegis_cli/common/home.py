"""`~/` at the beginning of a path, for the user's home folder.

A shell expands it in `--out ~/x`, but bash does not in `--out=~/x`, and nothing does in a recipe.
Unexpanded it would name a folder `~` in the current one.
"""

from __future__ import annotations

import os
import re
from typing import Any

_OPTION = re.compile(r"(--?[\w-]+=)(~/.*)", re.DOTALL)


def at_home(value: Any) -> Any:
    """Plain values with `~/` in strings expanded; `./~/x` still names a folder `~`."""
    if isinstance(value, str):
        return os.path.expanduser(value) if value.startswith("~/") else value
    if isinstance(value, dict):
        return {name: at_home(inner) for name, inner in value.items()}
    return [at_home(inner) for inner in value] if isinstance(value, list) else value


def word_at_home(word: str) -> str:
    """The same for a word of a command line, which may be an option with its value."""
    option = _OPTION.fullmatch(word)
    return option[1] + at_home(option[2]) if option else at_home(word)
