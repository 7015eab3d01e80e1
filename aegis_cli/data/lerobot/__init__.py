"""LeRobot's dataset format, read (v2.0 to v3.0) and written (v3.0) without torch or lerobot."""
