"""All that is to be known about a material from its tests: fit, intervals, residuals, memory, passivity.

The best curve is always there (`Characterisation.fit`). Whether its parameters mean something is said apart: a
parameter is *identified* if its 95 % profile interval has two ends, *one-sided* if it has one, *at bound* if the fit
ran to the edge of the search, and *not identifiable* if the data set no end at all. K0, K1 and B1 follow from all four
coordinates; their intervals are quantiles under the normal approximation in those.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hilbo import passivity
from hilbo.identification import intervals
from hilbo.identification.fitting import Fit, Test, fit, nrmse, polish, untared
from hilbo.identification.memory_selection import Row, select_memory
from hilbo.identification.residual_noise import noise
from hilbo.identification.sampled import Sampled

__all__ = ["Characterisation", "Estimate", "characterise"]

_DRAWS = 4000
_RESTARTS = 3  # from a better place that the search for intervals came through
_UNRELATED = 3.0  # times the repeats' own noise, above which the model misses something
_ROUNDING = 1e-12  # of the largest value; repeats that differ less are copies
_WIDE, _TICKS = 5.0, 10.0  # medians of the time between rows, and T, above which it is a hole
_SURE = 4.0  # standard errors
_SHARE = 0.2  # of the input's range; what a hole may hide of it


class Estimate(NamedTuple):
    """A parameter: the value of the best curve, its 95 % interval (an open end is None), and what it is worth."""

    value: float
    lower: float | None
    upper: float | None
    status: str

    @property
    def known(self) -> bool:
        """Whether the digits of `value` mean something."""
        return self.status == "identified"


class Characterisation(NamedTuple):
    """A fit and everything beside it; `estimates` by name, `noise` by kind of test."""

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
) -> Characterisation:
    """Fit tests by one parameter set and judge it; `choices` are the memories to compare (none: no comparison)."""
    say("fitting")
    best_fit = fit(tests, model)
    say("profile intervals")
    sides = intervals.profile_intervals(best_fit)
    for _ in range(_RESTARTS):
        if not bool(sides.lowest < best_fit.solution.cost * (1 - 1e-6)):
            break
        best_fit = polish(best_fit, sides.lowest_q)
        sides = intervals.profile_intervals(best_fit)
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
    rows = select_memory(tests, model.T, choices) if choices else ()
    words = _warnings(best_fit, sides, estimates, residuals, tests)
    ends = None if boot is None else [np.asarray(best_fit.model.natural(end)) for end in boot]
    named = (
        None
        if ends is None
        else dict(zip(best_fit.model.labels, zip(*map(np.ndarray.tolist, ends), strict=True), strict=True))
    )
    return Characterisation(
        best_fit, estimates, named, residuals, nrmse(best_fit), float(sampling.freedom), damping, rows, words
    )


def _estimates(best_fit: Fit, sides: intervals.Intervals, sampling: intervals.Spread, seed: int) -> dict[str, Estimate]:
    """Every parameter and coordinate by name: coordinates from their profiles, the others by `_quantiles`."""
    model, labels, held = best_fit.model, best_fit.model.labels, np.asarray(best_fit.held())
    open_lower, open_upper = np.asarray(sides.open_lower), np.asarray(sides.open_upper)
    ok = np.asarray(sides.bracketed) & np.isfinite(np.asarray(sides.lower)) & np.isfinite(np.asarray(sides.upper))
    value, lower, upper = (np.asarray(model.natural(q)) for q in (best_fit.q, sides.lower, sides.upper))
    estimates = {}
    for j, name in enumerate(labels):
        status = _status(ok[j] and bool(best_fit.solution.converged), open_lower[j], open_upper[j], held[j])
        low = float(lower[j]) if ok[j] and not open_lower[j] else None
        high = float(upper[j]) if ok[j] and not open_upper[j] else None
        estimates[name] = Estimate(float(value[j]), low, high, status)
    whole = all(estimate.known for estimate in estimates.values())
    derived = _quantiles(best_fit, sampling, seed) if whole else {}
    others = {name: number for name, number in best_fit.parameters().items() if name not in labels}
    rest = {name: _derived(number, derived.get(name)) for name, number in others.items()}
    return rest | estimates


def _derived(value: float, ends: tuple[float, ...] | None) -> Estimate:
    """What follows from all coordinates: known where all of them are."""
    if ends is None:
        return Estimate(value, None, None, "not identifiable")
    return Estimate(value, ends[0], ends[1], "identified")


def _status(ok, open_lower, open_upper, held) -> str:
    """What an estimate is worth, in the words of this module's head; `ok`: both searches for an end came to one."""
    if held:
        return "at bound"
    if not ok:
        return "not identifiable"
    if open_lower and open_upper:
        return "not identifiable"
    return "one-sided" if open_lower or open_upper else "identified"


def _quantiles(best_fit: Fit, sampling: intervals.Spread, seed: int) -> dict[str, tuple[float, ...]]:
    """95 % of what follows from all coordinates, over draws of these."""
    rng = np.random.default_rng(seed)
    draws = rng.multivariate_normal(np.asarray(best_fit.q), np.asarray(sampling.covariance), _DRAWS, method="eigh")
    sets = jax.vmap(best_fit.model.parameters)(jnp.asarray(draws))
    return {name: tuple(np.quantile(np.asarray(v), [0.025, 0.975]).tolist()) for name, v in sets.items()}


def _noise(best_fit: Fit, tests: Sequence[Test]) -> Iterator[dict[str, Any]]:
    """What the residuals of each test look like, and how they compare with the noise of the repeats."""
    for test, autoregression in zip(tests, noise(best_fit), strict=True):
        row = {
            "autocorrelation": float(autoregression.lag_one),
            "order": int(autoregression.order),
            "effective_samples": float(autoregression.effective),
            "samples": test.time.size,
            "repeats": test.repeats,
        }
        if test.repeats > 1:
            scatter = np.sqrt(np.mean(np.var(test.output, axis=0, ddof=1)) / test.repeats)
            size = float(autoregression.rms) * np.ptp(test.output.mean(axis=0))
            if scatter > _ROUNDING * np.max(np.abs(test.output)):  # copies tell nothing about noise
                row["over_repeat_noise"] = float(size / scatter)
        yield row


def _minimum_damping(best_fit: Fit) -> float | None:
    """Smallest passive damping of the set, N·s/m; None for an even number of taps (closed form too low) and moduli."""
    model, values = best_fit.model, best_fit.parameters()
    if not isinstance(model, Sampled):
        return None
    if model.memory == "short" and int(model.N) % 2 == 0:
        return None
    parameters = values["K1"], values["B1"], values["alpha"], values["K_eff"]
    return float(passivity.minimum_damping(*parameters, int(model.N), model.T, memory=model.memory))


def _warnings(
    best_fit: Fit,
    sides: intervals.Intervals,
    estimates: dict[str, Estimate],
    residuals: dict[str, dict[str, Any]],
    tests: Sequence[Test],
) -> tuple[str, ...]:
    """Sentences for a person who would otherwise trust the digits."""
    words = []
    if not bool(best_fit.solution.converged):
        words.append("The fit did not come to an end: the cost is flat in some direction, so no digits are printed.")
    elif float(sides.lowest) < float(best_fit.solution.cost) * (1 - 1e-4):
        words.append("A search for an interval found a better fit than the fit itself; the data have several optima.")
    for name, estimate in estimates.items():
        if estimate.status == "at bound":
            words.append(f"The fit ran to the bound of {name}, {estimate.value:.3g}; the data do not determine it.")
    unknown = [name for name, estimate in estimates.items() if estimate.status == "not identifiable"]
    if unknown:
        words.append(f"Not identifiable from these data: {', '.join(unknown)}.")
    for kind, row in residuals.items():
        if row.get("over_repeat_noise", 0.0) > _UNRELATED:
            words.append(
                f"The residuals of the {kind} test are {row['over_repeat_noise']:.0f} times the noise of its repeats:"
                " the model misses part of the curve, and the intervals take that as correlated noise."
            )
    T = getattr(best_fit.model, "T", np.inf)
    coarse = [t.kind for t in tests if np.median(np.diff(t.time)) > 1.001 * T]
    if coarse:
        words.append(
            f"The samples of the {' and '.join(coarse)} test are further apart than T = {1000 * T:g} ms;"
            " the input was interpolated linearly in between."
        )
    return (*words, *(sentence for test in tests for sentence in _recording(test, T)))


def _recording(test: Test, T: float) -> Iterator[str]:
    """What is amiss with the recorded input: a step that fell into a hole between rows, a beginning off 0."""
    if test.input is None:
        return
    put, out, time = test.input.mean(axis=0), test.output.mean(axis=0), test.time - test.time[0]
    apart, change = np.diff(time), np.abs(np.diff(put))
    hole = (apart > _WIDE * np.median(apart)) & (apart > _TICKS * T) & (change > _SHARE * np.ptp(put))
    if hole.any():
        i = int(np.argmax(np.where(hole, change, 0)))
        yield (
            f"The {test.kind} test has no rows from {time[i]:g} s to {time[i + 1]:g} s, where its input changes by"
            f" {change[i] / np.ptp(put):.0%} of its range: a straight line was taken there, and values and intervals"
            " are wrong if the input went another way; record that part with rows as close as elsewhere."
        )
    offset = untared(put, out) if test.start == "rest" else None
    if offset is not None and _above_scatter(test.input if offset == "input" else test.output):
        names = ("position", "force") if (offset == "input") == (test.kind == "relaxation") else ("force", "position")
        first = (put if offset == "input" else out)[0]
        unit = "mm" if names[0] == "position" else "N"
        yield (
            f"The {test.kind} test does not begin at rest: its first row has a {names[0]} of {first:.3g} {unit} and no"
            f" {names[1]}; unless that is noise, values and intervals are wrong: tare it (subtract that from every"
            f" {names[0]})."
        )


def _above_scatter(values: np.ndarray) -> bool:
    """Whether the repeats agree that their first row is not 0. (R, m)."""
    first, repeats = values[:, 0], values.shape[0]
    return repeats == 1 or bool(abs(first.mean()) > _SURE * np.std(first, ddof=1) / np.sqrt(repeats))
