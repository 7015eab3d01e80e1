"""Limits of what is asked for, and when a value counts as meeting one."""

from __future__ import annotations

# Episodes, scenes, questions about scenes, or rounds of a bench. Each takes time, and nearly always
# memory, of its own: more than these are a slip of the keyboard.
MOST_MADE = 10_000_000
ROUNDING = 1e-9  # tolerance by which a value may miss a limit and still count as meeting it
