"""Expectation propagation as in the textbook: sequential updates, one site at a time, in the sites' natural parameters.

Rasmussen & Williams (2006), algorithm 3.5 and equation (3.65), with the moments of an ordinal answer by quadrature. For
problems that are not hostile only.
"""

import numpy as np
from scipy.special import ndtr

__all__ = ["second_order", "textbook_ep", "tilted_moments"]

# The trapezoidal rule on smooth functions that vanish at both ends converges faster than any power of the step.
_NODES = np.linspace(-10.0, 10.0, 2001)
_WEIGHTS = np.exp(-0.5 * _NODES**2) * (_NODES[1] - _NODES[0]) / np.sqrt(2 * np.pi)


def tilted_moments(mean, variance, lower, upper, noise):
    """log Z, mean, variance, third central moment of N(f; mean, variance) times the probability of (lower, upper)."""
    f = mean + np.sqrt(variance) * _NODES
    below, above = (lower - f) / noise, (upper - f) / noise
    p = np.where(below > 0, ndtr(-below) - ndtr(-above), ndtr(above) - ndtr(below))
    weight = _WEIGHTS * p
    z = np.sum(weight)
    centre = np.sum(weight * f) / z
    return np.log(z), centre, np.sum(weight * (f - centre) ** 2) / z, np.sum(weight * (f - centre) ** 3) / z


def textbook_ep(prior, lower, upper, noise, sweeps=60):
    """Posterior mean, variance and log evidence at the asked points; `prior` may be singular."""
    mu, sigma, _, _, evidence = _textbook(prior, lower, upper, noise, sweeps)
    return mu, np.diag(sigma), evidence


def second_order(prior, lower, upper, noise, sweeps=60):
    """EP's log evidence, and what the third cumulants of pairs of tilted distributions add to it: the sum over pairs
    of c_i c_j / 6 (Sigma_ij / Sigma_ii Sigma_jj)^3 (Opper, Paquet & Winther 2013)."""
    _, sigma, cavity_mean, cavity_tau, evidence = _textbook(prior, lower, upper, noise, sweeps)
    cubes = np.array([tilted_moments(m, 1 / t, *edges, noise)[3]
                      for m, t, *edges in zip(cavity_mean, cavity_tau, lower, upper, strict=True)])  # fmt: skip
    spread = np.diag(sigma)
    pairs = np.triu(np.outer(cubes, cubes) * (sigma / np.outer(spread, spread)) ** 3, 1)
    return evidence, np.sum(pairs) / 6


def _textbook(prior, lower, upper, noise, sweeps):
    n = len(lower)
    tau, nu = np.zeros(n), np.zeros(n)
    sigma, mu = np.array(prior, float), np.zeros(n)
    for _ in range(sweeps):
        for i in range(n):
            cavity_tau, cavity_nu = 1 / sigma[i, i] - tau[i], mu[i] / sigma[i, i] - nu[i]
            _, mean, variance, _ = tilted_moments(cavity_nu / cavity_tau, 1 / cavity_tau, lower[i], upper[i], noise)
            change = 1 / variance - cavity_tau - tau[i]
            tau[i], nu[i] = tau[i] + change, mean / variance - cavity_nu
            sigma = sigma - np.outer(sigma[i], sigma[i]) * change / (1 + change * sigma[i, i])
            mu = sigma @ nu
        sigma = np.linalg.solve(np.eye(n) + prior * tau, prior)
        mu = sigma @ nu
    cavity_tau = 1 / np.diag(sigma) - tau
    cavity_mean = (mu / np.diag(sigma) - nu) / cavity_tau
    log_z = [tilted_moments(m, 1 / t, *edges, noise)[0]
             for m, t, *edges in zip(cavity_mean, cavity_tau, lower, upper, strict=True)]  # fmt: skip
    site = nu / tau
    evidence = (
        np.sum(log_z)
        + 0.5 * np.sum(np.log(1 / cavity_tau + 1 / tau) + (cavity_mean - site) ** 2 / (1 / cavity_tau + 1 / tau))
        - 0.5 * np.linalg.slogdet(prior + np.diag(1 / tau))[1]
        - 0.5 * site @ np.linalg.solve(prior + np.diag(1 / tau), site)
    )
    return mu, sigma, cavity_mean, cavity_tau, evidence
