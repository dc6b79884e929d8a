"""Seeded ordinal data sets for the tests: small ones compared digit by digit, and a hostile grid.

Pure NumPy; every call gives the same bits. x lies in the unit cube, q counts from 0, theta is a scalar or (d,).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

__all__ = [
    "SIX",
    "SMALL",
    "Dataset",
    "hostile_cases",
    "near_separable",
    "noisy",
    "rated",
    "repeated",
    "repeated_19",
    "separated",
]

RATINGS = Path(__file__).parents[2] / "hilbo" / "data" / "video_quality.csv"
PEAK = np.array([0.35, 0.6, 0.4])


@dataclass(frozen=True)
class Dataset:
    """One inference problem: n answers q at x, hyperparameters, and m points x_new to predict at."""

    name: str
    x: Float[np.ndarray, "n d"]
    q: Int[np.ndarray, " n"]
    theta: float | tuple[float, ...]
    variance: float
    thresholds: tuple[float, ...]
    noise: float
    x_new: Float[np.ndarray, "m d"]

    def problem(self) -> tuple:
        """The arguments (x, q, theta, variance, thresholds, noise, x_new) of the reference solvers."""
        return self.x, self.q, self.theta, self.variance, self.thresholds, self.noise, self.x_new


def _truth(x: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
    """Latent realism: 1.6 at the peak, falling to about -2 in the far corners."""
    return 1.6 - 4.0 * np.sum((x - PEAK) ** 2, axis=-1)


def _answers(latent, thresholds) -> Int[np.ndarray, " n"]:
    return np.searchsorted(np.asarray(thresholds), latent).astype(np.int64)


def _x_new(rng: np.random.Generator, x: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "m d"]:
    """A trial's own point, the peak, a corner far from the data, and four at random."""
    return np.concatenate([x[:1], PEAK[None], np.ones((1, 3)), rng.random((4, 3))])


def separated() -> Dataset:
    """20 answers without a mistake, at the paper's hyperparameters."""
    rng = np.random.default_rng(101)
    x = rng.random((20, 3))
    thresholds = (-0.5, 0.5)
    return Dataset("separated", x, _answers(_truth(x), thresholds), 30.0, 1.0, thresholds, 0.5, _x_new(rng, x))


def noisy() -> Dataset:
    """25 answers in four categories, made with noise as large as the signal; one theta per dimension, noise 0.9."""
    rng = np.random.default_rng(102)
    x = rng.random((25, 3))
    thresholds = (-0.7, 0.2, 1.1)
    q = _answers(_truth(x) + 0.9 * rng.standard_normal(25), thresholds)
    return Dataset("noisy", x, q, (4.0, 9.0, 2.5), 1.7, thresholds, 0.9, _x_new(rng, x))


def near_separable() -> Dataset:
    """18 answers without a mistake, a smooth kernel and noise 0.1: the likelihood is nearly a set of hard bounds."""
    rng = np.random.default_rng(103)
    x = rng.random((18, 3))
    thresholds = (-0.5, 0.5)
    return Dataset("near_separable", x, _answers(_truth(x), thresholds), 3.0, 1.0, thresholds, 0.1, _x_new(rng, x))


def repeated() -> Dataset:
    """15 answers on 3 stimuli, asked 8, 5 and 2 times, the first two with conflicting answers: K has rank 3."""
    rng = np.random.default_rng(104)
    x = np.repeat(rng.random((3, 3)), (8, 5, 2), axis=0)
    q = np.array([2, 1, 2, 2, 0, 2, 1, 2, 1, 1, 0, 2, 1, 0, 0])
    order = rng.permutation(15)
    return Dataset("repeated", x[order], q[order], 30.0, 1.0, (-0.5, 0.5), 0.5, _x_new(rng, x))


def repeated_19() -> Dataset:
    """25 answers on 3 stimuli, asked 19, 5 and 1 times, with conflicts; the first two stimuli are 1e-3 apart."""
    rng = np.random.default_rng(105)
    first = rng.random(3)
    x = np.repeat(np.stack([first, first + 1e-3, rng.random(3)]), (19, 5, 1), axis=0)
    q = np.concatenate([_answers(0.4 + 0.5 * rng.standard_normal(19), (-0.5, 0.5)), [2, 0, 1, 2, 0], [0]])
    order = rng.permutation(25)
    return Dataset("repeated_19", x[order], q[order], 30.0, 1.0, (-0.5, 0.5), 0.5, _x_new(rng, x))


def rated() -> Dataset:
    """A real person's ratings of 20 videos, in five categories."""
    table = np.genfromtxt(RATINGS, delimiter=",", names=True, dtype=None, encoding="utf-8")
    own = table[table["participant"] == "V09"][:20]
    x = np.stack([np.log(own["bitrate_kbps"] / 375) / np.log(20000 / 375), own["height_px"] / 1080], axis=1)
    thresholds = (-1.0, -0.3, 0.3, 1.0)
    x_new = np.random.default_rng(1).random((5, 2))
    return Dataset("rated", x, own["response"] - 1, 4.0, 1.0, thresholds, 0.5, x_new)


SMALL: tuple[Callable[[], Dataset], ...] = (separated, noisy, near_separable, repeated, repeated_19)
SIX = (*SMALL, rated)

NOISES = (1e-3, 1e-2, 0.1, 0.5, 10.0)
THETAS = (1e-2, 1.0, 30.0, 1e4)
VARIANCES = (1e-3, 1.0, 1e4)
KINDS = {
    0: ("one_category",),
    1: ("one_category", "independent"),
    25: ("one_category", "independent", "conflicting"),
    200: ("one_category", "independent", "conflicting"),
}


def _hostile_labels(kind: str, n: int, index: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """(x, q); the one category takes each of the three in turn with the index of the case."""
    x = rng.random((n, 3))
    if kind == "one_category":
        return x, np.full(n, index % 3, dtype=np.int64)
    if kind == "conflicting":  # five stimuli only, each with lowest and highest answers in turn
        return x[np.arange(n) % 5], np.where((np.arange(n) // 5) % 2 == 0, 0, 2).astype(np.int64)
    return x, rng.integers(0, 3, n)


def hostile_cases() -> Iterator[Dataset]:
    """All 540 cases of noise x theta x variance x n x kind of label, in a fixed order, each named after its values.

    Without answers all kinds of label are the same, and one answer cannot conflict: n = 0 has one kind and n = 1 two.
    """
    shape = [(n, kind) for n, kinds in KINDS.items() for kind in kinds]
    for index, (noise, theta, variance, (n, kind)) in enumerate(product(NOISES, THETAS, VARIANCES, shape)):
        rng = np.random.default_rng([2006, index])
        # the count changes between hyperparameters, so that every kind meets every category
        x, q = _hostile_labels(kind, n, index // len(shape), rng)
        name = f"noise={noise:g} theta={theta:g} variance={variance:g} n={n} {kind}"
        yield Dataset(name, x, q, theta, variance, (-0.5, 0.5), noise, rng.random((4, 3)))
