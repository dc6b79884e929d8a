"""How often the 95 % intervals of lapse rate and drift hold the truth, for simulated people who are what is fitted.

    python benchmarks/coverage_people.py [--people 400] [--write]

People have a latent function drawn from the prior plus a level of their own (sd 1), answer at uniform points of the
paper's box through the ordinal probit, lapse at a rate and drift over the session. --write puts the table into
docs/guides/report.md.
"""

import argparse
import sys
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))
from pages import put  # noqa: E402

from hilbo import RBF, OrdinalGP, OrdinalProbit, Trials  # noqa: E402
from hilbo.kernels import gram  # noqa: E402
from hilbo.population.response_quality import measure_people  # noqa: E402

CASES = [(25, 0.0, 0.0), (25, 0.1, 0.0), (25, 0.3, 0.0), (25, 0.0, -1.0), (25, 0.1, -1.0), (100, 0.1, -1.0)]


def crowd(gp, people, trials, lapse, drift, seed):
    """Stacked trials of simulated people."""
    rng = np.random.default_rng([seed, trials, int(100 * lapse), int(-10 * drift)])
    edges, categories = np.asarray(gp.likelihood.thresholds), len(gp.likelihood.thresholds) + 1
    records = []
    for _ in range(people):
        x = rng.random((trials, 3))
        covariance = np.asarray(gram(gp.kernel, jnp.asarray(x), jnp.asarray(x)))
        values, vectors = np.linalg.eigh(covariance)
        f = vectors @ (np.sqrt(np.maximum(values, 0)) * rng.standard_normal(trials)) + rng.standard_normal()
        z = f + drift * np.linspace(-0.5, 0.5, trials) + float(gp.likelihood.noise) * rng.standard_normal(trials)
        q = np.where(rng.random(trials) < lapse, rng.integers(categories, size=trials), np.searchsorted(edges, z))
        records.append(Trials.from_arrays(x, q, trials))
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *records)


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--people", type=int, default=400)
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    gp = OrdinalGP(RBF(5.0), OrdinalProbit((-0.5, 0.5), 0.5))
    lines = [
        f"Made by `python benchmarks/coverage_people.py --write`: {chosen.people} simulated people a row.",
        "",
        "| trials | lapse rate | drift | lapse held, median width | drift held, median width |",
        "|---:|---:|---:|---:|---:|",
    ]
    for trials, lapse, drift in CASES:
        table = measure_people(
            gp, crowd(gp, chosen.people, trials, lapse, drift, 0), tuple(map(str, range(chosen.people)))
        )
        cells = [f"{trials}", f"{lapse:g}", f"{drift:g}"]
        for name, truth in (("lapse", lapse), ("drift", drift)):
            low, high = table[f"{name}_low"], table[f"{name}_high"]
            cells.append(f"{100 * np.mean((low <= truth + 1e-4) & (truth <= high)):.1f} %, {np.median(high - low):.2f}")
        lines.append("| " + " | ".join(cells) + " |")
        print(lines[-1])
    if chosen.write:
        put("guides/report.md", "coverage", "\n".join(lines))


if __name__ == "__main__":
    main()
