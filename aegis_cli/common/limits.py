"""How many of what Aegis itself draws or simulates are asked for at most."""

from __future__ import annotations

# Episodes, scenes, or questions about scenes. Each takes time, and nearly always memory, of its
# own: more than these are a slip of the keyboard.
MOST_MADE = 10_000_000
