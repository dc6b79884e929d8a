"""The textbook NumPy form, against which hilbo's speed is quoted.

What a competent engineer writes from Rasmussen & Williams (2006) in plain NumPy and SciPy, in float64 and not slowed
down on purpose: Laplace by algorithm 3.1 (Cholesky of B = I + W^1/2 K W^1/2, `log_ndtr`, Newton with step halving
until psi changes by less than 1e-10), prediction by 3.2 (one triangular solve for all candidates, squared distances
by matrix products, memory laid out so that LAPACK copies nothing), hyperparameters by L-BFGS-B on the evidence with
the analytic gradient of algorithm 5.1. Every trial of a session is fitted and predicted afresh, every person's
posterior in turn. It imports nothing of hilbo.

The number of BLAS threads is set by the caller (threadpoolctl, or OPENBLAS_NUM_THREADS), not here.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import minimize
from scipy.special import log_ndtr, ndtr

__all__ = [
    "Fit",
    "Hyper",
    "evidence_and_gradient",
    "fit",
    "optimise_hyperparameters",
    "predict",
    "session_25",
    "study_24x25_bcm",
    "ucb_choice",
]

LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)


@dataclass(frozen=True)
class Hyper:
    """k = variance exp(-theta |x - x'|^2); thresholds and noise of the ordinal probit. Defaults: the paper's values."""

    theta: float = 30.0
    variance: float = 1.0
    thresholds: tuple[float, ...] = (-0.5, 0.5)
    noise: float = 0.5


PAPER = Hyper()


@dataclass(frozen=True)
class Fit:
    """A Laplace posterior: trials x, a = K^-1 f, root = W^1/2, the Cholesky factor L of B, K, log evidence."""

    hyper: Hyper
    x: Float[np.ndarray, "n d"]
    a: Float[np.ndarray, " n"]
    root: Float[np.ndarray, " n"]
    L: Float[np.ndarray, "n n"]
    K: Float[np.ndarray, "n n"]
    log_evidence: float


def squared_distances(x1: Float[np.ndarray, "n d"], x2: Float[np.ndarray, "m d"]) -> Float[np.ndarray, "n m"]:
    """|x1|^2 + |x2|^2 - 2 x1.x2, rounding below 0 removed."""
    r2 = x1 @ (-2.0 * x2.T)
    r2 += np.einsum("ij,ij->i", x1, x1)[:, None]
    r2 += np.einsum("ij,ij->i", x2, x2)
    return np.maximum(r2, 0.0, out=r2)


def kernel(x1: Float[np.ndarray, "n d"], x2: Float[np.ndarray, "m d"], hyper: Hyper) -> Float[np.ndarray, "n m"]:
    k = squared_distances(x1, x2)
    k *= -hyper.theta
    np.exp(k, out=k)
    k *= hyper.variance
    return k


def _bounds(q: Int[np.ndarray, " n"], hyper: Hyper) -> tuple[np.ndarray, np.ndarray]:
    edges = np.array([-np.inf, *hyper.thresholds, np.inf])
    return edges[q], edges[q + 1]


def _log_p(f, bounds, noise) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """log p and the standardised bounds (lo, up): differences of log_ndtr in the tails, 1 - both tails between."""
    lo, up = (bounds[0] - f) / noise, (bounds[1] - f) / noise
    right = lo > 0
    low, high = np.where(right, -up, lo), np.where(right, -lo, up)
    log_high = log_ndtr(high)
    tail = log_high + np.log(-np.expm1(log_ndtr(low) - log_high))
    return np.where(high <= 0, tail, np.log1p(-ndtr(low) - ndtr(-high))), lo, up


def _moments(log_p, lo, up, order: int) -> list[np.ndarray]:
    """m_k = up^k phi(up)/p - lo^k phi(lo)/p, k = 0..order; derivatives are polynomials in them. Infinite bounds: 0."""
    r_up, r_lo = np.exp(-0.5 * up * up - LOG_SQRT_2PI - log_p), np.exp(-0.5 * lo * lo - LOG_SQRT_2PI - log_p)
    up, lo = np.where(np.isinf(up), 0.0, up), np.where(np.isinf(lo), 0.0, lo)
    return [up**k * r_up - lo**k * r_lo for k in range(order + 1)]


def _mode(K, bounds, noise, tolerance: float, max_iterations: int) -> tuple[np.ndarray, np.ndarray]:
    """R&W 3.1 lines 1-9 with step halving: a = K^-1 f and f at the mode."""
    n = len(K)
    a, f = np.zeros(n), np.zeros(n)
    log_p, lo, up = _log_p(f, bounds, noise)
    psi = log_p.sum()
    for _ in range(max_iterations):
        m0, m1 = _moments(log_p, lo, up, 1)
        w = np.maximum(m0 * m0 + m1, 0.0) / noise**2
        L, root = _factor(K, w)
        b = w * f - m0 / noise
        inner = solve_triangular(L, root * (K @ b), lower=True, check_finite=False)
        target = b - root * solve_triangular(L, inner, lower=True, trans=1, check_finite=False)
        scale, previous = 1.0, psi
        for _ in range(40):
            a_new = a + scale * (target - a)
            f_new = K @ a_new
            log_p, lo, up = _log_p(f_new, bounds, noise)
            psi = log_p.sum() - 0.5 * a_new @ f_new
            if psi >= previous - tolerance:
                break
            scale *= 0.5
        a, f = a_new, f_new
        if abs(psi - previous) < tolerance:
            break
    return a, f


def _factor(K, w) -> tuple[np.ndarray, np.ndarray]:
    """The Cholesky factor of B and W^1/2."""
    root = np.sqrt(w)
    B = root[:, None] * K * root
    B.flat[:: len(w) + 1] += 1.0
    return cholesky(B, lower=True, overwrite_a=True, check_finite=False), root


@np.errstate(divide="ignore", invalid="ignore", over="ignore")
def fit(x, q, hyper: Hyper = PAPER, tolerance: float = 1e-10, max_iterations: int = 100) -> Fit:
    """R&W 3.1: the Laplace posterior of n >= 1 answers q (n,) at x (n, d)."""
    K, bounds = kernel(x, x, hyper), _bounds(q, hyper)
    a, f = _mode(K, bounds, hyper.noise, tolerance, max_iterations)
    log_p, lo, up = _log_p(f, bounds, hyper.noise)
    m0, m1 = _moments(log_p, lo, up, 1)
    L, root = _factor(K, np.maximum(m0 * m0 + m1, 0.0) / hyper.noise**2)
    log_evidence = log_p.sum() - 0.5 * a @ f - np.log(np.diag(L)).sum()
    return Fit(hyper, x, a, root, L, K, log_evidence)


def predict(
    posterior: Fit, candidates: Float[np.ndarray, "m d"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """R&W 3.2: posterior mean and standard deviation of the latent at the candidates."""
    k = kernel(candidates, posterior.x, posterior.hyper)  # (m, n): its transpose is in the column order LAPACK wants
    mean = k @ posterior.a
    k *= posterior.root
    v = solve_triangular(posterior.L, k.T, lower=True, overwrite_b=True, check_finite=False)
    variance = posterior.hyper.variance - np.einsum("ij,ij->j", v, v)
    return mean, np.sqrt(variance)


def ucb_choice(mean, sd, weight: float = 0.7) -> int:
    """The index of the candidate with the largest mean + weight * sd."""
    return int(np.argmax(mean + weight * sd))


def session_25(
    initial: Float[np.ndarray, "5 d"],
    candidates: Float[np.ndarray, "m d"],
    answer: Callable[[np.ndarray, int], int],
    hyper: Hyper = PAPER,
    trials: int = 25,
    weight: float = 0.7,
) -> tuple[np.ndarray, np.ndarray]:
    """A session: initial points, then UCB over the candidates; `answer(x, trial)` gives the category. Returns x, q."""
    x, q = list(initial), [answer(point, i) for i, point in enumerate(initial)]
    while len(x) < trials:
        posterior = fit(np.array(x), np.array(q), hyper)
        x.append(candidates[ucb_choice(*predict(posterior, candidates), weight)])
        q.append(answer(x[-1], len(x) - 1))
    return np.array(x), np.array(q)


def study_24x25_bcm(
    people: Sequence[tuple[np.ndarray, np.ndarray]], candidates: Float[np.ndarray, "m d"], hyper: Hyper = PAPER
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Fits each person's (x, q), predicts at the candidates, and merges by the committee: mean and variance (m,)."""
    precision = np.full(len(candidates), -(len(people) - 1) / hyper.variance)
    weighted = np.zeros(len(candidates))
    for x, q in people:
        mean, sd = predict(fit(x, q, hyper), candidates)
        added = 1.0 / sd**2
        precision += added
        weighted += added * mean
    return weighted / precision, 1.0 / precision


@np.errstate(divide="ignore", invalid="ignore", over="ignore")
def evidence_and_gradient(x, q, hyper: Hyper, r2: np.ndarray | None = None) -> tuple[float, Float[np.ndarray, "2"]]:
    """log Z and its gradient in (log theta, log noise), R&W 5.1; r2 are the squared distances, if known.

    The implicit part is s2' df, s2 = d(-log|B|/2)/df = +diag((K^-1 + W)^-1) * d3 log p / 2, since dW/df = -d3 log p.
    """
    c = hyper.noise
    r2 = squared_distances(x, x) if r2 is None else r2
    K, bounds = hyper.variance * np.exp(-hyper.theta * r2), _bounds(q, hyper)
    a, f = _mode(K, bounds, c, 1e-10, 100)
    log_p, lo, up = _log_p(f, bounds, c)
    m0, m1, m2, m3 = _moments(log_p, lo, up, 3)
    L, root = _factor(K, np.maximum(m0 * m0 + m1, 0.0) / c**2)
    log_evidence = log_p.sum() - 0.5 * a @ f - np.log(np.diag(L)).sum()

    half = solve_triangular(L, np.diag(root), lower=True, check_finite=False)
    R = half.T @ half  # W^1/2 B^-1 W^1/2 = (K + W^-1)^-1
    posterior_diagonal = np.diag(K) - np.einsum("ij,ij->j", half @ K, half @ K)
    s2 = -0.5 * posterior_diagonal * (m2 - m0 + 3 * m0 * m1 + 2 * m0**3) / c**3

    def implicit(b):  # df = (I + K W)^-1 b
        return s2 @ (b - K @ (R @ b))

    dK = -hyper.theta * r2 * K
    g = -m0 / c
    by_theta = 0.5 * a @ dK @ a - 0.5 * np.sum(R * dK) + implicit(dK @ g)
    dg = -(m2 + m0 * m1 - m0) / c
    dw = (m3 + m1 * m1 - 3 * m1 + 2 * m0 * m2 + 2 * m0 * m0 * m1 - 2 * m0 * m0) / c**2
    by_noise = -m1.sum() - 0.5 * posterior_diagonal @ dw + implicit(K @ dg)
    return log_evidence, np.array([by_theta, by_noise])


def optimise_hyperparameters(
    x, q, starts: Float[np.ndarray, "s 2"], hyper: Hyper = PAPER, bounds=((0.1, 1e3), (0.05, 10.0))
) -> tuple[Hyper, float]:
    """Maximum evidence in (theta, noise) over the starts (values, not logs), by L-BFGS-B on the logs within bounds."""
    r2 = squared_distances(x, x)

    def at(log_values):
        theta, noise = np.exp(log_values)
        return Hyper(float(theta), hyper.variance, hyper.thresholds, float(noise))

    def loss(log_values):
        value, gradient = evidence_and_gradient(x, q, at(log_values), r2)
        return -value, -gradient

    runs = [minimize(loss, np.log(s), jac=True, method="L-BFGS-B", bounds=np.log(bounds)) for s in starts]
    best = min(runs, key=lambda run: run.fun)
    return at(best.x), -float(best.fun)
