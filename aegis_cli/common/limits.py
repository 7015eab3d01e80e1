"""How many of what Aegis itself draws, simulates or times are asked for at most."""

from __future__ import annotations

# Episodes, scenes, questions about scenes, or rounds of a bench. Each takes time, and nearly always
# memory, of its own: more than these are a slip of the keyboard.
MOST_MADE = 10_000_000
