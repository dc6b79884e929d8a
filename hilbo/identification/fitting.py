"""Fit of a material model to creep and relaxation tests: tests, curves, models and the least-squares search.

The model is driven by the recorded input (position in relaxation, force in creep; `sampled`) and its output is compared
with the recorded one, so no ideal step is assumed. Modulus data G(t), J(t) have no input; they are fitted by exact
forms (`moduli`). A model has four coordinates or more, with bounds and starting points.

Residuals are divided by the range of their curve; the cost is the sum over tests of NRMSE². Units: N, mm, s; B1
N·s^α/mm. Moduli keep their own unit.
"""

from collections.abc import Sequence
from typing import Any, Literal, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hilbo.errors import InputError
from hilbo.identification.beginnings import correlation, off_zero
from hilbo.numerics.least_squares import Solution, least_squares
from hilbo.numerics.tracing import program

__all__ = ["Curve", "Fit", "Model", "Test", "curve_residuals", "fit", "nrmse", "polish", "residuals", "search"]

Kind = Literal["relaxation", "creep", "modulus", "compliance"]
MEASURED = ("relaxation", "creep")  # kinds with a recorded input
FEWEST = 8  # points of a test
_OPPOSED = -0.1  # correlation of position and force, about 0; noise does not bring a real test there
_RACE, _LONGEST = 12, 200  # steps of every start, and of the best one


class Test(eqx.Module):
    """One kind of test with its repeats, which share their times.

    `time` (m,) in s, increasing; `output` (R, m): force (N) of relaxation, position (mm) of creep, modulus or
    compliance; `input` (R, m): the position (mm) or force (N) that was applied, None for moduli. Before the first row
    the material is at rest with no input (`start="rest"`), or in equilibrium with the first one. Position and force of
    a push must have the same sign. Raises `InputError` for too few points, times that do not increase, numbers that are
    not finite, flat curves, and opposite signs.
    """

    __test__ = False  # keeps pytest from collecting it

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
            needs = "needs the recorded input in addition to the output" if self.input is None else "has no input"
            raise InputError(f"A {self.kind} test {needs}.")
        recorded = (self.time, self.output) if self.input is None else (self.time, self.output, self.input)
        if not all(np.all(np.isfinite(values)) for values in recorded):
            raise InputError(f"The {self.kind} test has numbers that are not finite; leave those rows out.")
        if not np.ptp(self.output.mean(axis=0)) > 0:
            raise InputError(f"The output of the {self.kind} test does not change; there is nothing to fit.")
        if self.input is not None and not np.any(self.input):
            raise InputError(f"The input of the {self.kind} test is 0 throughout; check the columns.")
        self._check_signs()

    def _check_signs(self):
        """Raise `InputError` for a repeat whose position and force have opposite signs.

        In equilibrium their changes from the first row count; with an offset in one channel both they and the values
        must be opposite.
        """
        for repeat, (applied, measured) in enumerate(
            zip(() if self.input is None else self.input, self.output, strict=False), 1
        ):
            opposed = correlation(self.time, applied, measured) < _OPPOSED
            changes = correlation(self.time, applied - applied[0], measured - measured[0])
            if self.start == "equilibrium":
                opposed = changes < _OPPOSED
            elif off_zero(applied, measured):  # an offset of one of them is no opposite sign
                opposed = opposed and not changes >= _OPPOSED
            if opposed:
                which = f" in repeat {repeat} of {self.repeats} (counted from 1)" if self.repeats > 1 else ""
                fault = f"The {self.kind} test has position and force of opposite signs{which}"
                raise InputError(f'{fault}; multiply one of them by -1, in a file by --column "force=-COLUMN".')

    @property
    def repeats(self) -> int:
        """Number of repeats R."""
        return self.output.shape[0]


@runtime_checkable
class Model(Protocol):
    """Interface of a model that can be fitted: prediction from p coordinates q, with bounds and starting points.

    Implemented by `sampled.Sampled`, `moduli.Continuous` and `moduli.FractionalMaxwell`. `labels`: names of the
    coordinates; `kinds`: kinds of test that it can predict.
    """

    kinds: tuple[str, ...]

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the p coordinates."""
        ...

    def physical(self) -> tuple[tuple[bool, ...], tuple[bool, ...]]:
        """Masks of the lower and of the upper bounds that are physical limits, such as stiffness 0. Two tuples (p,)."""
        ...

    def at(self, tests: Sequence[Test]) -> "Model":
        """Copy of the model adapted to the tests, to be used for all following calls."""
        ...

    def box(self, tests: Sequence[Test]) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of q, (p,) each."""
        ...

    def starts(self, tests: Sequence[Test]) -> np.ndarray:
        """Starting points of the search, (s, p)."""
        ...

    def prepare(self, test: Test) -> "Curve":
        """Convert a test to the `Curve` that this model predicts."""
        ...

    def predict(self, q: Array, curve: "Curve", weights: Array) -> Array:
        """Predicted output (m,) of the curve at coordinates q (p,), for `weights` (R,) of the repeats."""
        ...

    def natural(self, q: Array) -> Array:
        """Coordinates q (p,) converted to the physical units of their labels. (p,)."""
        ...

    def parameters(self, q: Array) -> dict[str, Array]:
        """Physical parameters by name, at q (p,)."""
        ...


class Curve(eqx.Module):
    """A test prepared for one model: the weighted mean of its repeats is fitted.

    The model is linear in its input, so the mean of the repeats is exactly the response to the mean of their inputs.
    `spectra` (R, L/2+1): damped transforms of the inputs on the model's time grid; `before`, `share`: index of the grid
    sample before each measured time, and the fraction of a sample beyond it; `scale`: divisor of the residuals;
    `changes`: transforms of the significant sample-to-sample changes of the inputs (`instrument`); `regular`: the rows
    coincide with the samples of the model; `rounded_*`: quantisation of a channel (`rounding`) where it exceeds the
    noise; `other_way`: the test with input and output exchanged, if it is fitted in that form.
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
    changes: Array | None = None
    regular: bool = eqx.field(static=True, default=False)
    rounded_input: Any = None  # a rounding.Rounding
    rounded_output: Any = None
    other_way: "Curve | None" = None

    @property
    def fitted(self) -> "Curve":
        """The curve whose residuals are minimised: `other_way` if there is one, else this curve."""
        return self if self.other_way is None else self.other_way


class Fit(eqx.Module):
    """Best fit of a model to tests.

    `solution`: result of the search (`least_squares.Solution`); `weights` (R,) of the repeats of each curve.
    """

    model: Any  # a Model
    curves: tuple[Curve, ...]
    solution: Solution
    lower: Float[Array, " p"]
    upper: Float[Array, " p"]
    weights: tuple[Float[Array, " R"], ...]

    @property
    def q(self) -> Float[Array, " p"]:
        """Fitted coordinates. (p,)."""
        return self.solution.q

    def parameters(self) -> dict[str, float]:
        """Fitted parameters by name, in physical units."""
        return {name: float(value) for name, value in self.model.parameters(self.q).items()}

    def minimum(
        self,
        start: Float[Array, " p"],
        box: tuple[Array, Array] | None = None,
        weights: Sequence[Float[Array, " _"]] | None = None,
        **search: Any,
    ) -> Solution:
        """Least squares from a `start` (p,), in the fit's box and under its weights, unless others are given.

        `box`: lower and upper bounds (p,); `weights` (R,) of the repeats of each curve; `search`: options of
        `least_squares`. The fit itself is not changed.
        """
        others = self.weights if weights is None else weights
        ends = (self.lower, self.upper) if box is None else box
        return least_squares(lambda q: residuals(self.model, self.curves, others, q), start, *ends, **search)

    def held(self) -> Bool[Array, " p"]:
        """Whether each fitted coordinate is at a bound (within a millionth of the range between the bounds). (p,)."""
        at_lower, at_upper = self.bounded(self.q)
        return at_lower | at_upper

    def bounded(self, q: Float[Array, " p"]) -> tuple[Bool[Array, " p"], Bool[Array, " p"]]:
        """Whether each coordinate of q (p,) is at its lower bound, and whether at its upper bound. Two arrays (p,)."""
        tolerance = 1e-6 * (self.upper - self.lower)
        return q - self.lower <= tolerance, self.upper - q <= tolerance


def fit(tests: Sequence[Test], model: Any) -> Fit:
    """Fit one parameter set jointly to all tests, with equal weights of the repeats.

    All starting points of the model take a few steps in one compiled call; the best one is iterated to convergence, or
    200 steps. Raises `InputError` for no tests, and for tests that the model cannot predict.
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
    solution = search(model, curves, weights, jnp.asarray(model.starts(tests)), lower, upper)
    return Fit(model, curves, solution, lower, upper, weights)


def polish(fitted: Fit, start: Float[Array, " p"]) -> Fit:
    """Refit from another starting point `start` (p,); return the fit with the lower cost, which may be `fitted`."""
    again = _polished(fitted, start)
    better = again.cost < fitted.solution.cost
    return eqx.tree_at(lambda f: f.solution, fitted, again) if better else fitted


@program
def _polished(current: Fit, start: Float[Array, " p"]) -> Solution:
    """Minimum found from the starting point `start` (p,), for the data of the `current` fit; compiled."""
    return current.minimum(start, max_steps=_LONGEST)


def residuals(
    model: Any, curves: Sequence["Curve"], weights: Sequence[Float[Array, " _"]], q: Float[Array, " p"]
) -> Float[Array, " m"]:
    """Concatenated residuals (m,) of all curves at q (p,); their sum of squares is the sum over curves of NRMSE²."""
    return jnp.concatenate([curve_residuals(model, c, w, q) for c, w in zip(curves, weights, strict=True)])


def curve_residuals(model: Any, curve: Curve, weights: Float[Array, " R"], q: Float[Array, " p"]) -> Float[Array, " m"]:
    """Residuals of one curve: (weighted mean of the repeats - prediction) / (scale·√m).

    `weights` (R,), `q` (p,) -> (m,), dimensionless. A curve with `other_way` is replaced by that one.
    """
    return _misfit(model, curve.fitted, weights, q)


def _misfit(model: Any, curve: Curve, weights: Float[Array, " R"], q: Float[Array, " p"]) -> Float[Array, " m"]:
    """Residuals as `curve_residuals`, but for the curve as given, without exchanging input and output."""
    misfit = weights @ curve.output - model.predict(q, curve, weights)
    return misfit / (curve.scale * np.sqrt(curve.time.size).astype(curve.scale.dtype))


def nrmse(fitted: Fit) -> dict[str, float]:
    """NRMSE of each test in its own output, by kind of test: root mean square residual / `scale` of the curve.

    The scale is the range of the curve, or each value for moduli with relative weights.
    """
    parts = [_misfit(fitted.model, c, w, fitted.q) for c, w in zip(fitted.curves, fitted.weights, strict=True)]
    return {c.kind: float(jnp.linalg.norm(r)) for c, r in zip(fitted.curves, parts, strict=True)}


@program
def search(
    model: Any,
    curves: Sequence["Curve"],
    weights: Sequence[Float[Array, " _"]],
    starts: Float[Array, "s p"],
    lower: Float[Array, " p"],
    upper: Float[Array, " p"],
) -> Solution:
    """Run all starting points (s, p) for a few steps and iterate the best one to convergence; compiled.

    Within the box `lower` to `upper` (p,); `weights` (R,) of the repeats of each curve.
    """

    def run(start, steps):
        return least_squares(lambda q: residuals(model, curves, weights, q), start, lower, upper, max_steps=steps)

    race = jax.vmap(lambda start: run(start, _RACE))(starts)
    costs = jnp.where(jnp.isfinite(race.cost), race.cost, jnp.inf)
    return run(race.q[jnp.argmin(costs)], _LONGEST)
