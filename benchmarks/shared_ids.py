"""Participant ids that two people share, one after the other: how many are found by whether one map fits both halves.

    python benchmarks/shared_ids.py FILE [--choose] [--studies 60]
    python benchmarks/shared_ids.py FILE --table [--choose]

FILE (JSON Lines) collects a row for each study of 24 x 25; a run that was stopped goes on where it was. What has been
run is in benchmarks/shared_ids.jsonl. In every second study the first id has 32 responses: the first 16 of one person's
session, and the first 16 of another's. For each participant the log Bayes factor (nats) compares two independent
individual functions, before and after a change point, with one; both are conditional on the map of the others, with
learnt hyperparameters, and the responses are predicted in turn, with lapses. A row has the factors of the participants
with the change point in the middle (`middle`), and averaged over all change points with at least 5 responses on either
side (`any`). A limit was chosen (--choose) on the presets paper-01, paper-04, ... paper-28, seeds from 2000; reported
are paper-02, paper-05, ... paper-29, seeds from 3000.
"""

import argparse
import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from populations import cohort_from, rounded  # noqa: E402
from populations_people import Places  # noqa: E402
from rows import Rows  # noqa: E402

from hilbo.kernels import gram  # noqa: E402
from hilbo.ordinal_gp import Trials, fit  # noqa: E402
from hilbo.population.newcomer import in_turn, with_variances  # noqa: E402
from hilbo.population.pointwise import merged_without  # noqa: E402
from hilbo.simulation.simulate import simulate_study  # noqa: E402
from hilbo.study.estimate.learnt import resolved, that_learns  # noqa: E402

PEOPLE, HALF, FEWEST = 24, 16, 5
LAPSE = 0.05  # probability of an arbitrary response, as of the remark on reversed scales
FALSE = 0.05  # of the studies without a shared id


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("file", type=Path)
    options.add_argument("--studies", type=int, default=60)
    options.add_argument("--choose", action="store_true")
    options.add_argument("--table", action="store_true")
    chosen = options.parse_args()
    rows = Rows(chosen.file)
    if chosen.table:
        table([r for r in rows if (r["seed"] < 3000) == chosen.choose])
        return
    known = {(row["preset"], row["seed"]) for row in rows}
    first, seed = (1, 2000) if chosen.choose else (2, 3000)
    for i in range(chosen.studies):
        preset = f"paper-{first + 3 * (i // 2 % 10):02d}"
        if (preset, seed + i) not in known:
            rows.add(rounded({"preset": preset, "seed": seed + i} | one_study(preset, seed + i, i % 2)))


def one_study(preset, seed, shared):
    """Factors of one study, in which two people share the first id, or nobody does."""
    place = Places(preset=preset)
    persons = place.scene(place.study, PEOPLE + 1, seed).persons
    trials = cohort_of_ids(simulate_study(place.study, persons, seed), shared)
    learns = resolved(that_learns(place.study), cohort_from(trials))
    middle, anywhere = log_factors(learns.gp, trials, learns.learnt.model.share)
    return {"shared": shared, "middle": np.round(middle, 3).tolist(), "any": np.round(anywhere, 3).tolist()}


def cohort_of_ids(trials, shared):
    """Trials (24, 32) from those of 25 people (25, 25): the first id has the first 16 of the first and the last person,
    if `shared`."""
    x, q, mask = (np.asarray(each) for each in (trials.x, trials.q, trials.mask))
    width = 2 * HALF - q.shape[1]
    rows = [np.pad(each[:PEOPLE], ((0, 0), (0, width)) + ((0, 0),) * (each.ndim - 2), "edge") for each in (x, q)]
    rows.append(np.pad(mask[:PEOPLE], ((0, 0), (0, width))))
    if shared:
        for row, each in zip(rows, (x, q, mask), strict=True):
            row[0] = np.concatenate([each[0, :HALF], each[PEOPLE, :HALF]])
    return jax.vmap(Trials)(*map(jnp.asarray, rows))


@jax.jit
def log_factors(gp, trials, share):
    """Log Bayes factors (M,), (M,) of two individual functions against one: with the change point in the middle, and
    averaged over change points."""
    posteriors = jax.vmap(lambda person: fit(gp, person, throw=False))(trials)
    people, answers = trials.q.shape
    prior, rows = gp.kernel.variance, jnp.repeat(jnp.arange(people), answers)
    points = trials.x.reshape(-1, trials.x.shape[2])
    mean, variance = merged_without("hierarchical", posteriors, points, rows, prior, share)
    place = jnp.arange(answers)

    def factors(person):
        x, q, mask, mean, variance = person
        correlated = gram(gp.kernel, x, x)
        common, own = with_variances(correlated, variance), (1.0 - share) * correlated

        def log_evidence(change):
            same = (place[:, None] < change) == (place[None, :] < change)
            judged = in_turn(gp.likelihood, mean, common + jnp.where(same, own, 0.0), q, mask, LAPSE)
            return jnp.sum(jnp.where(mask, judged.log_given, 0.0))

        count = jnp.sum(mask)
        each = jax.lax.map(log_evidence, place) - log_evidence(0)
        possible = (place >= FEWEST) & (place <= count - FEWEST)
        averaged = jax.nn.logsumexp(jnp.where(possible, each, -jnp.inf)) - jnp.log(jnp.sum(possible))
        return each[count // 2], averaged

    shape = trials.q.shape
    each = trials.x, trials.q, trials.mask, mean.reshape(shape), variance.reshape(shape)
    return jax.lax.map(factors, each)


def table(rows):
    """Print, for each statistic and limit, the share of studies in which somebody is named falsely, and of shared ids
    that are found."""
    for name in ("middle", "any"):
        alone = np.array([row[name] for row in rows if not row["shared"]])
        both = np.array([row[name] for row in rows if row["shared"]])
        at_most = float(np.quantile(alone.max(axis=1), 1 - FALSE))
        print(f"{name}: the largest factor is above {at_most:.2f} in 5 % of {len(alone)} studies without a shared id")
        for limit in (at_most, 0.5, 1.0, 1.5, 2.0, 3.0):
            false, others = (alone > limit).any(axis=1), (both[:, 1:] > limit).any(axis=1)
            print(
                f"  {limit:.2f}: found {(both[:, 0] > limit).sum()}/{len(both)}, falsely {false.sum()}/{len(alone)},"
                f" others {others.sum()}/{len(both)}"
            )


if __name__ == "__main__":
    main()
