"""The mathematics of Aegis on plain tensors: no I/O, no model, no user interface.

One file is an exception: `routing` defines `nn.Module`s, because its experts have parameters.
"""
