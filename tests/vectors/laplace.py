"""Laplace's approximation in many digits: of hostile cases, and how it moves with every hyperparameter."""

import numpy as np
from datasets import Dataset, hostile_cases, near_separable, repeated
from mpmath import mp
from reference_laplace import mpmath_laplace

__all__ = [
    "CASES",
    "NASTIEST",
    "PER_DIMENSION",
    "SCALAR",
    "WITH_25",
    "hyperparameters",
    "make_digits",
    "make_slopes",
    "of_digits",
    "unpack",
]

WITH_25 = [case for case in hostile_cases() if len(case.q) == 25]
NASTIEST = [case for case in WITH_25 if case.noise == 1e-3 and case.theta == 1e-2 and case.variance == 1e4]

SCALAR, PER_DIMENSION = 3.0, (3.0, 2.0, 1.2)
CASES = {
    "repeated": (repeated, SCALAR),
    "repeated, theta per dimension": (repeated, PER_DIMENSION),
    "near separable": (near_separable, SCALAR),
}


def of_digits(case: Dataset) -> dict:
    """Means and variances at the new points and the log evidence, from 25 digits."""
    exact = mpmath_laplace(*case.problem(), digits=25)
    return {name: np.array(exact[name], float) for name in ("mean", "variance", "log_evidence")}


def make_digits() -> dict:
    return {case.name: of_digits(case) for case in [*WITH_25[::15], *NASTIEST]}


def hyperparameters(data: Dataset, theta) -> np.ndarray:
    """One vector (theta..., variance, noise, thresholds...)."""
    return np.concatenate([np.ravel(part) for part in (theta, data.variance, data.noise, data.thresholds)])


def unpack(h):
    """Its parts, of a vector of any kind of number."""
    *theta, variance, noise, first, second = h
    return theta[0] if len(theta) == 1 else theta, variance, noise, (first, second)


def _values(h, data):
    theta, variance, noise, thresholds = unpack(h)
    solved = mpmath_laplace(data.x, data.q, theta, variance, thresholds, noise, data.x_new[:3], digits=40)
    return np.array([solved["log_evidence"], *solved["mean"], *solved["variance"]], object)


def _jacobian(make, theta):
    """(7, p) of log evidence, and means and variances at three new points: central differences at 40 digits."""
    data, columns = make(), []
    with mp.workdps(45):
        h = [mp.mpf(float(v)) for v in hyperparameters(data, theta)]
        for j, value in enumerate(h):
            step = value * mp.mpf(10) ** -12
            moved = [_values([*h[:j], value + s, *h[j + 1 :]], data) for s in (step, -step)]
            columns.append((moved[0] - moved[1]) / (2 * step))
    return np.stack(columns, axis=1).astype(float)


def make_slopes() -> dict:
    return {name: _jacobian(*case) for name, case in CASES.items()}
