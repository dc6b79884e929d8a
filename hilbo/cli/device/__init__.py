"""The commands of `hilbo device`: a rendering device on a line, or a simulated one.

Loads no JAX where full memory does not need it.
"""
