"""Fit settings that nobody should choose by every inference in both precisions; for docs/results/accuracy.md.

    python benchmarks/stress.py [--write] [--quick] [--small]

The cases are tests/support/stress_cases.py's: 240 with 0 to 25 answers, 24 with 100, 8 with 600, the last not for
`exact`, which is for about 100. A fit ends well if it holds its certificate, gives finite numbers and variances between
0 and the prior's, and, where a reference exists, agrees with it: Laplace with 25 digits (a quarter of the small cases),
the others with quadrature (points equal or unconnected). Committees of 1 to 10,000 experts against 50 digits. Ten
minutes on one core; --quick fits a tenth of the cases, --small those of up to 25 answers.
"""

import functools
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "support")]

from datasets import Dataset  # noqa: E402
from helpers import model  # noqa: E402
from reference_laplace import bcm_mp, mpmath_laplace  # noqa: E402
from stress_cases import reference, stress_cases  # noqa: E402

from hilbo import Trials, bcm, fit  # noqa: E402

__all__ = ["main"]

INFERENCES = ("laplace", "ep", "ep_corrected", "exact")
CAPACITY = {"small": 25, "hundred": 100, "large": 600}
CASES = {"small": 240, "hundred": 24, "large": 8}
RATIOS = (1e2, 1e4, 1e6, np.inf)
# How far a right answer may be from the exact posterior: mean in prior sds; log evidence per answer, and at all.
ALLOWED = {"ep": (0.25, 0.05, 0.2), "ep_corrected": (0.25, 0.05, 0.2), "exact": (0.02, 1e-3, 0.02)}


@dataclass(frozen=True)
class Outcome:
    """One fit: whether it is reported as converged, a fault nevertheless, and its errors."""

    case: Dataset
    converged: bool
    wrong: str
    steps: int
    mean_error: float = np.nan
    evidence_error: float = np.nan

    @property
    def ratio(self) -> float:
        return np.sqrt(self.case.variance) / self.case.noise


@functools.partial(jax.jit, static_argnames="inference")
def answer(gp, trials, x, inference):
    """Certificate, means and variances at x, class probabilities there, and log evidence: compiled as one."""
    posterior = fit(gp, trials, inference=inference, throw=False)
    return posterior.certificate, *posterior.predict(x), posterior.class_probabilities(x), posterior.log_evidence


def fit_case(case: Dataset, size: str, inference: str, dtype: type, truth) -> Outcome:
    trials = Trials.from_arrays(case.x.astype(dtype), case.q, CAPACITY[size])
    x = jnp.asarray(np.concatenate([case.x_new, np.zeros((6 - len(case.x_new), case.x.shape[1]))]).astype(dtype))
    certificate, *parts = answer(model(case, dtype), trials, x, inference)
    mean, variance, probabilities, evidence = (np.asarray(part, float) for part in parts)
    converged, steps = bool(certificate.converged), int(certificate.iterations)
    if not converged:
        return Outcome(case, False, "", steps)
    epsilon = float(np.finfo(dtype).eps)
    slack = 10 * epsilon * case.variance * CAPACITY[size] ** 0.5
    checks = {
        "not finite": all(np.all(np.isfinite(v)) for v in (mean, variance, probabilities, evidence)),
        "variance": np.all((variance >= -slack) & (variance <= case.variance * (1 + 1e-5))),
        "probabilities": np.all(np.abs(np.sum(probabilities, axis=1) - 1) < 200 * epsilon * len(probabilities[0])),
        "evidence above 0": evidence <= 100 * epsilon * (1 + len(case.q)),
    }
    wrong = ", ".join(name for name, good in checks.items() if not good)
    if wrong or truth is None:
        return Outcome(case, True, wrong, steps)
    true_evidence, true_mean = truth
    off = float(np.max(np.abs(mean[: len(true_mean)] - true_mean), initial=0.0)) / np.sqrt(case.variance)
    apart = abs(evidence - true_evidence)
    if inference == "laplace":
        of_mean, of_evidence = 2 * float(certificate.residual) + 1e3 * epsilon**0.5, epsilon**0.25 * abs(true_evidence)
    else:
        of_mean, each, whole = ALLOWED[inference]
        of_evidence = each * len(case.q) + whole + epsilon**0.5 * abs(true_evidence)
    wrong = ", ".join(name for name, far in (("mean", off > of_mean), ("evidence", apart > of_evidence + 1e-4)) if far)
    return Outcome(case, True, wrong, steps, off, apart / max(1.0, abs(true_evidence)))


def truths(cases: list[Dataset], size: str) -> tuple[list, list]:
    """(log evidence, means at the first new points) of Laplace's approximation, and of the exact posterior."""
    by_laplace, by_quadrature = [], []
    for index, case in enumerate(cases):
        digits = None
        if size == "small" and index % 4 == 0:
            digits = mpmath_laplace(*case.problem(), digits=25)
            digits = float(digits["log_evidence"]), digits["mean"].astype(float)
        by_laplace.append(digits)
        known = reference(case)
        by_quadrature.append(known and (known[0], known[1][:3]))
    return by_laplace, by_quadrature


def run(quick: bool, sizes: tuple[str, ...]) -> dict:
    """{(inference, dtype name): (outcomes, seconds)}."""
    results = {(name, dtype): ([], 0.0) for name in INFERENCES for dtype in ("float64", "float32")}
    for size in sizes:
        cases = list(stress_cases(size, CASES[size]))[:: 10 if quick else 1]
        of_laplace, of_posterior = truths(cases, size)
        for inference, dtype in results:
            if inference == "exact" and size == "large":
                continue
            truth = of_laplace if inference == "laplace" else of_posterior
            start = time.perf_counter()
            outcomes = [
                fit_case(c, size, inference, np.dtype(dtype).type, t) for c, t in zip(cases, truth, strict=True)
            ]
            for outcome in outcomes:
                if outcome.wrong or (dtype == "float64" and not outcome.converged):
                    print(f"  {outcome.wrong or 'said no'}: {outcome.case.name}", file=sys.stderr)
            before, seconds = results[inference, dtype]
            results[inference, dtype] = before + outcomes, seconds + time.perf_counter() - start
            print(f"{size} {inference} {dtype}: {time.perf_counter() - start:.0f} s", file=sys.stderr)
    return results


def table(results) -> str:
    head = "| inference | cases | converged | not converged | wrong | checked | worst mean (prior sd) |"
    rows = [head + " worst evidence (relative) | steps, median and most |", "|---|" + "---:|" * 8]
    for (inference, dtype), (outcomes, _) in results.items():
        good = [o for o in outcomes if o.converged]
        checked = [o for o in good if np.isfinite(o.mean_error)]
        steps = [o.steps for o in good]
        rows.append(
            f"| {inference}, {dtype} | {len(outcomes)} | {len(good)} | {len(outcomes) - len(good)} "
            f"| {sum(bool(o.wrong) for o in good)} | {len(checked)} | {max(o.mean_error for o in checked):.1g} "
            f"| {max(o.evidence_error for o in checked):.1g} | {np.median(steps):.0f}, {max(steps)} |"
        )
    return "\n".join(rows)


def by_ratio(results) -> str:
    """Fits reported as not converged, of all, by prior sd over noise."""
    head = ["up to 1e2", "1e2 to 1e4", "1e4 to 1e6", "above 1e6"]
    rows = ["| inference | " + " | ".join(head) + " |", "|---|" + "---:|" * len(head)]
    for (inference, dtype), (outcomes, _) in results.items():
        cells, low = [], 0.0
        for high in RATIOS:
            part = [o for o in outcomes if low < o.ratio <= high * (1 + 1e-9)]
            cells.append(f"{sum(not o.converged for o in part)} of {len(part)}")
            low = high * (1 + 1e-9)
        rows.append(f"| {inference}, {dtype} | " + " | ".join(cells) + " |")
    return "\n".join(rows)


def failures(results) -> str:
    """Every wrong fit, and those in float64 that are reported as not converged."""
    wrong = [f"- **{inference}, {dtype}: {o.wrong}**: {o.case.name}"
             for (inference, dtype), (outcomes, _) in results.items() for o in outcomes if o.wrong]  # fmt: skip
    said = [f"- {inference}: {o.case.name}"
            for (inference, dtype), (outcomes, _) in results.items() for o in outcomes
            if dtype == "float64" and not o.converged]  # fmt: skip
    return "\n".join(["Wrong, although reported as converged:", "", *(wrong or ["- none"]), "",
                      "Reported as not converged in float64:", "", *(said or ["- none"])])  # fmt: skip


def committees() -> str:
    """Worst relative error of mean (against the sum of its terms' sizes) and variance, over priors and strengths."""
    rows = [
        "| experts | mean, float64 | variance, float64 | mean, float32 | variance, float32 |",
        "|---:|" + "---:|" * 4,
    ]
    for count in (1, 10, 100, 1000, 10_000):
        worst = []
        for dtype in (np.float64, np.float32):
            errors = [
                _committee(count, prior, strongest, dtype) for prior in (1e-6, 1.0, 1e6) for strongest in (-9, -2, 0)
            ]
            worst += list(np.max(errors, axis=0))
        rows.append(f"| {count:,} | " + " | ".join(f"{value:.0e}" for value in worst) + " |")
    return "\n".join(rows)


def _committee(count, prior, strongest, dtype):
    """Experts who explain between 1e-12 and 10^strongest of the prior variance, the strongest all but 1e-4 of it."""
    rng = np.random.default_rng([count, strongest + 10])
    share = 10 ** rng.uniform(-12, strongest, (count, 3)) * (1 - 1e-4)
    means = (np.sqrt(prior) * rng.standard_normal((count, 3))).astype(dtype)
    variances = (prior * (1 - share)).astype(dtype)
    inside = np.minimum(variances, dtype(prior))
    mean, variance = (
        np.asarray(part, float) for part in bcm.combine(jnp.asarray(means), jnp.asarray(inside), dtype(prior))
    )
    true_mean, true_variance = (part.astype(float) for part in bcm_mp(means, inside, dtype(prior)))
    size = true_variance * np.sum(np.abs(means.astype(float)) / inside.astype(float), axis=0)
    return np.max(np.abs(mean - true_mean) / size), np.max(np.abs(variance / true_variance - 1))


PAGE = """Made by `python benchmarks/stress.py --write`; `tests/inference/test_stress.py` runs a part of it,
`tests/inference/test_hostile.py` and `tests/inference/test_ep.py` a full grid of 540 milder cases.

Noise 1e-4 to 10, theta 1e-3 to 1e5, prior variance 1e-6 to 1e6, gaps between thresholds 1e-4 to 1e2, 2 to 10
categories, 1 to 20 dimensions, and responses ({counts}): a Latin hypercube. Responses independent of x, sensible, of
one category, conflicting on five points, all on one point, on a line; predictions at tested points and elsewhere.
"Converged": by its diagnostics. "Wrong": converged, but a number is not finite, a variance is outside 0 and the
prior's, or a reference disagrees (Laplace: the same approximation to 25 digits; the others: quadrature of the exact
posterior where all points are equal or unconnected). "Worst" errors are over the converged fits; those of EP are errors
of the method.
{table}

{failures}

Fits reported as not converged, by the prior's standard deviation over the noise:

{ratios}

Recommendation: a prior sd below about 1e4 times the noise, in float32 below 1e2 times; beyond it contradictory
responses require more digits than the precision has.

### Committees

1 to 10,000 experts who explain from 1e-12 to all but 1e-4 of the prior variance (1e-6, 1, 1e6), against 50 digits.
Relative to the variance, and to the sum of the sizes of the mean's terms; in float32 the input variances are
representable in float32 (with `combine_explained` nothing is lost there).

{committees}
"""


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    sizes = ("small",) if "--small" in sys.argv[1:] else tuple(CASES)
    results = run("--quick" in sys.argv[1:], sizes)
    counts = ", ".join(f"{CASES[size]} of up to {CAPACITY[size]}" for size in sizes)
    text = PAGE.format(
        counts=counts,
        table=table(results),
        failures=failures(results),
        ratios=by_ratio(results),
        committees=committees(),
    )
    print(text)
    if "--write" in sys.argv[1:]:
        from pages import put  # beside this file: found when it is run, not when a test imports it

        put("results/accuracy.md", "stress", text)


if __name__ == "__main__":
    main()
