"""Warnings about a fit: convergence, residuals, force channel and sampling of the records."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from hilbo.identification.beginnings import untared
from hilbo.identification.estimates import Estimate
from hilbo.identification.fitting import Fit, Test
from hilbo.identification.instrument import is_fitted_in_force
from hilbo.identification.intervals import FEWEST_REPEATS, Intervals, Spread
from hilbo.identification.misfit import coarse_kinds, moved_between_rows
from hilbo.identification.recorded import hold_at_end, lost_contact
from hilbo.identification.residual_noise import DRIFTS

__all__ = ["recording", "sentences", "stiffening"]

_UNRELATED = 3.0  # times the noise of the repeats, above which the model has a systematic error
_WIDE, _TICKS = 5.0, 10.0  # multiples of the median time step, and of T, above which a step is a gap
_SURE = 4.0  # standard errors
_SHARE = 0.2  # of the input's range; smallest change in a gap to warn about
_CERTAIN = 1.75  # half-widths of the 95 % interval: a lag of 0 has a probability of 1 in 2,000
_SHARE_OF_ERROR = 0.5


def sentences(
    best_fit: Fit,
    sides: Intervals,
    sampling: Spread,
    estimates: dict[str, Estimate],
    residuals: dict[str, dict[str, Any]],
    tests: Sequence[Test],
) -> tuple[str, ...]:
    """Warnings about a characterisation, one sentence each; empty for none.

    `residuals`: description of each test's residuals, by kind of test (as in `Characterisation.noise`).
    """
    words = [*_search(best_fit, sides, estimates), *_residuals(residuals), *_instrument(estimates)]
    words += _coarse(best_fit, sampling, tests)
    T = getattr(best_fit.model, "T", np.inf)
    return (*words, *(sentence for test in tests for sentence in recording(test, T)))


def _search(best_fit: Fit, sides: Intervals, estimates: dict[str, Estimate]) -> Iterator[str]:
    """Yield warnings about convergence, a better fit met, bounds, and parameters that are not identifiable."""
    if not bool(best_fit.solution.converged):
        yield "The fit did not converge: the cost is flat in some direction, so no values are printed."
    elif float(sides.lowest) < float(best_fit.solution.cost) * (1 - 1e-4):
        yield "A search for an interval found a better fit than the fit itself; the data have several optima."
    for name, estimate in estimates.items():
        if estimate.status == "at bound":
            yield f"The fit ran to the bound of {name}, {estimate.value:.3g}; the data do not determine it."
    unknown = [name for name, estimate in estimates.items() if estimate.status == "not identifiable"]
    if unknown:
        yield f"Not identifiable from these data: {', '.join(unknown)}."


def _residuals(residuals: dict[str, dict[str, Any]]) -> Iterator[str]:
    """Yield warnings about residuals that exceed the noise of the repeats, or drift; arguments as in `sentences`."""
    for kind, row in residuals.items():
        if row.get("over_repeat_noise", 0.0) > _UNRELATED:
            yield (
                f"The residuals of the {kind} test are {row['over_repeat_noise']:.0f} times the noise of its repeats:"
                " the model misses part of the curve, and the intervals take that as correlated noise."
            )
        if row.get("drift", 1.0) < DRIFTS:
            shared = " The bootstrap does not contain a drift that all repeats share."
            bootstrap = shared if row["repeats"] >= FEWEST_REPEATS else ""
            yield (
                f"The residuals of the {kind} test drift slowly: the sensor may have been warming up, or the model"
                " misses part of the curve. The intervals take the drift as a random walk and are uncertain themselves;"
                f" let the sensor settle and record again.{bootstrap}"
            )


def _instrument(estimates: dict[str, Estimate]) -> Iterator[str]:
    """Yield warnings about a significant lag or an identified filter in the force channel."""
    lag, corner = estimates.get("lag"), estimates.get("corner")
    if lag is not None and lag.lower is not None and lag.upper is not None:
        least = abs(lag.value) - _CERTAIN * (lag.upper - lag.lower) / 2
        if least > 0:
            late = "force is recorded" if lag.value > 0 else "position is recorded"
            ends = sorted((abs(lag.lower), abs(lag.upper)))
            yield (
                f"The {late} {abs(lag.value):.2g} ms late ({ends[0]:.2g} to {ends[1]:.2g} ms); the fit takes that into"
                " account, but one clock for both channels would make the intervals narrower."
            )
    if corner is not None and corner.known:
        yield (
            f"The force is filtered: the residuals show a first-order filter with a corner of {corner.value:.3g} Hz"
            f" ({corner.lower:.3g} to {corner.upper:.3g} Hz), which the fit takes into account; state a known corner by"
            " --corner."
        )


def _coarse(best_fit: Fit, sampling: Spread, tests: Sequence[Test]) -> Iterator[str]:
    """Yield a warning if the rows of a test are further apart than T, with the coordinates that this affects."""
    coarse = coarse_kinds(best_fit.model, tests)
    if not coarse:
        return
    moved = np.abs(moved_between_rows(best_fit, tests))
    errors = np.sqrt(np.diag(np.asarray(sampling.covariance)))
    names = [n for n, m, e in zip(best_fit.model.labels, moved, errors, strict=True) if m > _SHARE_OF_ERROR * e]
    so = f"; a curve in place of it moves {' and '.join(names)} by more than half a standard error" if names else ""
    yield (
        f"The samples of the {' and '.join(coarse)} test are more than T = {1000 * best_fit.model.T:g} ms apart;"
        f" the input was interpolated linearly in between{so}, which the intervals do not contain: record a row every"
        f" {1000 * best_fit.model.T:g} ms while the input changes."
    )


def recording(test: Test, T: float) -> Iterator[str]:
    """Yield warnings about the recording of a test: a large change of the input within a gap, or an untared start.

    `T` (s): sampling time of the model, inf for moduli. Nothing is yielded for a test of moduli.
    """
    if test.input is None:
        return
    applied, measured, time = test.input.mean(axis=0), test.output.mean(axis=0), test.time - test.time[0]
    step, change = np.diff(time), np.abs(np.diff(applied))
    gap = (step > _WIDE * np.median(step)) & (step > _TICKS * T) & (change > _SHARE * np.ptp(applied))
    if gap.any():
        i = int(np.argmax(np.where(gap, change, 0)))
        yield (
            f"The {test.kind} test has no rows from {time[i]:g} s to {time[i + 1]:g} s, where its input changes by"
            f" {change[i] / np.ptp(applied):.0%} of its range: a straight line was taken there, and values and"
            " intervals are wrong if the input went another way; record that part with rows as close as elsewhere."
        )
    lost = lost_contact(test)
    if lost is not None and is_fitted_in_force(test):
        yield (
            f"The handle left the material at {time[lost]:g} s of the {test.kind} test: the rows from there on are not"
            " fitted, because the position is not that of its surface; a smaller change of the force keeps contact."
        )
    offset = untared(applied, measured) if test.start == "rest" else None
    if offset is not None and _above_scatter(test.input if offset == "input" else test.output):
        names = ("position", "force") if (offset == "input") == (test.kind == "relaxation") else ("force", "position")
        first = (applied if offset == "input" else measured)[0]
        unit = "mm" if names[0] == "position" else "N"
        yield (
            f"The {test.kind} test does not begin at rest: its first row has a {names[0]} of {first:.3g} {unit} and no"
            f" {names[1]}; unless that is noise, values and intervals are wrong: tare it (subtract that from every"
            f" {names[0]})."
        )


def stiffening(K1: float, tests: Sequence[Test]) -> str:
    """Sentence on tests that are fitted best by a `K1` (N/mm) below 0: what they do while the input is held, likely
    causes, and what to do."""
    changes = ", and ".join(change for test in tests if (change := _wrong_way(test)))
    return (
        f"The best fit has K1 = {K1:.3g} N/mm, below 0, which no viscoelastic material has"
        f"{f' ({changes})' if changes else ''}; check the columns and their signs, that the indenter stands still"
        " during the hold, and that the sensor does not drift; leave out the rows in which it does, or record again."
    )


def _wrong_way(test: Test) -> str:
    """What the output does against the direction of relaxation or creep while the input is held at the end of a test;
    "" if it does not."""
    hold = hold_at_end(test)
    if test.input is None or hold is None:
        return ""
    time, applied, measured = test.time[hold], test.input.mean(axis=0)[hold], test.output.mean(axis=0)[hold]
    few = max(1, measured.size // 10)
    first, last = float(measured[:few].mean()), float(measured[-few:].mean())
    grows = (last - first) * float(np.sign(applied[-1])) > 0
    if grows != (test.kind == "relaxation") or first == last:
        return ""
    name, unit, other, of_other = ("force", "N", "position", "mm")
    if test.kind == "creep":
        name, unit, other, of_other = other, of_other, name, unit
    way = "rises" if last > first else "falls"
    return (
        f"the {name} of the {test.kind} test {way} from {first:.4g} to {last:.4g} {unit}"
        f" while its {other} is held ({applied[0]:.4g} to {applied[-1]:.4g} {of_other}, {time[0]:g} to {time[-1]:g} s)"
    )


def _above_scatter(values: np.ndarray) -> bool:
    """Whether the mean first value of `values` (R, m) is over 4 standard errors from 0; True for a single repeat."""
    first, repeats = values[:, 0], values.shape[0]
    return repeats == 1 or bool(abs(first.mean()) > _SURE * np.std(first, ddof=1) / np.sqrt(repeats))
