"""Limits on requests, and the tolerance by which a value meets a limit."""

from __future__ import annotations

# Episodes, scenes, questions about scenes, or rounds of a benchmark. Each takes time and nearly
# always memory, so a larger number is a typing error.
MOST_MADE = 10_000_000
ROUNDING = 1e-9  # tolerance by which a value may miss a limit and still count as meeting it
