"""The simulated preset `paper-individuals` over many seeds, beside the paper's figures, for docs/methods/simulation.md.

    python benchmarks/preset_paper.py --seeds 20 --write

Every seed is a study of 24 people x 25 trials: the answers, how far the individuals' optima are from the truth, and
what one gets by averaging the optima, by averaging the maps and by the committee machine after every trial.
"""

import argparse
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]


def one_study(study, seed, candidates):
    """Answers and errors of one simulated study (NRMSE over K1, B1, alpha by search range)."""
    from hilbo.search.apart import nrmse
    from hilbo.simulation import simulate
    from hilbo.simulation.presets import PRESETS
    from hilbo.study.analysis.progress import follow
    from hilbo.study.cohort import Cohort
    from hilbo.study.estimate.aggregate import aggregate_cohort
    from hilbo.study.estimate.optimum import population_optimum

    population = PRESETS["paper-individuals"]
    truth = np.asarray(study.space.to_unit(np.array([population.truth[name] for name in study.space.names])))
    trials = simulate.simulate_study(study, simulate.people(study, population, 24, seed), seed)
    cohort = Cohort(trials, np.zeros((24, 25, 3)), tuple(f"P{j:02d}" for j in range(24)))
    aggregate = aggregate_cohort(study, cohort, 0, alternatives=False)
    progress = follow(study, aggregate, 0)
    merged, own = progress.population, progress.individual
    average = np.asarray(population_optimum(study, aggregate.posteriors, candidates, "average").x)
    close = np.asarray((trials.q == 2).sum(axis=1))
    return {
        "close": (close.mean(), close.std(ddof=1)),
        "physical": np.asarray(study.space.to_physical(own[-1])),
        "own": np.asarray(nrmse(own[-1], truth)),
        "own_progress": np.median(np.sqrt(np.mean((own - truth) ** 2, axis=2)), axis=1),
        "bcm": np.sqrt(np.mean((merged - truth) ** 2, axis=1)),
        "settling": np.sqrt(np.mean((merged - merged[-1]) ** 2, axis=1)),
        "mean_of_optima": float(nrmse(own[-1].mean(axis=0), truth)),
        "average": float(nrmse(average, truth)),
    }


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--seeds", type=int, default=20)
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    import jax

    jax.config.update("jax_enable_x64", True)
    from hilbo.search.candidates import search_points
    from hilbo.study.config import Study

    study = Study.load(ROOT / "hilbo" / "data" / "paper.toml")
    candidates = search_points(study.space, 0)
    studies = [one_study(study, seed, candidates) for seed in range(chosen.seeds)]
    text = report(studies)
    print(text)
    if chosen.write:
        path = ROOT / "docs" / "methods" / "simulation.md"
        head = path.read_text().split("<!-- measured -->")[0] if path.exists() else ""
        path.write_text(f"{head}<!-- measured -->\n{text}")


def report(studies):
    close = np.mean([f["close"] for f in studies], axis=0)
    own = np.concatenate([f["own"] for f in studies])
    physical = np.concatenate([f["physical"] for f in studies])
    q = 100 * np.percentile(own, [25, 50, 75])
    mean, sd = physical.mean(axis=0), physical.std(axis=0, ddof=1)
    row = lambda key: 100 * np.percentile([f[key] for f in studies], [25, 50, 75])  # noqa: E731
    bcm = 100 * np.array([f["bcm"] for f in studies])
    final = np.percentile(bcm[:, -1], [25, 50, 75])
    mid, average = row("mean_of_optima"), row("average")
    settling = 100 * np.median([f["settling"] for f in studies], axis=0)
    people = 100 * np.median([f["own_progress"] for f in studies], axis=0)
    lines = [
        f"Made by `python benchmarks/preset_paper.py --seeds {len(studies)} --write`:"
        f" {len(studies)} studies of 24 x 25.",
        "",
        "| | simulated | paper |",
        "|---|---|---|",
        f'| responses "close" of 25, mean ± sd over participants | {close[0]:.2f} ± {close[1]:.2f} | 5.96 ± 4.47 |',
        f"| individuals' NRMSE to the truth, quartiles | {q[0]:.0f}, {q[1]:.0f}, {q[2]:.0f} % | 13, 24, 41 % |",
        f"| individual optima K1 (N/mm) | {mean[0]:.2f} ± {sd[0]:.2f} | 8.44 ± 8.25 |",
        f"| B1 (N.s^alpha/mm) | {mean[1]:.2f} ± {sd[1]:.2f} | 10.28 ± 8.64 |",
        f"| alpha | {mean[2]:.3f} ± {sd[2]:.3f} | 0.282 ± 0.140 |",
        "| *predictions, not calibrated:* | median [quartiles] over studies | |",
        f"| population map (BCM) to the truth | {final[1]:.1f} % [{final[0]:.1f}, {final[2]:.1f}] | 4 % |",
        f"| mean of the individual optima | {mid[1]:.1f} % [{mid[0]:.1f}, {mid[2]:.1f}] | 10.5 % |",
        f"| plain average of the maps | {average[1]:.1f} % [{average[0]:.1f}, {average[2]:.1f}] | |",
        "",
        "After each trial (medians over studies; NRMSE in %):",
        "",
        "| trial | BCM to the truth [quartiles] | BCM to its final optimum | median individual to the truth |",
        "|---:|---:|---:|---:|",
    ]
    for t in range(bcm.shape[1]):
        low, middle, high = np.percentile(bcm[:, t], [25, 50, 75])
        lines.append(f"| {t + 1} | {middle:.1f} [{low:.1f}, {high:.1f}] | {settling[t]:.1f} | {people[t]:.1f} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
