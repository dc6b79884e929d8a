"""Settings that nobody should choose, for every inference: a Latin hypercube of hyperparameters and kinds of answers.

Noise 1e-4 to 10, theta 1e-3 to 1e5, variance 1e-6 to 1e6, gaps between thresholds 1e-4 to 1e2, 2 to 10 categories, 0 to
600 answers, 1 to 20 dimensions; answers independent of x, sensible, of one category, conflicting on five points, on one
point, on a line. Every value of an axis occurs equally often, in an order of its own. New points include asked ones.
Where the points are equal, or so far apart that the prior knows no connection, `reference` has the exact posterior.
"""

from collections.abc import Iterator

import numpy as np
from datasets import Dataset
from reference_laplace import numpy_ordinal_terms

__all__ = ["DIMENSIONS", "reference", "stress_cases"]

AXES = {
    "noise": (1e-4, 1e-3, 1e-2, 0.1, 0.5, 10.0),
    "theta": (1e-3, 0.1, 3.0, 30.0, 1e3, 1e5),
    "variance": (1e-6, 1e-3, 1.0, 1e3, 1e6),
    "gap": (1e-4, 0.01, 1.0, 100.0),
    "categories": (2, 3, 10),
    "dimensions": (1, 2, 3, 20),
    "kind": ("independent", "sensible", "one category", "conflicting", "one point", "line"),
}
DIMENSIONS = 20  # inputs of fewer dimensions are padded with zeros, so that all cases share their compiled fits
COUNTS = {"small": (0, 1, 2, 7, 25), "hundred": (100,), "large": (600,)}


def stress_cases(size: str, count: int) -> Iterator[Dataset]:
    """`count` cases of a size in COUNTS, those beyond "small" of three categories, always the same ones."""
    axes = {**AXES, "n": COUNTS[size]} if size == "small" else {**AXES, "categories": (3,), "n": COUNTS[size]}
    decks = {}
    for index, (name, values) in enumerate(axes.items()):
        order = np.random.default_rng([5, sum(map(ord, size)), index]).permutation(count)
        decks[name] = [values[place % len(values)] for place in order]
    for case in range(count):
        yield _case(np.random.default_rng([6, sum(map(ord, size)), case]), {k: deck[case] for k, deck in decks.items()})


def _case(rng, chosen) -> Dataset:
    n, categories, kind = chosen["n"], chosen["categories"], chosen["kind"]
    x = np.zeros((n + 3, DIMENSIONS))
    x[:, : chosen["dimensions"]] = rng.random((n + 3, chosen["dimensions"]))
    thresholds = (np.arange(categories - 1) - (categories - 2) / 2) * chosen["gap"]
    latent = np.sqrt(chosen["variance"]) * 2.0 * np.cos(4.0 * x[:n, 0]) + chosen["noise"] * rng.standard_normal(n)
    q = rng.integers(0, categories, n)
    if kind == "sensible":
        q = np.searchsorted(thresholds, latent)
    elif kind == "one category":
        q[:] = rng.integers(0, categories)
    elif kind == "conflicting":
        x[:n] = x[np.arange(n) % 5]
        q = np.where((np.arange(n) // 5) % 2 == 0, 0, categories - 1)
    elif kind == "one point":
        x[:n] = x[:1]
    elif kind == "line":
        x[:n] = x[:1] * np.linspace(0.0, 1.0, n)[:, None]
    name = " ".join(f"{k}={v:g}" if not isinstance(v, str) else v for k, v in chosen.items())
    x_new = np.concatenate([x[: min(n, 3)], x[n:]])
    return Dataset(
        name, x[:n], q.astype(np.int64), chosen["theta"], chosen["variance"], tuple(thresholds), chosen["noise"], x_new
    )


def reference(case: Dataset):
    """(log evidence, means, variances at the asked points) of the exact posterior by quadrature in one variable, where
    the asked points are equal or unconnected; None elsewhere."""
    stimuli, which = np.unique(case.x, axis=0, return_inverse=True)
    apart = np.sum((stimuli[:, None] - stimuli[None]) ** 2, axis=-1)[~np.eye(len(stimuli), dtype=bool)]
    if not len(case.q) or np.min(apart, initial=np.inf) * case.theta < 80.0:
        return None
    which, parts = which.ravel(), []
    for stimulus in range(len(stimuli)):
        parts.append(_one_stimulus(case.q[which == stimulus], case))
    evidence, mean, variance = (np.array(column) for column in zip(*parts, strict=True))
    return np.sum(evidence), mean[which], variance[which]


def _one_stimulus(q, case):
    """Trapezoidal rule between the points where the log density has fallen by 60 from its maximum."""
    kinds, counts = np.unique(q, return_counts=True)

    def log_joint(f):
        terms = [c * numpy_ordinal_terms(f, np.full(len(f), k), case.thresholds, case.noise)[0]
                 for k, c in zip(kinds, counts, strict=True)]  # fmt: skip
        return sum(terms) - 0.5 * f**2 / case.variance - 0.5 * np.log(2 * np.pi * case.variance)

    sd = np.sqrt(case.variance)
    edges = np.array(case.thresholds)
    reach = 12 * (sd + case.noise)
    low, high = min(0.0, edges[0]) - reach, max(0.0, edges[-1]) + reach
    for _ in range(60):
        f = np.linspace(low, high, 801)
        values = log_joint(f)
        inside = np.flatnonzero(values > np.nanmax(values) - 60.0)
        new = f[max(inside[0] - 1, 0)], f[min(inside[-1] + 1, 800)]
        if inside[-1] - inside[0] > 400 or new == (low, high):
            break
        low, high = new
    f = np.linspace(*new, 40001)
    values = log_joint(f)
    highest = np.max(values)
    weight = np.exp(values - highest)
    total = np.sum(weight)
    mean = np.sum(weight * f) / total
    return highest + np.log(total * (f[1] - f[0])), mean, np.sum(weight * (f - mean) ** 2) / total
