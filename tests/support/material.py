"""Tests of materials made by textbook filters (scipy's lfilter), for what identifies materials."""

import numpy as np
from scipy.signal import lfilter

from hilbo.identification.fitting import Test

FOAM = (-2.89, 5.70, 5.89, 0.203)  # K0, K1, B1, alpha of the paper's system identification, N = 101


def filter_of(K0, K1, B1, alpha, N, T=1e-3):
    """Numerator and denominator of H(z)."""
    c = np.cumprod(np.concatenate([[1.0], (np.arange(1, N + 1) - 1 - alpha) / np.arange(1, N + 1)]))
    bottom = B1 * T**-alpha * c
    bottom[0] += K1
    return K0 * bottom + K1 * B1 * T**-alpha * c, bottom


def force(parameters, x, N=101, T=1e-3):
    top, bottom = filter_of(*parameters, N, T)
    return lfilter(top, bottom, x)


def position(parameters, F, N=101, T=1e-3):
    top, bottom = filter_of(*parameters, N, T)
    return lfilter(bottom / top[0], top / top[0], F)


def loads(T=1e-3, hold=3.0):
    """5 mm held; 3 N, then 0.5 N; both with ramps of 20 ms."""
    t, u = np.arange(round(hold / T) + 1) * T, np.arange(round(2 * hold / T) + 1) * T
    return (t, 5 * np.minimum(t / 0.02, 1)), (u, 3 * np.minimum(u / 0.02, 1) - 2.5 * np.clip((u - hold) / 0.02, 0, 1))


def foam_tests(repeats=1, N=101, parameters=FOAM, noise=0.0, rho=0.0, seed=0, hold=3.0):
    """Relaxation and creep; `noise` of the range, AR(1) with `rho`, in each repeat."""
    (t, x), (u, F) = loads(hold=hold)
    rng, tests = np.random.default_rng(seed), []
    for kind, time, put, out in (
        ("relaxation", t, x, force(parameters, x, N)),
        ("creep", u, F, position(parameters, F, N)),
    ):
        fresh = rng.standard_normal((repeats, time.size))
        fresh[:, 1:] *= np.sqrt(1 - rho**2)
        errors = noise * np.ptp(out) * lfilter([1.0], [1.0, -rho], fresh, axis=1)
        tests.append(Test(kind, time, out + errors, np.tile(put, (repeats, 1))))
    return tests
