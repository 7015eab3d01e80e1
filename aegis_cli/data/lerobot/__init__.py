"""LeRobot's dataset format v3.0, read and written with pyarrow and PyAV, without torch."""
