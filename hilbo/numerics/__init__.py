"""Numerical methods that know no model: linear algebra under vmap, the normal distribution's tails and truncated
normals, Newton and least squares in a box, Mittag-Leffler functions, Sobol points, and what XLA is told.

Imports nothing of hilbo but `errors`.
"""
