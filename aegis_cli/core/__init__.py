"""The mathematics of Aegis on plain tensors: no I/O, no model, no user interface.

One room has modules: the routed experts of `routing`, which are weights beside a map's own.
"""
