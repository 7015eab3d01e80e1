"""Gathers what is known about a run, a job or a study, for a page or a table."""
