"""Comparisons of many runs: variants x tasks x seeds, with one tuned knob per variant."""
