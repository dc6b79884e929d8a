"""Have all people best, mid and worst sets of their own map, and do they like them in that order? Simulated people.

    python benchmarks/own_maps.py FILE [--groups 200] [--preset paper]
    python benchmarks/own_maps.py FILE --write

FILE (JSON Lines) collects a row for each group of 8 people with 25 trials each; a run that was stopped goes on where it
was. What has been run is in benchmarks/own_maps.jsonl. For each person: which sets are a second choice
(`best_mid_worst`), and the true probability of the highest answer, without lapses, at best, mid and worst. --write puts
the table into docs/methods/simulation.md.
"""

import argparse
import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax

jax.config.update("jax_enable_x64", True)

import equinox as eqx  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from pages import put  # noqa: E402
from populations import cohort_from, lined, rounded  # noqa: E402
from populations_people import PAPER as STUDY  # noqa: E402
from rows import Rows  # noqa: E402

from hilbo.search.candidates import search_points  # noqa: E402
from hilbo.simulation.presets import PRESETS  # noqa: E402
from hilbo.simulation.simulate import people, simulate_study  # noqa: E402
from hilbo.study.analysis.best_mid_worst import best_mid_worst  # noqa: E402
from hilbo.study.estimate.aggregate import fit_cohort  # noqa: E402

PEOPLE, FIRST = 8, 1000
CHOICES = {
    "as defined": [],
    "worst of second choice": ["worst"],
    "mid of second choice": ["mid"],
    "both": ["mid", "worst"],
}


class OwnMap(eqx.Module):
    """A participant's posterior as a function."""

    posterior: eqx.Module

    def __call__(self, x):
        return self.posterior.predict(x)


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("file", type=Path)
    options.add_argument("--groups", type=int, default=200)
    options.add_argument("--preset", default="paper")
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    rows = Rows(chosen.file)
    if chosen.write:
        put("methods/simulation.md", "own maps", table(rows.rows))
        return
    known = {(row["preset"], row["seed"]) for row in rows}
    for seed in range(FIRST, FIRST + chosen.groups):
        if (chosen.preset, seed) not in known:
            row = {"preset": chosen.preset, "seed": seed, "people": one_group(chosen.preset, seed)}
            rows.add(row)
            print(row, flush=True)


def one_group(preset, seed):
    """Of each person the sets of second choice, and the chances of the highest answer at best, mid and worst."""
    persons = people(STUDY, PRESETS[preset], PEOPLE, seed)
    posteriors = fit_cohort(STUDY, cohort_from(simulate_study(STUDY, persons, seed)))
    points, found = search_points(STUDY.space, seed), []
    for j in range(PEOPLE):
        person, posterior = (jax.tree.map(lambda leaf, j=j: leaf[j], each) for each in (persons, posteriors))
        sets = best_mid_worst(STUDY, OwnMap(posterior), points)
        felt = jnp.stack([person.perceived(x) for x in sets.x])
        chances = np.asarray(jax.scipy.special.ndtr((person.criteria[-1] - felt) / person.noise))
        found.append({"second": list(sets.second_choice), "chances": chances.tolist()})
    return [rounded(each) | {"chances": [float(f"{c:.6g}") for c in each["chances"]]} for each in found]


def table(rows):
    """How many people have sets of second choice, and how many like best, mid and worst in that order."""
    heads = [
        "preset",
        "sets",
        "participants",
        "best highest, worst lowest",
        "best over worst",
        "probability at best, mid, worst",
    ]
    lines = []
    for preset in sorted({row["preset"] for row in rows}):
        every = [person for row in rows if row["preset"] == preset for person in row["people"]]
        for words, second in ({"all": None} | CHOICES).items():
            part = np.array([p["chances"] for p in every if second in (None, p["second"])]).reshape(-1, 3)
            if len(part):
                ordered, over = (part[:, 0] > part[:, 1]) & (part[:, 1] > part[:, 2]), part[:, 0] > part[:, 2]
                share = [f"{100 * np.mean(each):.1f} %" for each in (ordered, over)]
                means = ", ".join(f"{100 * mean:.0f} %" for mean in part.mean(axis=0))
                lines.append([f"`{preset}`", words, f"{len(part)} of {len(every)}", *share, means])
    return lined(heads, lines)


if __name__ == "__main__":
    main()
