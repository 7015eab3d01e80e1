"""The eight colours that scenes and tasks share, by name."""

from __future__ import annotations

RGB: dict[str, tuple[float, float, float]] = {
    "red": (0.85, 0.08, 0.08),
    "green": (0.10, 0.65, 0.15),
    "blue": (0.10, 0.20, 0.90),
    "yellow": (0.95, 0.88, 0.10),
    "orange": (1.00, 0.50, 0.05),
    "purple": (0.50, 0.10, 0.70),
    "cyan": (0.10, 0.85, 0.90),
    "pink": (1.00, 0.55, 0.75),
}
COLORS: tuple[str, ...] = tuple(RGB)

# The VLM knows all eight; demonstrations never show a held-out colour as the target.
HELD_OUT: tuple[str, ...] = ("orange", "cyan")
SEEN: tuple[str, ...] = tuple(c for c in COLORS if c not in HELD_OUT)
