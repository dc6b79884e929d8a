"""A device's own mechanics: its signs, its friction and damping, and the material that it presses.

Loads no JAX.
"""
