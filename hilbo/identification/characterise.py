"""All that is to be known about a material from its tests: fit, intervals, residuals, memory, passivity.

The best curve is always there (`Characterisation.fit`). Whether its parameters mean something is said apart: a
parameter is *identified* if its 95 % profile interval has two ends, *one-sided* if it has one, *at bound* if the fit
ran to the edge of the search, and *not identifiable* if the data set no end at all. K0, K1 and B1 follow from all four
coordinates; their intervals are quantiles under the normal approximation in those.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hilbo import passivity
from hilbo.identification import intervals
from hilbo.identification.fitting import Fit, Test, fit, nrmse, polish
from hilbo.identification.memory_selection import Row, select_memory
from hilbo.identification.sampled import Sampled

__all__ = ["Characterisation", "Estimate", "characterise"]

_DRAWS = 4000
_RESTARTS = 3  # from a better place that the search for intervals came through
_UNRELATED = 3.0  # times the repeats' own noise, above which the model misses something


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
    say=lambda text: None,
) -> Characterisation:
    """Fit tests by one parameter set and judge it; `choices` are the memories to compare (none: no comparison)."""
    say("fitting")
    found = fit(tests, model)
    say("profile intervals")
    sides = intervals.profile_intervals(found)
    for _ in range(_RESTARTS):
        if not bool(sides.lowest < found.solution.cost * (1 - 1e-6)):
            break
        found = polish(found, sides.lowest_q)
        sides = intervals.profile_intervals(found)
    around = intervals.spread(found)
    boot = None
    if min(test.repeats for test in tests) >= intervals.FEWEST_REPEATS:
        say("bootstrap over repeats")
        boot = intervals.block_bootstrap(found, jax.random.key(seed))
    estimates = _estimates(found, sides, around, seed)
    damping = _minimum_damping(found)
    residuals = {kind.kind: row for kind, row in zip(tests, _noise(found, tests), strict=True)}
    if choices:
        say("memory")
    rows = select_memory(tests, model.T, choices) if choices else ()
    words = _warnings(found, sides, estimates, residuals, tests)
    ends = None if boot is None else [np.asarray(found.model.natural(end)) for end in boot]
    named = (
        None
        if ends is None
        else dict(zip(found.model.labels, zip(*map(np.ndarray.tolist, ends), strict=True), strict=True))
    )
    return Characterisation(
        found, estimates, named, residuals, nrmse(found), float(around.freedom), damping, rows, words
    )


def _estimates(found, sides, around, seed):
    model, labels, held = found.model, found.model.labels, np.asarray(found.held())
    open_lower, open_upper = np.asarray(sides.open_lower), np.asarray(sides.open_upper)
    ok = np.asarray(sides.found) & np.isfinite(np.asarray(sides.lower)) & np.isfinite(np.asarray(sides.upper))
    value, lower, upper = (np.asarray(model.natural(q)) for q in (found.q, sides.lower, sides.upper))
    estimates = {}
    for j, name in enumerate(labels):
        status = _status(ok[j] and bool(found.solution.converged), open_lower[j], open_upper[j], held[j])
        low = float(lower[j]) if ok[j] and not open_lower[j] else None
        high = float(upper[j]) if ok[j] and not open_upper[j] else None
        estimates[name] = Estimate(float(value[j]), low, high, status)
    whole = all(estimate.known for estimate in estimates.values())
    derived = _quantiles(found, around, seed) if whole else {}
    rest = {
        name: _derived(number, derived.get(name)) for name, number in found.parameters().items() if name not in labels
    }
    return rest | estimates


def _derived(value, ends):
    if ends is None:
        return Estimate(value, None, None, "not identifiable")
    return Estimate(value, ends[0], ends[1], "identified")


def _status(ok, open_lower, open_upper, held):
    if held:
        return "at bound"
    if not ok:
        return "not identifiable"
    if open_lower and open_upper:
        return "not identifiable"
    return "one-sided" if open_lower or open_upper else "identified"


def _quantiles(found, around, seed):
    """95 % of what follows from all coordinates, over draws of these."""
    rng = np.random.default_rng(seed)
    draws = rng.multivariate_normal(np.asarray(found.q), np.asarray(around.covariance), _DRAWS, method="eigh")
    sets = jax.vmap(found.model.parameters)(jnp.asarray(draws))
    return {name: tuple(np.quantile(np.asarray(v), [0.025, 0.975]).tolist()) for name, v in sets.items()}


def _noise(found, tests):
    """What the residuals of each test look like, and how they compare with the noise of the repeats."""
    for test, part in zip(tests, intervals.noise(found), strict=True):
        row = {
            "autocorrelation": float(part.lag_one),
            "order": int(part.order),
            "effective_samples": float(part.effective),
            "samples": test.time.size,
            "repeats": test.repeats,
        }
        if test.repeats > 1:
            scatter = np.sqrt(np.mean(np.var(test.output, axis=0, ddof=1)) / test.repeats)
            size = float(part.rms) * np.ptp(test.output.mean(axis=0))
            row["over_repeat_noise"] = float(size / scatter) if scatter > 0 else np.inf
        yield row


def _minimum_damping(found):
    """Smallest passive damping of the set, N·s/m; None for an even number of taps (closed form too low) and moduli."""
    model, values = found.model, found.parameters()
    if not isinstance(model, Sampled):
        return None
    if model.memory == "short" and int(model.N) % 2 == 0:
        return None
    place = values["K1"], values["B1"], values["alpha"], values["K_eff"]
    return float(passivity.minimum_damping(*place, int(model.N), model.T, memory=model.memory))


def _warnings(found, sides, estimates, residuals, tests):
    """Sentences for a person who would otherwise trust the digits."""
    words = []
    if not bool(found.solution.converged):
        words.append("The fit did not come to an end: the cost is flat in some direction, so no digits are printed.")
    elif float(sides.lowest) < float(found.solution.cost) * (1 - 1e-4):
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
    T = getattr(found.model, "T", np.inf)
    coarse = [t.kind for t in tests if np.median(np.diff(t.time)) > 1.001 * T]
    if coarse:
        words.append(
            f"The samples of the {' and '.join(coarse)} test are further apart than T = {1000 * T:g} ms;"
            " the input was interpolated linearly in between."
        )
    return tuple(words)
