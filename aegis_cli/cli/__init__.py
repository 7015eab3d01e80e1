"""The commands, and everything that a user sees."""
