"""The commands of `hilbo device`: a rendering device on a line, or a simulated one.

JAX is loaded only where full memory needs it.
"""
