"""Approximations of the posterior besides Laplace's: expectation propagation, its corrected form, and exact sampling.

Imports `laplace`, `gaussian` and `numerics`; depends on a likelihood only through its terms.
"""
