"""What is read: demonstrations, questions, LeRobot datasets, streams."""
