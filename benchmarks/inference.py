"""How wrong each inference is, and whether `exact` is as right as it says; with --write into docs/methods/inference.md.

    python benchmarks/inference.py [--write]

On the six small data sets of tests/support/datasets.py: errors of Laplace, EP and corrected EP against `exact` with
131,072 samples; `exact` against elliptical slice sampling and SciPy's Genz routine (tests/support/reference_exact.py,
no code of hilbo), in standard errors of both; and, on three of them and over 200 keys, how often the truth is within
two stated standard errors (three stimuli: by quadrature; otherwise by 131,072 samples, whose error is an eighth of
that). A few minutes.
"""

import os
import sys
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import jax.numpy as jnp
import numpy as np

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "support")]
jax.config.update("jax_enable_x64", True)

from datasets import SIX, Dataset, near_separable, repeated, repeated_19  # noqa: E402
from helpers import answers, model  # noqa: E402
from pages import put  # noqa: E402
from reference_exact import genz, quadrature, slice_sampled  # noqa: E402

from hilbo import fit  # noqa: E402
from hilbo.inference.exact import exact  # noqa: E402
from hilbo.kernels import gram  # noqa: E402
from hilbo.ordinal_gp import Posterior  # noqa: E402

__all__ = ["main"]

KEYS = 200
COVERED = 3  # points
REPEATED = (near_separable, repeated, repeated_19)  # data sets whose coverage is counted
APPROXIMATE = ("laplace", "ep", "ep_corrected")


def sampled(data: Dataset, key, samples: int) -> Posterior:
    gp, trials = model(data), answers(data)
    edges = jnp.asarray([-jnp.inf, *data.thresholds, jnp.inf])
    covariance = gram(gp.kernel, trials.x, trials.x)
    low, high = edges[trials.q], edges[trials.q + 1]
    return Posterior(gp, trials, exact(key, covariance, low, high, gp.likelihood.noise, trials.mask, samples))


def results(posterior, x):
    """Log evidence, means, variances and class probabilities at x, in one row."""
    mean, variance = posterior.predict(x)
    return jnp.concatenate([posterior.log_evidence[None], mean, variance, posterior.class_probabilities(x).ravel()])


def split(row, points: int):
    return row[0], row[1 : 1 + points], row[1 + points : 1 + 2 * points], row[1 + 2 * points :]


def truth_of(data: Dataset) -> np.ndarray:
    if data.name in (repeated().name, repeated_19().name):
        return np.concatenate([np.ravel(part) for part in quadrature(data)])
    return np.asarray(results(sampled(data, jax.random.key(10_000), 32 * 4096), jnp.asarray(data.x_new)))


def errors(data: Dataset, truth: np.ndarray) -> list[str]:
    """Rows of the table: largest errors at the new points, and the signed one of the evidence; means also by RMS."""
    points, rows = len(data.x_new), []
    evidence, mean, variance, probability = split(truth, points)
    for method in APPROXIMATE:
        posterior = fit(model(data), answers(data), inference=method)
        approximation = split(np.asarray(results(posterior, jnp.asarray(data.x_new))), points)
        off = np.abs(approximation[1] - mean)
        figures = (
            f"{np.sqrt(np.mean(off**2)):.4f}",
            f"{np.max(off):.4f}",
            f"{np.max(np.abs(np.sqrt(approximation[2]) - np.sqrt(variance))):.4f}",
            f"{np.max(np.abs(approximation[3] - probability)):.4f}",
            f"{approximation[0] - evidence:+.4f}",
        )
        name = f"{data.name.replace('_', ' ')} ({data.noise:g})" if method == "laplace" else ""
        rows.append(f"| {name} | {method} | " + " | ".join(figures) + " |")
    return rows


def independent(data: Dataset) -> str:
    """Largest distance of means, and that of the evidence, from two other methods, in standard errors of both."""
    posterior, x = fit(model(data), answers(data), inference="exact"), jnp.asarray(data.x_new)
    evidence, evidence_error = genz(data)
    mean, mean_error = slice_sampled(data)
    own = posterior.certificate.log_evidence_error
    apart = float(posterior.log_evidence - evidence) / np.hypot(own, evidence_error)
    means = np.abs(posterior.predict(x)[0] - mean) / np.hypot(mean_error, posterior.standard_errors(x)[0])
    return f"| {data.name.replace('_', ' ')} | {np.max(means):.1f} | {abs(apart):.1f} |"


def coverage(data: Dataset, truth: np.ndarray) -> tuple[str, list[float]]:
    """Share of 200 keys with the truth at three points within two standard errors: evidence, and means over groups of
    quantities."""
    x, points = jnp.asarray(data.x_new[:COVERED]), COVERED
    evidence, mean, variance, probability = split(truth, len(data.x_new))
    categories = len(probability) // len(data.x_new)
    truth = np.concatenate([[evidence], mean[:points], variance[:points], probability[: points * categories]])

    @jax.jit
    def once(key):
        posterior = sampled(data, key, 512 * 32)
        of_moments = [part.ravel() for part in posterior.standard_errors(x)]
        return results(posterior, x), jnp.concatenate([posterior.certificate.log_evidence_error[None], *of_moments])

    estimates, stated = map(np.stack, zip(*(once(jax.random.key(seed)) for seed in range(KEYS)), strict=True))
    covered = np.mean(np.abs(estimates - truth[None, :]) <= 2 * stated + 1e-12, axis=0)
    groups = [float(np.mean(part)) for part in split(covered, points)]
    return f"| {data.name.replace('_', ' ')} | " + " | ".join(f"{100 * share:.1f}" for share in groups) + " |", groups


def page() -> str:
    of_errors, of_others, of_coverage, shares = [], [], [], []
    for make in SIX:
        data = make()
        truth = truth_of(data)
        of_errors += errors(data, truth)
        of_others.append(independent(data))
        if make in REPEATED:
            row, groups = coverage(data, truth)
            of_coverage.append(row)
            shares.append(groups)
        print(f"{data.name} done", file=sys.stderr)
    mean = " | ".join(f"{100 * share:.1f}" for share in np.mean(shares, axis=0))
    return f"""| data (noise) | method | mean, RMS | mean, largest | sd | class probability | log evidence |
|---|---|---:|---:|---:|---:|---:|
{chr(10).join(of_errors)}

`exact` against two methods that share no code with it, in standard errors of both, the largest over the new points:

| data | means: elliptical slice sampling | log evidence: SciPy's Genz |
|---|---:|---:|
{chr(10).join(of_others)}

Per cent of {KEYS} keys with the truth within two stated standard errors:

| data | log evidence | means | variances | class probabilities |
|---|---:|---:|---:|---:|
{chr(10).join(of_coverage)}
| all | {mean} |"""


def main():
    text = page()
    print(text)
    if "--write" in sys.argv[1:]:
        put("methods/inference.md", "inference", text)


if __name__ == "__main__":
    main()
