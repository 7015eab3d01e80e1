"""The mathematics of Aegis on plain tensors: no I/O, no model, no user interface."""
