"""Participants who take the lowest response for the highest: how many are found, and how many others are named.

    python benchmarks/reversed_people.py FILE [--choose] [--studies 200] [--recorded]
    python benchmarks/reversed_people.py FILE --table [--choose] [--recorded]

FILE (JSON Lines) collects a row for each study of 24 x 25; a run that was stopped goes on where it was. What has been
run is in benchmarks/reversed_people.jsonl. 0, 1 or 2 participants reverse the scale from their first trial on, so that
their sessions choose other stimuli; or, with --recorded, their responses were recorded so. The limit was chosen
(--choose) on the presets paper-01, paper-04, ... paper-28, seeds from 0; reported are paper-02, paper-05, ... paper-29,
seeds from 1000. A row has the log Bayes factors in the order in which participants are left out, so that any limit can
be applied to it.
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
from jaxtyping import Array, Bool  # noqa: E402
from populations import cohort_from, rounded  # noqa: E402
from populations_people import Places  # noqa: E402
from rows import Rows  # noqa: E402

from hilbo.population.judged import reversed_scale  # noqa: E402
from hilbo.simulation.simulate import Person, simulate_study  # noqa: E402
from hilbo.study.estimate.learnt import resolved, that_learns  # noqa: E402

PEOPLE = 24
DEEPEST = 4  # participants who are left out, one after the other


class Turned(Person):
    """Participants with a flag for those who reverse the scale."""

    turned: Bool[Array, "*M"] = eqx.field(kw_only=True)

    def answer(self, key, x, progress):
        q = super().answer(key, x, progress)
        return jnp.where(self.turned, self.criteria.shape[-1] - q, q)


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("file", type=Path)
    options.add_argument("--studies", type=int, default=200)
    options.add_argument("--choose", action="store_true")
    options.add_argument("--recorded", action="store_true")
    options.add_argument("--table", action="store_true")
    chosen = options.parse_args()
    rows = Rows(chosen.file)
    if chosen.table:
        table([r for r in rows if (r["seed"] < 1000) == chosen.choose and r["recorded"] == chosen.recorded])
        return
    known = {(row["preset"], row["seed"], row["recorded"]) for row in rows}
    first, seed = (1, 0) if chosen.choose else (2, 1000)
    for i in range(chosen.studies):
        preset = f"paper-{first + 3 * (i % 10):02d}"
        if (preset, seed + i, chosen.recorded) not in known:
            row = {"preset": preset, "seed": seed + i, "recorded": chosen.recorded}
            rows.add(rounded(row | one_study(preset, seed + i, (i // 10) % 3, chosen.recorded)))


def one_study(preset, seed, count, recorded):
    """Factors of one study in which `count` participants reverse the scale; or, if `recorded`, their records are."""
    place = Places(preset=preset)
    persons = place.scene(place.study, PEOPLE, seed).persons
    fields = {name: getattr(persons, name) for name in persons.__dataclass_fields__}
    reverse = jnp.arange(PEOPLE) < count
    trials = simulate_study(place.study, Turned(**fields, turned=reverse & (not recorded)), seed)
    if recorded:
        highest = len(place.study.responses) - 1
        turned = jnp.where(reverse[:, None], highest - trials.q, trials.q)
        trials = eqx.tree_at(lambda t: t.q, trials, turned)
    learns = resolved(that_learns(place.study), cohort_from(trials))
    return {"reversed": count, "factors": path(learns.gp, trials, learns.learnt.model.share)}


def path(gp, trials, share):
    """Rows and factors of the participants who are left out, one after the other."""
    every = np.ones(PEOPLE, bool)
    steps = zip(range(DEEPEST), reversed_scale._above(gp, trials, share, every, -np.inf), strict=False)
    return [[row, factor] for _, (row, factor) in steps]


def table(rows):
    """Print, for each limit, the share of reversed participants who are found, and of studies in which others are."""
    for limit in (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0):
        cells = []
        for count in (0, 1, 2):
            studies = [named(row["factors"], limit) for row in rows if row["reversed"] == count]
            found = sum(row < count for people in studies for row in people)
            others = sum(any(row >= count for row in people) for people in studies)
            cells.append(f"{found}/{count * len(studies)} found, {others}/{len(studies)} with others")
        print(f"{limit}: " + "; ".join(cells))


def named(steps, limit):
    """The rows that are named with this limit."""
    people = []
    for row, factor in steps:
        if factor <= limit:
            break
        people.append(row)
    return people


if __name__ == "__main__":
    main()
