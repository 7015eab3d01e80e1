"""Data: demonstrations, questions, LeRobot datasets, streams."""
