"""Functions whose trace is kept: Python runs through them once for each shape, not once for each use."""

import functools

import jax

__all__ = ["traced_once"]

traced_once = functools.partial(jax.jit, inline=True)
"""Decorator: what was traced is copied into each program that uses the function, which compiles to the same code.

For functions of arrays that programs use many times: tracing the likelihood is most of what a first fit waits for.
"""
