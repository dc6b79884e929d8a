"""Approximations of the posterior of latent values beside Laplace's: expectation propagation, its corrected form, and
the exact posterior by sampling.

Imports `laplace`, `gaussian` and `numerics`; knows no likelihood but through its terms.
"""
