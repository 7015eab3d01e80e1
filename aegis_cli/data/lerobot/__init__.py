"""LeRobot's dataset format v3.0, written and read with pyarrow and PyAV; nothing here knows torch
or a model.
"""
