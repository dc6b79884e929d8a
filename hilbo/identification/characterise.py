"""Full characterisation of a material from its tests: fit, intervals, residuals, memory and passivity.

The best curve is always reported (`Characterisation.fit`). Each parameter has a status: *identified* if its 95 %
profile interval has two ends, *one-sided* if it has one, *at bound* if the fit ended at a bound of the search, and *not
identifiable* if the data determine no end. K0, K1 and B1 are functions of all four coordinates; their intervals are
quantiles under the normal approximation of the coordinates.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hilbo import passivity
from hilbo.errors import InputError
from hilbo.identification import intervals
from hilbo.identification.estimates import Estimate
from hilbo.identification.fitting import Fit, Test, fit, nrmse, polish
from hilbo.identification.instrument import can_be_timed
from hilbo.identification.memory_selection import Row, select_memory
from hilbo.identification.misfit import filter_score
from hilbo.identification.residual_noise import noise
from hilbo.identification.sampled import Sampled
from hilbo.identification.sentences import sentences, stiffening

__all__ = ["Characterisation", "Estimate", "characterise"]

_DRAWS = 4000
_RESTARTS = 3  # from a better point met during the interval search
_ROUNDING = 1e-12  # of the largest value; repeats that differ less are copies
_FILTERED = 4.0  # standard deviations, above which a filter of the force is fitted


class Characterisation(NamedTuple):
    """Results of `characterise`; `estimates` and `bootstrap` by parameter name, `noise` and `nrmse` by kind of test.

    `bootstrap` has interval ends, None for fewer than 5 repeats; `freedom`: degrees of freedom; `minimum_damping` in
    N·s/m; `rows`: the fits with other memories.
    """

    fit: Fit
    estimates: dict[str, Estimate]
    bootstrap: dict[str, tuple[float, float]] | None
    noise: dict[str, dict[str, float]]
    nrmse: dict[str, float]
    freedom: float
    minimum_damping: float | None
    rows: tuple[Row, ...]
    warnings: tuple[str, ...]


def characterise(
    tests: Sequence[Test],
    model: Any,
    seed: int = 0,
    choices: Sequence[int | None] = (),
    say: Callable[[str], None] = lambda text: None,
    *,
    find_filter: bool = True,
) -> Characterisation:
    """Fit one parameter set to the tests; compute intervals, residual noise, minimum damping and warnings.

    `model`: a `fitting.Model`; `seed` of the bootstrap and of quantiles. `choices`: memory lengths (None: full memory)
    to compare, in further fits; empty: no comparison. `say` receives the name of each step for progress output.
    `find_filter`: a `Sampled` with `lag="fit"` and no filter is fitted with one if the residuals indicate it
    (`misfit`). The fit in the result is that of the model finally used. Raises `InputError` as `fitting.fit`, for tests
    whose best fit has a K1 below 0, and for `choices` with a model that is not sampled, which has no memory.
    """
    if choices and not isinstance(model, Sampled):
        raise InputError("choices are memory lengths, which only a sampled model has; leave them out for moduli.")
    say("fitting")
    best_fit, sides = _fitted(tests, model, say, find_filter)
    K1 = best_fit.parameters().get("K1", 0.0) if isinstance(best_fit.model, Sampled) else 0.0
    if K1 < 0:
        raise InputError(stiffening(K1, tests))
    sampling = intervals.spread(best_fit)
    boot = None
    if min(test.repeats for test in tests) >= intervals.FEWEST_REPEATS:
        say("bootstrap over repeats")
        boot = intervals.block_bootstrap(best_fit, jax.random.key(seed))
    estimates = _estimates(best_fit, sides, sampling, seed)
    damping = _minimum_damping(best_fit)
    residuals = {test.kind: row for test, row in zip(tests, _noise(best_fit, tests), strict=True)}
    if choices:
        say("memory")
    rows = select_memory(tests, model.T, choices, *_instrument(best_fit)) if choices else ()
    words = sentences(best_fit, sides, sampling, estimates, residuals, tests)
    if boot is not None:
        ends = [np.asarray(best_fit.model.natural(end)).tolist() for end in boot]
        boot = dict(zip(best_fit.model.labels, zip(*ends, strict=True), strict=True))
    return Characterisation(
        best_fit, estimates, boot, residuals, nrmse(best_fit), float(sampling.freedom), damping, rows, words
    )


def _fitted(
    tests: Sequence[Test], model: Any, say: Callable[[str], None], find_filter: bool
) -> tuple[Fit, intervals.Intervals]:
    """Best fit and its profile intervals; lag and filter are fitted if the model asks for it and the data allow it.

    If no input has a significant change, a lag of 0 is taken in place of a fitted one. The fit is restarted up to three
    times from a better point that the interval search came across. `say` receives the name of each step.
    """
    fits_lag = isinstance(model, Sampled) and model.lag == "fit"
    if fits_lag and not can_be_timed(tests):
        model = Sampled(model.N, model.T, model.memory, lag=0.0, corner=model.corner)
        fits_lag = False
    best_fit = fit(tests, model)
    # With a fixed lag, the score would attribute a residual lag to a filter.
    if fits_lag and find_filter and model.corner == np.inf and filter_score(best_fit) > _FILTERED:
        say("a filter of the force")
        best_fit = fit(tests, Sampled(model.N, model.T, model.memory, lag="fit", corner="fit"))
    say("profile intervals")
    sides = intervals.profile_intervals(best_fit)
    for _ in range(_RESTARTS):
        if not bool(sides.lowest < best_fit.solution.cost * (1 - 1e-6)):
            break
        best_fit = polish(best_fit, sides.lowest_q)
        sides = intervals.profile_intervals(best_fit)
    return best_fit, sides


def _instrument(best_fit: Fit) -> tuple[float, float]:
    """Lag (s) and filter corner (Hz) of a fit of `Sampled`, fitted or given, to be kept fixed in other fits."""
    model = best_fit.model
    named = dict(zip(model.labels, np.asarray(model.natural(best_fit.q)).tolist(), strict=True))
    lag = 1e-3 * named["lag"] if "lag" in named else float(model.lag)
    return lag, named["corner"] if "corner" in named else float(model.corner)


def _estimates(best_fit: Fit, sides: intervals.Intervals, sampling: intervals.Spread, seed: int) -> dict[str, Estimate]:
    """Estimates by name: of the parameters that are no coordinates, then of the coordinates.

    Coordinates have profile intervals. The others have quantiles if all coordinates are identified; otherwise their
    status is "not identifiable", without an interval.
    """
    model, labels, at_bound = best_fit.model, best_fit.model.labels, np.asarray(best_fit.held())
    open_lower, open_upper = np.asarray(sides.open_lower), np.asarray(sides.open_upper)
    ok = np.asarray(sides.bracketed) & np.isfinite(np.asarray(sides.lower)) & np.isfinite(np.asarray(sides.upper))
    value, lower, upper = (np.asarray(model.natural(q)) for q in (best_fit.q, sides.lower, sides.upper))
    estimates = {}
    for j, name in enumerate(labels):
        status = _status(ok[j] and bool(best_fit.solution.converged), open_lower[j], open_upper[j], at_bound[j])
        low = float(lower[j]) if ok[j] and not open_lower[j] else None
        high = float(upper[j]) if ok[j] and not open_upper[j] else None
        estimates[name] = Estimate(float(value[j]), low, high, status)
    all_identified = all(estimate.known for estimate in estimates.values())
    derived = _quantiles(best_fit, sampling, seed) if all_identified else {}
    others = {name: number for name, number in best_fit.parameters().items() if name not in labels}
    status = "identified" if all_identified else "not identifiable"
    ends = {name: derived.get(name, (None, None)) for name in others}
    return {name: Estimate(value, ends[name][0], ends[name][1], status) for name, value in others.items()} | estimates


def _status(ok, open_lower, open_upper, at_bound) -> str:
    """Status of an estimate: "at bound", "not identifiable", "one-sided" or "identified".

    `ok`: both interval searches and the fit converged; `open_lower`, `open_upper`: the interval has no end there;
    `at_bound`: the fit ended at a bound, which decides first.
    """
    if at_bound:
        return "at bound"
    if not ok or (open_lower and open_upper):
        return "not identifiable"
    return "one-sided" if open_lower or open_upper else "identified"


def _quantiles(best_fit: Fit, sampling: intervals.Spread, seed: int) -> dict[str, list[float]]:
    """95 % intervals (lower, upper) of the parameters by name, from normal draws of the coordinates."""
    rng = np.random.default_rng(seed)
    draws = rng.multivariate_normal(np.asarray(best_fit.q), np.asarray(sampling.covariance), _DRAWS, method="eigh")
    sets = jax.vmap(best_fit.model.parameters)(jnp.asarray(draws))
    return {name: np.quantile(np.asarray(v), [0.025, 0.975]).tolist() for name, v in sets.items()}


def _noise(best_fit: Fit, tests: Sequence[Test]) -> Iterator[dict[str, Any]]:
    """Yield a dict for each test that describes the noise of its residuals: "autocorrelation" at lag one, "order" of
    the autoregression, "effective_samples", "samples", "repeats" and "drift".

    "over_repeat_noise" is their RMS over the standard error of the mean of the repeats, in the test's own output;
    missing for a single repeat and for identical ones.
    """
    for test, curve, autoregression in zip(tests, best_fit.curves, noise(best_fit), strict=True):
        values = np.asarray(test.output if curve.other_way is None else test.input)
        row = {
            "autocorrelation": float(autoregression.lag_one),
            "order": int(autoregression.order),
            "effective_samples": float(autoregression.effective),
            "samples": test.time.size,
            "repeats": test.repeats,
            "drift": float(autoregression.drift),
        }
        if test.repeats > 1:
            scatter = np.sqrt(np.mean(np.var(values, axis=0, ddof=1)) / test.repeats)
            size = float(autoregression.rms) * np.ptp(values.mean(axis=0))
            if scatter > _ROUNDING * np.max(np.abs(values)):  # identical repeats have no noise to compare with
                row["over_repeat_noise"] = float(size / scatter)
        yield row


def _minimum_damping(best_fit: Fit) -> float | None:
    """Smallest device damping (N·s/m) with which the fitted set is passive, without delay.

    None for a model of moduli, and for an even number of taps, where the closed form is too low.
    """
    model, values = best_fit.model, best_fit.parameters()
    if not isinstance(model, Sampled) or (model.memory == "short" and int(model.N) % 2 == 0):
        return None
    parameters = values["K1"], values["B1"], values["alpha"], values["K_eff"]
    return float(passivity.minimum_damping(*parameters, int(model.N), model.T, memory=model.memory))
