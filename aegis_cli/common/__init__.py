"""Shared foundations for all modules: errors, events, files, artifacts, devices, pictures."""
