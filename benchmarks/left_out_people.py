"""Cross-validation on real data: log predictive density, and calibration of P(highest response).

    python benchmarks/left_out_people.py FILE DATA [--only orientation speed video touch]
    python benchmarks/left_out_people.py FILE --write

DATA: the folder with orientation_confidence.csv, tactile_speed.csv, video_quality.csv and touch_video.csv. FILE (JSON
Lines) collects a row for each fold; an interrupted run resumes. touch_video has 8 folds, the others one for each
participant. Predictions do not use the participant's own responses. bcm has the kernel, thresholds and noise of
learnt-2. Errors are clustered by participant. --write puts the table into
docs/methods/which_method_tables.md; the rows of all
folds are in benchmarks/left_out_people.jsonl.
"""

import argparse
import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import pandas as pd  # noqa: E402
from pages import put  # noqa: E402
from people import Data, each, orientation, video  # noqa: E402
from rows import Rows  # noqa: E402

from hilbo.numerics.rows import rows_of  # noqa: E402
from hilbo.population.learnt.posterior import Stated  # noqa: E402
from hilbo.population.learnt.rule import learn  # noqa: E402
from hilbo.population.maps import learnt_map  # noqa: E402
from hilbo.population.newcomer import class_probabilities  # noqa: E402
from hilbo.population.pointwise import aggregate  # noqa: E402
from hilbo.population.rules.recipes import LEARNT_2, LEARNT_3  # noqa: E402
from hilbo.study.cohort import cohort_of, read_trials  # noqa: E402
from hilbo.study.config import Study  # noqa: E402

GROUPS = 8
WORDS = {
    "orientation": "orientation confidence, 8 participants",
    "speed": "speed of a moving surface under the finger, 9 participants",
    "video": "video quality, 17 participants",
    "touch": "touch in videos, 1,026 participants",
}
RULES = ("bcm", LEARNT_2.name, LEARNT_3.name)


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("file", type=Path)
    options.add_argument("data", type=Path, nargs="?")
    options.add_argument("--only", nargs="+", choices=WORDS, default=list(WORDS))
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    rows = Rows(chosen.file)
    if chosen.write:
        put("methods/which_method_tables.md", "left out", "\n".join(table(rows.rows)))
        return
    known = {(row["data"], row["fold"]) for row in rows}
    for name in chosen.only:
        data, levels = READ[name](chosen.data)
        folds = len(data.names) if len(data.names) <= 40 else GROUPS
        for fold in range(folds):
            if (name, fold) not in known:
                content = one_fold(data, levels, np.arange(len(data.names)) % folds == fold)
                rows.add({"data": name, "fold": fold} | content)
                print(name, fold, content["gains"], flush=True)


def speed(folder):
    counts = pd.read_csv(folder / "tactile_speed.csv")
    x = np.c_[np.log(counts["speed_cm_s"]), counts["masking_vibration_hz"] / 32.0]
    pairs = counts[["slower", "faster"]].to_numpy(int)
    rows = np.repeat(np.arange(len(counts)), pairs.sum(axis=1))
    q = np.concatenate([np.repeat([0, 1], pair) for pair in pairs])
    return Data(x[rows], x[rows], q, counts["subject"].to_numpy()[rows], 2), ()


def touch(folder):
    study = Study.load(folder / "touch_video.toml")
    trials = cohort_of(read_trials(folder / "touch_video.csv", study), study).trials
    mask = np.asarray(trials.mask)
    who, x = np.repeat(np.arange(len(mask)), mask.sum(axis=1)), np.asarray(trials.x)[mask]
    return Data(x, x, np.asarray(trials.q)[mask], who, len(study.responses)), study.stated.levels


READ = {
    "orientation": lambda folder: (orientation(folder / "orientation_confidence.csv", 2.5), ()),
    "speed": speed,
    "video": lambda folder: (video(folder / "video_quality.csv", 0), ()),
    "touch": touch,
}


def one_fold(data, levels, left):
    """Gains of log evidence by individual factors, and the predictions of `people`.

    `left` (M,): mask of the participants left out.
    """
    test = left[data.who]
    trials = rows_of(data.trials(~test), np.flatnonzero(~left))
    x, place = np.unique(data.x[test], axis=0, return_inverse=True)
    chances, gains = {}, {}
    for recipe in (LEARNT_2, LEARNT_3):
        learnt = learn(trials, data.categories, Stated(levels=levels), recipe)
        moments = learnt_map(learnt, trials).newcomer(jnp.asarray(x))
        chances[recipe.name] = class_probabilities(learnt.model.gp.likelihood, *moments, learnt.scale)
        if recipe is LEARNT_2:
            chances["bcm"] = by_committee(learnt.model.gp, data, left, jnp.asarray(x))
        gains = {name: round(float(gain), 2) for name, gain in learnt.gains.items()}
    gains["about"] = "middle" if learnt.model.fixed_point == 0.0 else "highest threshold"
    return {"gains": gains, "people": people(data, test, {k: np.asarray(p)[place.ravel()] for k, p in chances.items()})}


def by_committee(gp, data, left, x):
    """Class probabilities (m, C) by bcm at points x (m, d), fitted without the participants in the mask `left` (M,)."""
    kept = np.flatnonzero(~left)
    means, explained = jax.vmap(lambda one: one.predict_explained(x))(each(gp, rows_of(data.counts, kept)))
    moments = aggregate("bcm", means, explained, gp.kernel.variance)
    return jax.vmap(gp.likelihood.class_probabilities)(*moments)


def people(data, test, chances):
    """For each participant left out: number of responses, and by method the sum of log densities, and the predicted
    minus the observed number of highest responses.
    """
    q, who = data.q[test], data.who[test]
    content = []
    for person in np.unique(who):
        rows = np.flatnonzero(who == person)
        top = int(np.sum(q[rows] == data.categories - 1))
        by = {
            rule: (np.log(p[rows, q[rows]]).sum().item(), p[rows, -1].sum().item() - top) for rule, p in chances.items()
        }
        content.append({"answers": len(rows), "by": by})
    return content


def table(rows):
    yield "| data | method | log density minus learnt-2's | P(highest), predicted minus observed | evidence |"
    yield "|---|---|---:|---:|---|"
    for name, words in WORDS.items():
        folds = [row for row in rows if row["data"] == name]
        persons = [person for row in folds for person in row["people"]]
        if not persons:
            continue
        counts = np.array([person["answers"] for person in persons])
        for rule in RULES:
            density, gap = np.array([person["by"][rule] for person in persons]).T
            than = density - np.array([person["by"][LEARNT_2.name][0] for person in persons])
            less = "" if rule == LEARNT_2.name else clustered(than, counts, 4)
            evidence = evidence_of(folds) if rule == LEARNT_3.name else ""
            head = words if rule == RULES[0] else ""
            yield f"| {head} | {rule} | {less} | {clustered(gap, counts, 3)} | {evidence} |"


def clustered(sums, counts, digits):
    """Mean of answers from the sums of people, with the error clustered by person."""
    mean, many = sums.sum() / counts.sum(), len(sums)
    error = np.sqrt(many / (many - 1) * np.sum((sums - mean * counts) ** 2)) / counts.sum()
    return f"{mean:+.{digits}f} ± {error:.{digits}f}"


def evidence_of(folds):
    """The least and the largest gain of log evidence by each kind of factor, over folds."""
    gains = [row["gains"] for row in folds]
    words = []
    for name in ("sensitivities", "widths"):
        found = [gain[name] for gain in gains if name in gain]
        if found:
            words.append(f"{name} {min(found):.0f} to {max(found):.0f}")
    pivots = {gain["about"] for gain in gains if gain["sensitivities"] > 0}
    return ", ".join(words) + (f"; about the {' or the '.join(sorted(pivots))}" if pivots else "")


if __name__ == "__main__":
    main()
