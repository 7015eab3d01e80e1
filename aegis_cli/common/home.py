"""`~/` at the beginning of a path, for the person's own folder.

A shell puts it there in `--out ~/x`, but bash does not in `--out=~/x`, and nobody does in a recipe.
What is left would name a folder `~` in the present one.
"""

from __future__ import annotations

import os
import re
from typing import Any

_OPTION = re.compile(r"(--?[\w-]+=)(~/.*)", re.DOTALL)


def at_home(value: Any) -> Any:
    """Plain values with the home folder for `~/` in texts; `./~/x` is a folder of that name."""
    if isinstance(value, str):
        return os.path.expanduser(value) if value.startswith("~/") else value
    if isinstance(value, dict):
        return {name: at_home(inner) for name, inner in value.items()}
    return [at_home(inner) for inner in value] if isinstance(value, list) else value


def word_at_home(word: str) -> str:
    """The same of a word of a command line, which may be an option with its value."""
    option = _OPTION.fullmatch(word)
    return option[1] + at_home(option[2]) if option else at_home(word)
