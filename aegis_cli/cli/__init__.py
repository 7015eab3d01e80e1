"""The commands, and all that a user sees."""
