"""The exact ordinal posterior by two independent ways: quadrature over a few stimuli, and elliptical slice sampling.

No code of hilbo; the kernel is written out again.
"""

import numpy as np
from scipy.special import ndtr
from scipy.stats import multivariate_normal

__all__ = ["genz", "gram", "quadrature", "slice_sampled"]


def gram(x, y, theta, variance):
    """RBF covariances of rows of `x` and rows of `y`; theta a number or one per dimension."""
    squares = (x[:, None] - y[None]) ** 2
    return variance * np.exp(-np.sum(np.asarray(theta) * squares, axis=-1))


def _edges(data):
    edges = np.concatenate([[-np.inf], data.thresholds, [np.inf]])
    return edges[data.q], edges[data.q + 1]


def _log_p(f, lower, upper, noise):
    a, b = (lower - f) / noise, (upper - f) / noise
    flip = a + b > 0
    a, b = np.where(flip, -b, a), np.where(flip, -a, b)
    with np.errstate(divide="ignore"):
        return np.log(ndtr(b) - ndtr(a))


def quadrature(data, cells=101, reach=7.5):
    """(log evidence, mean, variance, class probabilities at x_new) where the answers are on at most 3 stimuli.

    Trapezoidal rule over whitened latent values of the stimuli, whose error falls faster than any power of the step.
    """
    stimuli, which = np.unique(data.x, axis=0, return_inverse=True)
    which = which.ravel()
    prior = gram(stimuli, stimuli, data.theta, data.variance)
    values, vectors = np.linalg.eigh(prior)
    root = vectors * np.sqrt(values)
    side = np.linspace(-reach, reach, cells)
    w = np.stack(np.meshgrid(*(side,) * len(stimuli), indexing="ij"), axis=-1).reshape(-1, len(stimuli))
    f = w @ root.T
    lower, upper = _edges(data)
    log_weight = -0.5 * np.sum(w**2, axis=1) + len(stimuli) * np.log((side[1] - side[0]) / np.sqrt(2 * np.pi))
    for stimulus in range(len(stimuli)):
        for low, high in set(zip(lower[which == stimulus], upper[which == stimulus], strict=True)):
            count = np.sum((which == stimulus) & (lower == low) & (upper == high))
            log_weight += count * _log_p(f[:, stimulus], low, high, data.noise)
    highest = log_weight.max()
    weight = np.exp(log_weight - highest)
    weight /= weight.sum()
    cross = gram(stimuli, data.x_new, data.theta, data.variance)
    along = np.linalg.solve(prior, cross)
    at = f @ along
    rest = data.variance - np.sum(cross * along, axis=0)
    mean = weight @ at
    variance = rest + weight @ (at - mean) ** 2
    edges = np.concatenate([[-np.inf], data.thresholds, [np.inf]])
    below = ndtr((edges[:, None, None] - at[None]) / np.sqrt(data.noise**2 + rest))
    probabilities = np.einsum("s,csm->mc", weight, np.diff(below, axis=0))
    evidence = highest + np.log(np.sum(np.exp(log_weight - highest)))
    return evidence, mean, variance, probabilities


def slice_sampled(data, chains=400, steps=600, seed=0):
    """Posterior means and standard errors at x_new, by elliptical slice sampling (Murray, Adams & MacKay 2010).

    Many chains side by side; each one's mean over its second half is one independent number.
    """
    rng = np.random.default_rng(seed)
    prior = gram(data.x, data.x, data.theta, data.variance)
    values, vectors = np.linalg.eigh(prior)
    root = vectors * np.sqrt(np.maximum(values, 0))
    lower, upper = _edges(data)

    def log_likelihood(w):
        return np.sum(_log_p(w @ root.T, lower, upper, data.noise), axis=1)

    n = len(data.q)
    inside = np.clip((np.maximum(lower, -1.5) + np.minimum(upper, 1.5)) / 2, -1.5, 1.5)
    start = np.linalg.lstsq(root.T @ root + 0.01 * np.eye(n), root.T @ inside, rcond=None)[0]
    w = np.tile(start, (chains, 1))
    now, total = log_likelihood(w), np.zeros_like(w)
    for step in range(steps):
        ellipse = rng.standard_normal(w.shape)
        height = now + np.log(rng.random(chains))
        angle = rng.uniform(0, 2 * np.pi, chains)
        low, high = angle - 2 * np.pi, angle.copy()
        moving, new, new_value = np.ones(chains, bool), w.copy(), now.copy()
        while moving.any():
            rows = np.flatnonzero(moving)
            trial = w[rows] * np.cos(angle[rows])[:, None] + ellipse[rows] * np.sin(angle[rows])[:, None]
            value = log_likelihood(trial)
            good = value > height[rows]
            new[rows[good]], new_value[rows[good]] = trial[good], value[good]
            moving[rows[good]] = False
            bad = rows[~good]
            low[bad] = np.where(angle[bad] < 0, angle[bad], low[bad])
            high[bad] = np.where(angle[bad] >= 0, angle[bad], high[bad])
            angle[bad] = rng.uniform(low[bad], high[bad])
        w, now = new, new_value
        if step >= steps // 2:
            total += w
    mean = total / (steps - steps // 2)
    cross = gram(data.x, data.x_new, data.theta, data.variance)
    along = np.linalg.lstsq(prior, cross, rcond=1e-12)[0]
    at = mean @ root.T @ along
    return at.mean(axis=0), at.std(axis=0, ddof=1) / np.sqrt(chains)


def genz(data, replicates=12, seed=0):
    """Log evidence and its standard error: SciPy's separation of variables, several times."""
    lower, upper = _edges(data)
    matrix = gram(data.x, data.x, data.theta, data.variance) + data.noise**2 * np.eye(len(lower))
    normal = multivariate_normal(np.zeros(len(lower)), matrix)
    probabilities = [
        multivariate_normal.cdf(
            upper, mean=normal.mean, cov=matrix, lower_limit=lower, maxpts=40000, abseps=0, releps=1e-6,
            rng=np.random.default_rng([seed, r]),
        )
        for r in range(replicates)
    ]  # fmt: skip
    mean = np.mean(probabilities)
    return np.log(mean), np.std(probabilities, ddof=1) / np.sqrt(replicates) / mean
