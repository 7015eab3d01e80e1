"""Streams of tasks, of images or of robots, learned one after the other."""
