"""Approximations of the posterior of latent values beside Laplace's: expectation propagation, its corrected form, and
the exact posterior by sampling.

Imports `laplace`, `gaussian`, `likelihoods` and `numerics`.
"""
