"""From creep and relaxation tests to the parameters of the FO-SLS that make the same curves.

A sampled model is fitted to what was measured: the recorded input (position in relaxation, force in creep) goes through
the model and its output is compared, so that no ideal step is assumed. Coordinates (physics of the three parts, each
in its own time range, so that the column-scaled Jacobian has a condition number of about 30 instead of 30,000):

    q = (K_inst, K_eff, log κ, logit α),  K_inst = K0 + K1/(1 + κ) = H(∞),  K_eff = H(1),  κ = K1·T^α/B1
    H(z) = K_eff + (K_inst - K_eff)·(1 + κ)·(C(z) - S) / ((1 - S)·(κ + C(z))),  S = C(1)

with C(z) = Σ_{i=0..N} c_i z^{-i} (`viscoelastic`), or (1 - 1/z)^α with full memory, where S = 0. A response is the
inverse transform of H(z)·X(z) (of X(z)/H(z) for creep) on a circle |z| = r > 1: two FFTs whatever N is. The circle
damps what wraps around by r^{-L} = eps^0.8, so the curves are those of the recursion to about eps^0.75.
Modulus data G(t), J(t) have no sampled input; they are fitted by the exact Mittag-Leffler forms (`moduli`).

Residuals are divided by the range of their curve; the cost is the sum over tests of NRMSE².
Units: N, mm, s; B1 N·s^α/mm. Moduli keep their own unit.
"""

from collections.abc import Sequence
from typing import Any, Literal, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hilbo.errors import InputError
from hilbo.least_squares import Solution, least_squares

__all__ = [
    "Curve",
    "Fit",
    "Model",
    "Sampled",
    "Test",
    "curve_residuals",
    "fit",
    "nrmse",
    "polish",
    "residuals",
    "search",
]

Kind = Literal["relaxation", "creep", "modulus", "compliance"]
MEASURED = ("relaxation", "creep")  # kinds with a recorded input
FEWEST = 8  # points of a test
_TAPS = 1024
_RACE, _LONGEST = 12, 200  # steps of every start, and of the best one
_LOG_KAPPA = np.log(10.0) * np.arange(-5.0, 3.1, 0.5)
_LOGIT_ALPHA = np.array([-3.5, -2.2, -1.4, -0.6, 0.0, 0.6, 1.4, 2.2, 3.5, 4.4])


class Test(eqx.Module):
    """One kind of test and its repeats, which share their times.

    `time` (m,) in s, increasing; `output` (R, m): force (N) of relaxation, position (mm) of creep, modulus or
    compliance; `input` (R, m): the position (mm) or force (N) that was applied, None for moduli. Before the first row
    the material is at rest with no input (`start="rest"`), or in equilibrium with the first one.
    Raises `InputError` for too few points, times that do not increase, numbers that are not finite, and flat curves.
    """

    __test__ = False  # no test of pytest's

    kind: Kind = eqx.field(static=True)
    time: Float[np.ndarray, " m"]
    output: Float[np.ndarray, "R m"]
    input: Float[np.ndarray, "R m"] | None = None
    start: Literal["rest", "equilibrium"] = eqx.field(static=True, default="rest")

    def __check_init__(self):
        m = self.time.size
        if m < FEWEST:
            raise InputError(f"The {self.kind} test has {m} points; at least {FEWEST} are needed for four parameters.")
        if not np.all(np.diff(self.time) > 0):
            raise InputError(f"The times of the {self.kind} test do not increase from row to row; sort its rows.")
        if (self.input is None) == (self.kind in MEASURED):
            needs = "needs the recorded input beside the output" if self.input is None else "has no input"
            raise InputError(f"A {self.kind} test {needs}.")
        parts = (self.time, self.output) if self.input is None else (self.time, self.output, self.input)
        if not all(np.all(np.isfinite(part)) for part in parts):
            raise InputError(f"The {self.kind} test has numbers that are not finite; leave those rows out.")
        if not np.ptp(self.output.mean(axis=0)) > 0:
            raise InputError(f"The output of the {self.kind} test does not change; there is nothing to fit.")
        if self.input is not None and not np.any(self.input):
            raise InputError(f"The input of the {self.kind} test is 0 throughout; check the columns.")

    @property
    def repeats(self) -> int:
        """How often it was done."""
        return self.output.shape[0]


class Model(Protocol):
    """What is fitted: a prediction of four coordinates q, with bounds and starts that the data suggest.

    `Sampled` (below), `moduli.Continuous` and `moduli.FractionalMaxwell`. `labels` name the coordinates, `kinds` the
    tests that it can make.
    """

    labels: tuple[str, ...]
    kinds: tuple[str, ...]

    def at(self, tests: Sequence[Test]) -> "Model": ...
    def box(self, tests: Sequence[Test]) -> tuple[np.ndarray, np.ndarray]: ...
    def starts(self, tests: Sequence[Test]) -> np.ndarray: ...
    def prepare(self, test: Test) -> "Curve": ...
    def predict(self, q: Array, curve: "Curve", weights: Array) -> Array: ...
    def natural(self, q: Array) -> Array: ...
    def parameters(self, q: Array) -> dict[str, Array]: ...


class Curve(eqx.Module):
    """A test made ready for one model: its mean over weighted repeats is what is fitted.

    The model is linear in its input, so the mean of the repeats is the response to the mean of their inputs, exactly.
    `spectra` (R, L/2+1): damped transforms of the inputs on the model's time grid; `before`, `share`: where the
    measured times lie on it; `scale`: what residuals are divided by.
    """

    kind: Kind = eqx.field(static=True)
    time: Float[Array, " m"]
    output: Float[Array, "R m"]
    offset: Float[Array, " R"]  # input of the equilibrium before the test
    scale: Float[Array, " m"]
    spectra: Array | None = None
    before: Int[Array, " m"] | None = None
    share: Float[Array, " m"] | None = None
    length: int = eqx.field(static=True, default=0)


class Sampled(eqx.Module):
    """The FO-SLS as it is rendered: sampled every `T` s, with the last `N` samples or full memory.

    Full memory is the infinite sum, which `viscoelastic`'s sum of exponentials meets to 1e-4 of the largest force.
    """

    N: int | Int[Array, ""] = 101
    T: float = eqx.field(static=True, default=1e-3)
    memory: Literal["short", "full"] = eqx.field(static=True, default="short")
    capacity: int = eqx.field(static=True, default=0)  # taps that are computed; models with one capacity compile once

    labels = ("K_inst", "K_eff", "kappa", "alpha")
    kinds = MEASURED

    def __check_init__(self):
        if isinstance(self.N, int) and self.N < 1:
            raise InputError(f"N is {self.N}, it must be at least 1: the number of past samples.")
        if not 0 < self.T < np.inf:
            raise InputError(f"T is {self.T}, it must be a time in s above 0.")

    def box(self, tests: Sequence[Test]) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of q: stiffness up to 50 times the largest secant, κ up to 1e4, α from 0.01 to 0.99.

        κ goes down to 1e-4, or 1e-6 with full memory. Far below S(α) the curve no longer depends on it, and K1 would
        grow as 1/κ for ever.
        """
        top = max(_secant(test) for test in tests)
        ends = np.log(0.99 / 0.01)
        least = 1e-6 if self.memory == "full" else 1e-4
        lower = np.array([1e-3 * top, 0.0, np.log(least), -ends])
        return lower, np.array([50 * top, 50 * top, np.log(1e4), ends])

    def starts(self, tests: Sequence[Test]) -> Float[np.ndarray, "starts 4"]:
        """The five best separate places of a grid in (κ, α).

        Read from position to force, every test is linear in K_inst and K_eff, which are solved for at each place.
        """
        curves = tuple(self.prepare(_position_driven(test)) for test in tests)
        lower, upper = self.box(tests)
        scales = [jnp.asarray(np.ptp(test.output.mean(axis=0)) * _unit_of_force(test)) for test in tests]
        grid = jnp.asarray(np.stack(np.meshgrid(_LOG_KAPPA, _LOGIT_ALPHA, indexing="ij"), axis=-1))
        costs, stiffness = (np.asarray(part) for part in _screen(self, curves, scales, grid))
        found = [np.concatenate([stiffness[at], np.asarray(grid[at])]) for at in _separate(costs, 5)]
        return np.clip(np.stack(found), lower, upper)

    def prepare(self, test: Test) -> Curve:
        """Inputs on the grid of the model, transformed; positions between grid points by linear interpolation."""
        assert test.input is not None
        elapsed = test.time - test.time[0]
        place = elapsed / self.T
        near = np.round(place)
        place = np.where(np.abs(place - near) < 1e-6, near, place)
        count = int(np.ceil(place[-1])) + 1
        grid = np.arange(count) * self.T
        offset = test.input[:, 0] if test.start == "equilibrium" else np.zeros(test.repeats)
        inputs = np.stack([np.interp(grid, elapsed, row) for row in test.input]) - offset[:, None]
        length = _transform_length(count)
        damped = inputs * _circle(length, inputs.dtype) ** -np.arange(count, dtype=inputs.dtype)
        before = np.minimum(place.astype(int), count - 2)
        return Curve(
            test.kind,
            jnp.asarray(elapsed),
            jnp.asarray(test.output),
            jnp.asarray(offset),
            jnp.asarray(np.full(test.time.size, np.ptp(test.output.mean(axis=0)))),
            jnp.asarray(np.fft.rfft(damped, length)),
            jnp.asarray(before),
            jnp.asarray(place - before),
            length,
        )

    def predict(self, q: Float[Array, " 4"], curve: Curve, weights: Float[Array, " R"]) -> Float[Array, " m"]:
        """The response to the weighted mean of the inputs, at the measured times."""
        assert curve.spectra is not None and curve.share is not None and curve.before is not None
        H = self._transfer(q, curve.length)
        creep = curve.kind == "creep"
        spectrum = weights.astype(curve.spectra.dtype) @ curve.spectra
        spectrum = spectrum / H if creep else spectrum * H
        growth = _circle(curve.length, q.dtype) ** jnp.arange(curve.length // 2, dtype=q.dtype)
        found = jnp.fft.irfft(spectrum, curve.length)[: curve.length // 2] * growth
        rest = weights @ curve.offset
        rest = rest / q[1] if creep else rest * q[1]
        return rest + found[curve.before] * (1 - curve.share) + found[curve.before + 1] * curve.share

    def parameters(self, q: Float[Array, " 4"]) -> dict[str, Float[Array, ""]]:
        """K0, K1 (N/mm), B1 (N·s^α/mm) and α, with K_inst and K_eff (N/mm) beside them."""
        K_inst, K_eff, kappa, alpha = q[0], q[1], jnp.exp(q[2]), jax.nn.sigmoid(q[3])
        S = self._taps(alpha)[1]
        K1 = (K_inst - K_eff) * (1 + kappa) * (kappa + S) / (kappa * (1 - S))
        K0, B1 = K_eff - K1 * S / (kappa + S), K1 / kappa * self.T**alpha
        return {"K0": K0, "K1": K1, "B1": B1, "alpha": alpha, "K_inst": K_inst, "K_eff": K_eff}

    def natural(self, q: Float[Array, " 4"]) -> Float[Array, " 4"]:
        """The coordinates under their labels: K_inst, K_eff (N/mm), κ and α."""
        return jnp.stack([q[0], q[1], jnp.exp(q[2]), jax.nn.sigmoid(q[3])])

    def at(self, tests: Sequence[Test]) -> "Sampled":
        """The same with N as an array among at least 1024 taps, so that every N is the same compiled function."""
        del tests
        if self.memory == "full" or self.capacity:
            return self
        return Sampled(jnp.asarray(self.N), self.T, self.memory, max(_TAPS, int(self.N)))

    def coordinates(self, K0: float, K1: float, B1: float, alpha: float) -> Float[np.ndarray, " 4"]:
        """q of a parameter set."""
        kappa = K1 * self.T**alpha / B1
        S = float(self._taps(jnp.asarray(alpha))[1])
        ends = K0 + K1 / (1 + kappa), K0 + K1 * S / (kappa + S)
        return np.array([*ends, np.log(kappa), np.log(alpha / (1 - alpha))])

    def _transfer(self, q, length):
        """H on the circle, at the upper half of `length` points."""
        kappa, alpha = jnp.exp(q[2]), jax.nn.sigmoid(q[3])
        radius = _circle(length, q.dtype)
        taps, S = self._taps(alpha)
        if self.memory == "full":
            angle = 2 * jnp.pi * jnp.arange(length // 2 + 1, dtype=q.dtype) / length
            C = (1 - jnp.exp(-1j * angle) / radius) ** alpha
        else:
            taps = taps[: length // 2]  # those beyond the data act through S only
            C = jnp.fft.rfft(taps * radius ** -jnp.arange(taps.size, dtype=q.dtype), length)
        return q[1] + (q[0] - q[1]) * (1 + kappa) / (1 - S) * (C - S) / (kappa + C)

    def _taps(self, alpha):
        """c_0 … c_N, zero beyond, and S = C(1), by products of positive numbers."""
        if self.memory == "full":
            return jnp.ones(1, alpha.dtype), jnp.zeros_like(alpha)
        i = jnp.arange(1, (self.capacity or int(self.N)) + 1, dtype=alpha.dtype)
        sums = jnp.cumprod(jnp.where(i <= self.N, 1 - alpha / i, 1))
        taps = jnp.where(i <= self.N, alpha / i, 0) * jnp.concatenate([jnp.ones(1, alpha.dtype), sums[:-1]])
        return jnp.concatenate([jnp.ones(1, alpha.dtype), -taps]), sums[-1]


class Fit(eqx.Module):
    """The best fit of a model to tests.

    `solution` is its minimum (`least_squares.Solution`), `start_costs` those that the starts ended in, `weights` (R,)
    of the repeats of each curve.
    """

    model: Any  # a Model
    curves: tuple[Curve, ...]
    solution: Solution
    lower: Float[Array, " p"]
    upper: Float[Array, " p"]
    start_costs: Float[Array, " starts"]
    weights: tuple[Float[Array, " R"], ...]

    @property
    def q(self) -> Float[Array, " p"]:
        """The coordinates of the fit."""
        return self.solution.q

    def parameters(self) -> dict[str, float]:
        """The parameter set in physical units."""
        return {name: float(value) for name, value in self.model.parameters(self.q).items()}

    def held(self) -> Bool[Array, " p"]:
        """Coordinates within a millionth of the box's width of a bound: the data pull them out of it."""
        reach = 1e-6 * (self.upper - self.lower)
        return (self.q - self.lower <= reach) | (self.upper - self.q <= reach)


def fit(tests: Sequence[Test], model: Any) -> Fit:
    """Fit one parameter set to all tests; pass one test for a fit of its own.

    Every start of the model takes a few steps in one compiled call, and the best one is followed to the end.
    Raises `InputError` for tests the model cannot make.
    """
    if not tests:
        raise InputError("There is no test to fit.")
    for test in tests:
        if test.kind not in model.kinds:
            raise InputError(f"A {test.kind} test cannot be fitted by a model that makes {', '.join(model.kinds)}.")
    model = model.at(tests)
    curves = tuple(model.prepare(test) for test in tests)
    weights = tuple(jnp.full(test.repeats, 1 / test.repeats) for test in tests)
    lower, upper = (jnp.asarray(end) for end in model.box(tests))
    solution, costs = search(model, curves, weights, jnp.asarray(model.starts(tests)), lower, upper)
    return Fit(model, curves, solution, lower, upper, costs, weights)


def polish(found: Fit, start: Float[Array, " p"]) -> Fit:
    """The fit found from another start, if that is better."""
    again = _polished(found, start)
    better = again.cost < found.solution.cost
    return eqx.tree_at(lambda f: f.solution, found, again) if better else found


@eqx.filter_jit
def _polished(found, start):
    return least_squares(
        lambda q: residuals(found.model, found.curves, found.weights, q),
        start,
        found.lower,
        found.upper,
        max_steps=_LONGEST,
    )


def residuals(model, curves, weights, q) -> Float[Array, " m"]:
    """Residuals of all curves; their sum of squares is the sum over curves of NRMSE²."""
    return jnp.concatenate([curve_residuals(model, c, w, q) for c, w in zip(curves, weights, strict=True)])


def curve_residuals(model, curve: Curve, weights: Float[Array, " R"], q: Float[Array, " p"]) -> Float[Array, " m"]:
    """Mean of the weighted repeats less the model's, over the curve's scale and the root of its length."""
    misfit = weights @ curve.output - model.predict(q, curve, weights)
    return misfit / (curve.scale * np.sqrt(curve.time.size).astype(curve.scale.dtype))


def nrmse(found: Fit) -> dict[str, float]:
    """Root mean square of each test's residuals over its range."""
    parts = [curve_residuals(found.model, c, w, found.q) for c, w in zip(found.curves, found.weights, strict=True)]
    return {c.kind: float(jnp.linalg.norm(r)) for c, r in zip(found.curves, parts, strict=True)}


@eqx.filter_jit
def search(model, curves, weights, starts, lower, upper) -> tuple[Solution, Float[Array, " starts"]]:
    """All starts for a few steps, the best of them to the end; with the costs that the race ended in."""

    def run(start, steps):
        return least_squares(lambda q: residuals(model, curves, weights, q), start, lower, upper, max_steps=steps)

    race = jax.vmap(lambda start: run(start, _RACE))(starts)
    costs = jnp.where(jnp.isfinite(race.cost), race.cost, jnp.inf)
    return run(race.q[jnp.argmin(costs)], _LONGEST), race.cost


def _force_and_position(test):
    return (test.output, test.input) if test.kind == "relaxation" else (test.input, test.output)


def _position_driven(test):
    """The test with force as its output."""
    force, position = _force_and_position(test)
    return Test("relaxation", test.time, force, position, test.start)


def _unit_of_force(test):
    """What turns the scale of an output into one of force: the mean stiffness for positions."""
    return _mean_secant(test) if test.kind == "creep" else 1.0


@eqx.filter_jit
def _screen(model, curves, scales, grid):
    """Cost and stiffnesses (K_inst, K_eff) of the best combination at each place of the grid."""
    weights = [jnp.full(c.output.shape[0], 1 / c.output.shape[0], c.scale.dtype) for c in curves]
    ends = jnp.eye(2, dtype=grid.dtype)

    def place(at):
        normal, right, total = 0, 0, 0
        for curve, scale, w in zip(curves, scales, weights, strict=True):
            parts = [model.predict(jnp.concatenate([end, at]), curve, w) for end in ends]
            basis = jnp.stack(parts) / (scale * np.sqrt(curve.time.size))
            goal = w @ curve.output / (scale * np.sqrt(curve.time.size))
            normal, right, total = normal + basis @ basis.T, right + basis @ goal, total + goal @ goal
        (a, b), (_, c) = normal
        K_eff = jnp.maximum((a * right[1] - b * right[0]) / (a * c - b * b), 0)
        stiffness = jnp.stack([(right[0] - b * K_eff) / a, K_eff])
        return total - 2 * right @ stiffness + stiffness @ normal @ stiffness, stiffness

    costs, stiffness = jax.lax.map(place, grid.reshape(-1, 2))
    return costs.reshape(grid.shape[:-1]), stiffness.reshape(grid.shape)


def _separate(costs, count):
    """Places of the lowest costs, none beside another."""
    left, places = np.where(np.isfinite(costs), costs, np.inf), []
    while len(places) < count and np.isfinite(left).any():
        i, j = np.unravel_index(np.argmin(left), left.shape)
        places.append((i, j))
        left[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2] = np.inf
    return places


def _secant(test):
    """Largest force over largest position."""
    force, position = _force_and_position(test)
    return float(np.max(np.abs(force)) / np.max(np.abs(position)))


def _mean_secant(test):
    force, position = _force_and_position(test)
    return float(np.mean(np.abs(force)) / np.mean(np.abs(position)))


def _transform_length(count):
    """A length that transforms fast, at least three times as long as the data."""
    from scipy.fft import next_fast_len

    return 2 * next_fast_len((3 * count + 1) // 2)


def _circle(length, dtype):
    """Radius of the circle on which `length` points damp what wraps around to eps^0.8."""
    return float(np.finfo(dtype).eps ** (-0.8 / length))
