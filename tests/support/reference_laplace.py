"""Independent oracles for the ordinal Laplace approximation and the committee: NumPy in float64, mpmath at 50 digits.

Written from the equations alone, with nothing of hilbo imported:

    k(x, x') = variance * exp(-sum_j theta_j (x_j - x'_j)^2)
    p(q | f) = Phi(u) - Phi(l),   u = (t_{q+1} - f) / c,   l = (t_q - f) / c,   t_0 = -inf, t_C = +inf
    f_hat    = argmax  psi(f) = sum log p(q_i | f_i) - f' K^-1 f / 2,   a = K^-1 f_hat,   W = -d2 log p / df2
    mean_*   = k_*' a,   variance_* = k_** - k_*' (K + W^-1)^-1 k_*,   log Z = psi(f_hat) - log|I + W K| / 2

Both solvers keep a, with f = K a, so that no inverse of K is needed and K may be exactly singular (an x asked twice).
Source: Rasmussen & Williams, Gaussian Processes for Machine Learning (2006), algorithms 3.1 and 3.2; Tresp (2000).
"""

import math

import numpy as np
from jaxtyping import Float, Int
from mpmath import mp
from scipy.linalg import cholesky, solve_triangular
from scipy.special import erfcx, log_ndtr, ndtr

__all__ = ["bcm_mp", "mpmath_laplace", "numpy_laplace", "numpy_ordinal_terms", "ordinal_log_prob_mp"]


def numpy_ordinal_terms(
    f: Float[np.ndarray, " n"], q: Int[np.ndarray, " n"], thresholds, noise: float
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """log p(q|f), its gradient and its curvature -d2/df2, for each f.

    By symmetry each category is reflected so that its nearer bound is the upper one. With r = phi / p at either bound,
    g = r_far - r_near and W = g (g - near) + (near - far) r_far is a sum of two non-negative terms.
    """
    edges = np.concatenate([[-np.inf], np.asarray(thresholds, float), [np.inf]])
    lower, upper = (edges[q] - f) / noise, (edges[q + 1] - f) / noise
    reflected = np.abs(lower) < np.abs(upper)
    near, far = np.where(reflected, -lower, upper), np.where(reflected, -upper, lower)
    with np.errstate(all="ignore"):
        # the category lies in the left tail: relative to Phi(near), by scaled functions that do not underflow
        exponent = 0.5 * (near - far) * (near + far)  # log phi(far) - log phi(near)
        scaled_near, scaled_far = erfcx(-near / math.sqrt(2)), erfcx(-far / math.sqrt(2))
        share = -np.expm1(exponent + np.log(scaled_far / scaled_near))  # p / Phi(near)
        tail_near = math.sqrt(2 / math.pi) / scaled_near / share
        # it holds the middle of the distribution: 1 minus both tails
        outside = ndtr(far) + ndtr(-near)
        inner_near, inner_far = (np.exp(-0.5 * z**2) / math.sqrt(2 * math.pi) / (1 - outside) for z in (near, far))
        tail = near <= 0
        log_p = np.where(tail, log_ndtr(near) + np.log(share), np.log1p(-outside))
        r_near = np.where(tail, tail_near, inner_near)
        r_far = np.where(tail, tail_near * np.exp(exponent), inner_far)
        g = r_far - r_near
        curvature = g * (g - near) + np.where(np.isinf(far), 0.0, (near - far) * r_far)
    return log_p, np.where(reflected, -g, g) / noise, curvature / noise**2


def _numpy_kernel(x1, x2, theta, variance):
    difference = x1[:, None, :] - x2[None, :, :]
    return variance * np.exp(-np.sum(np.broadcast_to(theta, x1.shape[1:]) * difference**2, axis=-1))


def _numpy_state(K, a, q, thresholds, noise) -> tuple:
    """At f = K a: psi, grad log p, W^1/2, and the Cholesky factor of B = I + W^1/2 K W^1/2."""
    log_p, gradient, w = numpy_ordinal_terms(K @ a, q, thresholds, noise)
    root = np.sqrt(w)
    L = cholesky(np.eye(len(a)) + root[:, None] * K * root, lower=True)
    return np.sum(log_p) - 0.5 * a @ (K @ a), gradient, root, L


def _numpy_mode(K, q, thresholds, noise, max_iterations: int) -> tuple[np.ndarray, int]:
    """R&W 3.1: a = K^-1 f_hat and the number of iterations.

    The book's new a is taken as a correction a + s * step (equal in exact arithmetic, but it converges to rounding);
    s is halved until psi rises. Once psi cannot tell the points apart, full steps follow while they at least halve.
    """
    a, previous = np.zeros(len(q)), np.inf
    for iteration in range(max_iterations if len(q) else 0):
        psi, gradient, root, L = _numpy_state(K, a, q, thresholds, noise)
        residual = gradient - a
        inner = solve_triangular(L, root * (K @ residual), lower=True)
        step = residual - root * solve_triangular(L, inner, lower=True, trans=1)
        size = np.max(np.abs(K @ step))
        resolution = 1e-13 * (1 + abs(psi)) + 1e-15 * np.abs(a) @ np.abs(K) @ np.abs(a)
        scale = 1.0
        if residual @ (K @ step) <= resolution:
            if size >= previous / 2:
                return a, iteration
            previous = size
        else:
            while _numpy_state(K, a + scale * step, q, thresholds, noise)[0] <= psi and scale > 1e-12:
                scale /= 2
        a = a + scale * step
    return a, max_iterations if len(q) else 0


def numpy_laplace(
    x: Float[np.ndarray, "n d"],
    q: Int[np.ndarray, " n"],
    theta,
    variance: float,
    thresholds,
    noise: float,
    x_new: Float[np.ndarray, "m d"],
    max_iterations: int = 500,
) -> dict:
    """Laplace approximation by R&W 3.1, prediction by 3.2, in float64. n = 0 gives the prior.

    Returns mode (n,), mean (m,), variance (m,), log_evidence; residual = max |a - grad log p|; iterations; rounding =
    eps max(|K| |a|), to which f = K a can be had: 1e-15 on ordinary data, 1e-6 at noise 1e-3 with variance 1e4.
    """
    x, q, x_new = np.asarray(x, float), np.asarray(q, int), np.asarray(x_new, float)
    K, k_new = _numpy_kernel(x, x, theta, variance), _numpy_kernel(x, x_new, theta, variance)
    a, iterations = _numpy_mode(K, q, thresholds, noise, max_iterations)
    psi, gradient, root, L = _numpy_state(K, a, q, thresholds, noise)
    v = solve_triangular(L, root[:, None] * k_new, lower=True)
    return {
        "mode": K @ a,
        "mean": k_new.T @ a,
        "variance": variance - np.sum(v**2, axis=0),
        "log_evidence": psi - np.sum(np.log(np.diag(L))),
        "residual": float(np.max(np.abs(gradient - a), initial=0.0)),
        "rounding": float(np.finfo(float).eps * np.max(np.abs(K) @ np.abs(a), initial=0.0)),
        "iterations": iterations,
    }


def _exact(value):  # the binary value of a NumPy or Python number; an mpf passes unchanged
    return value if isinstance(value, mp.mpf) else mp.mpf(float(value))


def ordinal_log_prob_mp(f, lower, upper, noise, digits: int = 50) -> tuple:
    """log p, gradient and curvature -d2/df2 of log[Phi((upper - f)/noise) - Phi((lower - f)/noise)], as mpf.

    `lower`, `upper` are thresholds on the scale of f, infinite at the ends. Inputs count at their exact binary value.
    `digits` are relative for log p and curvature, absolute in 1/noise for the gradient (which may vanish); the working
    precision is raised until the digits that cancelled are made up for.
    """
    spare = 30
    while True:
        with mp.workdps(digits + spare):
            *values, lost = _log_prob_terms(_exact(f), _exact(lower), _exact(upper), _exact(noise))
        if lost + 5 <= spare:
            return tuple(values)
        spare = max(2 * spare, lost + 15)


def _log_prob_terms(f, lower, upper, noise):
    """(log p, gradient, curvature, digits lost) at the present precision."""
    z_low, z_up = (lower - f) / noise, (upper - f) / noise
    below, above = (mp.erfc(s / mp.sqrt(2)) / 2 for s in ((z_up, z_low) if z_low > 0 else (-z_low, -z_up)))
    middle = z_low <= 0 <= z_up
    if middle:  # 1 minus both tails
        below, above = (mp.erfc(z_up / mp.sqrt(2)) + mp.erfc(-z_low / mp.sqrt(2))) / 2, mp.mpf(1)
    p = above - below
    if p <= 0:
        return 0, 0, 0, mp.dps
    r_up, r_low = mp.npdf(z_up) / p, mp.npdf(z_low) / p
    zr_up, zr_low = (0 if mp.isinf(z) else z * r for z, r in ((z_up, r_up), (z_low, r_low)))
    g = r_low - r_up
    curvature = g**2 + zr_up - zr_low
    largest = max(abs(zr_up), abs(zr_low), r_low**2, r_up**2)
    if curvature <= 0 < largest:
        return 0, 0, 0, mp.dps
    lost = max(mp.log10(above / p), mp.log10(largest / curvature)) if largest else 0
    return mp.log1p(-below) if middle else mp.log(p), g / noise, curvature / noise**2, int(mp.ceil(lost))


def _mp_mode(K, terms, tolerance) -> tuple:
    """(a, f, W, psi, LU of I + W K, residual) at the mode; `terms(f)` gives the lists log p, gradient, W."""
    n = len(K)
    a = f = [mp.mpf(0)] * n
    log_p, gradient, w = terms(f)
    psi = mp.fsum(log_p)
    while True:
        residual = [s - r for s, r in zip(gradient, a, strict=True)]
        lu = mp.LU_decomp(mp.eye(n) + mp.matrix([[w[i] * k for k in K[i]] for i in range(n)])) if n else None
        size = max((abs(r) for r in residual), default=mp.mpf(0))
        if size < tolerance:
            return a, f, w, psi, lu, size
        step, scale = _mp_solve(lu, residual), mp.mpf(1)
        while True:
            a_try = [s + scale * r for s, r in zip(a, step, strict=True)]
            f_try = [mp.fdot(row, a_try) for row in K]
            log_p, gradient, w = terms(f_try)
            psi_try = mp.fsum(log_p) - mp.fdot(a_try, f_try) / 2
            if psi_try >= psi - tolerance * (1 + abs(psi)):
                break
            scale /= 2
        a, f, psi = a_try, f_try, psi_try


def _mp_solve(lu, b):
    return list(mp.U_solve(lu[0], mp.L_solve(lu[0], mp.matrix(b), lu[1])))


def mpmath_laplace(
    x: Float[np.ndarray, "n d"],
    q: Int[np.ndarray, " n"],
    theta,
    variance: float,
    thresholds,
    noise: float,
    x_new: Float[np.ndarray, "m d"],
    digits: int = 50,
) -> dict:
    """The same as `numpy_laplace` to about `digits` digits, for n up to about 25.

    Damped Newton on a - grad log p(K a) = 0, with the matrix I + W K. Returns object arrays of mpf, residual included.
    """
    edges = [-mp.inf, *(_exact(t) for t in thresholds), mp.inf]
    scales = [_exact(t) for t in np.broadcast_to(theta, np.shape(x)[1:])]

    def kernel(p, z):
        return _exact(variance) * mp.exp(-mp.fsum(t * (s - r) ** 2 for t, s, r in zip(scales, p, z, strict=True)))

    def terms(f):
        each = [ordinal_log_prob_mp(s, edges[k], edges[k + 1], noise, digits + 15) for s, k in zip(f, q, strict=True)]
        return [[e[j] for e in each] for j in range(3)]

    with mp.workdps(digits + 15):
        points, new = ([[_exact(v) for v in row] for row in np.asarray(z)] for z in (x, x_new))
        K, k_new = ([[kernel(p, z) for z in points] for p in rows] for rows in (points, new))
        a, f, w, psi, lu, residual = _mp_mode(K, terms, mp.mpf(10) ** -digits / _exact(noise))
        solved = [_mp_solve(lu, [s * t for s, t in zip(w, k, strict=True)]) if k else [] for k in k_new]
        return {
            "mode": np.array(f, object),
            "mean": np.array([mp.fdot(k, a) for k in k_new], object),
            "variance": np.array(
                [_exact(variance) - mp.fdot(k, s) for k, s in zip(k_new, solved, strict=True)], object
            ),
            "log_evidence": psi - mp.fsum(mp.log(abs(lu[0][i, i])) for i in range(len(f))) / 2,
            "residual": residual,
        }


def bcm_mp(
    means: Float[np.ndarray, "M m"], variances: Float[np.ndarray, "M m"], prior_variance, digits: int = 50
) -> tuple[np.ndarray, np.ndarray]:
    """Bayesian committee machine as in the paper: 1/v = sum_j 1/v_j - (M - 1)/k_**, mean = v sum_j mean_j / v_j.

    `prior_variance` is a scalar or (m,). Returns (mean, variance), object arrays (m,) of mpf.
    """
    means, variances = np.asarray(means), np.asarray(variances)
    prior = np.broadcast_to(np.asarray(prior_variance, float), means.shape[1:])
    with mp.workdps(digits + 15):
        pairs = []
        for mu, v, k in zip(means.T, variances.T, prior, strict=True):
            precisions = [1 / _exact(vj) for vj in v]
            total = mp.fsum(precisions) - (len(precisions) - 1) / _exact(k)
            pairs.append((mp.fdot(precisions, [_exact(s) for s in mu]) / total, 1 / total))
    return np.array([p[0] for p in pairs], object), np.array([p[1] for p in pairs], object)
