"""Fit the hostile grid in float64 and float32, and write what came out to docs/hostile.md.

    python benchmarks/hostile.py

540 cases: noise x theta x variance x (number and kind of answers); tests/datasets.py makes them, tests/test_hostile.py
holds them to their certificates. The 180 cases of 25 answers are also solved with 25 digits, which takes a minute.
"""

import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from datasets import Dataset, hostile_cases  # noqa: E402
from reference_laplace import mpmath_laplace  # noqa: E402

from hilbo import RBF, OrdinalGP, OrdinalProbit, Trials, fit  # noqa: E402
from hilbo.gaussian import Certificate  # noqa: E402

__all__ = ["main"]


@dataclass(frozen=True)
class Outcome:
    """What one fit said of itself, and its predictions at the case's new points."""

    case: Dataset
    certificate: Certificate
    mean: np.ndarray
    variance: np.ndarray
    log_evidence: float

    @property
    def finite(self) -> bool:
        return bool(np.all(np.isfinite([*self.mean, *self.variance, self.log_evidence])))


def fit_case(case: Dataset, dtype: type) -> Outcome:
    """Fit with inputs, hyperparameters and arithmetic all of one dtype, padded to 25 or 200 answers."""
    likelihood = OrdinalProbit(np.asarray(case.thresholds, dtype), dtype(case.noise))
    gp = OrdinalGP(RBF(dtype(case.theta), dtype(case.variance)), likelihood)
    trials = Trials.from_arrays(case.x.astype(dtype), case.q, 25 if len(case.q) <= 25 else 200)
    posterior = fit(gp, trials, throw=False)
    mean, variance = map(np.asarray, posterior.predict(jnp.asarray(case.x_new.astype(dtype))))
    certificate = jax.tree.map(np.asarray, posterior.certificate)
    return Outcome(case, certificate, mean, variance, float(posterior.log_evidence))


def run(cases: list[Dataset], dtype: type) -> tuple[list[Outcome], float]:
    """All outcomes, and the seconds they took, without compilation."""
    for case in cases[::8]:
        fit_case(case, dtype)
    start, outcomes = time.perf_counter(), []
    for index, case in enumerate(cases):
        outcomes.append(fit_case(case, dtype))
        if index % 60 == 0:
            print(f"{dtype.__name__}: {index} of {len(cases)}", file=sys.stderr)
    return outcomes, time.perf_counter() - start


def errors_of(outcomes: list[Outcome]) -> dict[str, float]:
    """Worst errors against 25 digits over the cases of 25 answers."""
    worst = {"mean, in prior sd": 0.0, "mean, in posterior sd": 0.0, "variance, relative": 0.0, "log evidence": 0.0}
    chosen = [outcome for outcome in outcomes if len(outcome.case.q) == 25]
    for index, outcome in enumerate(chosen):
        exact = mpmath_laplace(*outcome.case.problem(), digits=25)
        mean, variance = (exact[name].astype(float) for name in ("mean", "variance"))
        off, evidence = np.abs(outcome.mean - mean), float(exact["log_evidence"])
        found = (
            np.max(off) / np.sqrt(outcome.case.variance),
            np.max(off / np.sqrt(variance)),
            np.max(np.abs(outcome.variance / variance - 1)),
            abs(outcome.log_evidence - evidence) / max(1.0, abs(evidence)),
        )
        worst = {name: max(old, float(new)) for (name, old), new in zip(worst.items(), found, strict=True)}
        if index % 30 == 0:
            print(f"25 digits: {index} of {len(chosen)}", file=sys.stderr)
    return worst


def column(outcomes: list[Outcome], seconds: float) -> dict[str, str]:
    """One dtype's column of the table; figures are over the cases that converged."""
    good = [outcome for outcome in outcomes if outcome.certificate.converged]
    names = vars(good[0].certificate)
    figures = {name: np.array([getattr(o.certificate, name) for o in good], float) for name in names}
    steps = figures["iterations"]
    resolved = figures["smallest_variance"] / figures["variance_resolution"]
    return {
        "cases": f"{len(outcomes)}",
        "converged": f"{len(good)}",
        "converged, but a result is not finite": f"{sum(not outcome.finite for outcome in good)}",
        "residual, worst (prior sd)": f"{figures['residual'].max():.1e}",
        "residual / tolerance, worst": f"{np.max(figures['residual'] / figures['tolerance']):.2f}",
        "tolerance, largest (prior sd)": f"{figures['tolerance'].max():.1e}",
        "Newton steps, median and largest": f"{np.median(steps):.0f}, {steps.max():.0f}",
        "condition, largest": f"{figures['condition'].max():.1e}",
        "jitter, largest": f"{figures['jitter'].max():.1e}",
        "smallest variance / its resolution, least": f"{resolved.min():.1e}",
        "cases with a variance below its resolution": f"{np.sum(resolved < 1)}",
        "time, compiled": f"{seconds:.1f} s",
    }


def failures(outcomes: list[Outcome], dtype: type) -> list[str]:
    """A section that names each case that did not converge, or whose certificate hid something."""
    bad = [o for o in outcomes if not (o.certificate.converged and o.finite)]
    if not bad:
        return [f"## {dtype.__name__}: no failures", ""]
    lines = [f"## {dtype.__name__}: failures", "", "| case | residual | tolerance | condition | said so |"]
    lines += ["|---|---|---|---|---|"]
    for outcome in bad:
        c = outcome.certificate
        said = "no" if c.converged else "yes"
        lines.append(f"| {outcome.case.name} | {c.residual:.1e} | {c.tolerance:.1e} | {c.condition:.1e} | {said} |")
    return [*lines, ""]


def page(columns: dict[str, dict[str, str]], errors: dict[str, float], sections: list[str]) -> str:
    """docs/hostile.md."""
    rows = [f"| {name} | " + " | ".join(c[name] for c in columns.values()) + " |" for name in columns["float64"]]
    return "\n".join(
        [
            "# The hostile grid",
            "",
            "Made by `python benchmarks/hostile.py`; `tests/test_hostile.py` holds the fits to it.",
            "",
            "Noise 1e-3, 1e-2, 0.1, 0.5, 10; theta 1e-2, 1, 30, 1e4; variance 1e-3, 1, 1e4; answers all of one",
            "category, independent of x, or lowest and highest in turn on five stimuli; 0, 1, 25 and 200 of them.",
            "Every fit starts from nothing.",
            "",
            "| | " + " | ".join(columns) + " |",
            "|---|" + "---|" * len(columns),
            *rows,
            "",
            "Figures below the second row are over the fits that converged. The residual bounds the distance to the",
            "mode, and half the error of the predicted mean, in standard deviations of the prior (before rounding).",
            "",
            "Largest errors against 25 digits, in float64, over the 180 cases of 25 answers:",
            "",
            "| quantity | error |",
            "|---|---|",
            *(f"| {name} | {value:.1e} |" for name, value in errors.items()),
            "",
            *sections,
        ]
    )


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    cases, columns, sections, errors = list(hostile_cases()), {}, [], {}
    for dtype in (np.float64, np.float32):
        outcomes, seconds = run(cases, dtype)
        columns[dtype.__name__] = column(outcomes, seconds)
        sections += failures(outcomes, dtype)
        errors = errors or errors_of(outcomes)
    target = ROOT / "docs" / "hostile.md"
    target.parent.mkdir(exist_ok=True)
    temporary = target.with_suffix(".tmp")
    temporary.write_text(page(columns, errors, sections))
    os.replace(temporary, target)
    print(target)


if __name__ == "__main__":
    main()
