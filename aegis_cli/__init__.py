"""Aegis: fine-tune a vision-language model into a robot policy without losing what it knew."""

__version__ = "0.1.0"
