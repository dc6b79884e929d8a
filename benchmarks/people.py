"""Real people, each left out in turn: how well does every aggregation rule predict a person whom it has not seen?

    python benchmarks/people.py video FILE [--write]          video_quality.csv
    python benchmarks/people.py orientation FILE [--write]    orientation_confidence.csv (Adler & Ma 2018)

Video quality: 17 people, 1,190 answers in 5 categories, at 23 stimuli (log bitrate, log height), reference clips left
out. Orientation confidence: 8 people, 12,636 answers in 8 categories (orientation, log contrast); for *fitting*,
orientations are rounded to cells of --cell degrees (at most 20 degrees), answers in one cell being counts at its
middle; the held-out answers are predicted where they were given. No answer is left out and nothing is drawn at random
but the randomised probability integral transform (seed 0).

Of the clips, learnt-2 also learns a random effect: people who are left out are then predicted in the clips that others
saw; a line after the table gives the prediction of responses to an unseen clip.

Hyperparameters maximise the evidence of the hierarchical model on the training people of each fold, noise 1 (the scale
of f is free), and serve every rule but learnt-1, which learns its own there. Beside the rules stand the training
people's frequencies of the categories, and an ordinal probit that is quadratic in the two standardised parameters.
Errors are clustered by person. --write puts the table into docs/methods/aggregation.md.
"""

import argparse
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from scipy.stats import norm

jax.config.update("jax_enable_x64", True)

from pages import put  # noqa: E402
from people_evidence import learn_people  # noqa: E402

from hilbo.ordinal_gp import RBF, OrdinalGP, OrdinalProbit, Trials  # noqa: E402
from hilbo.population.judged.baselines import constant, quadratic  # noqa: E402
from hilbo.population.judged.leave_one_out import clustered, integral_transform  # noqa: E402
from hilbo.population.learnt.rule import learn  # noqa: E402
from hilbo.population.maps import learnt_map  # noqa: E402
from hilbo.population.newcomer import class_probabilities  # noqa: E402
from hilbo.population.pointwise import aggregate  # noqa: E402
from hilbo.population.rules.recipes import LEARNT_1, LEARNT_2  # noqa: E402
from hilbo.population.rules.registry import POINTWISE, RECIPES  # noqa: E402
from hilbo.population.shared.features import pivots_of  # noqa: E402
from hilbo.population.shared.people_model import PeopleModel  # noqa: E402
from hilbo.population.shared.posterior import shared_function  # noqa: E402
from hilbo.population.shared.tallies import Tallies, fit_counts  # noqa: E402

ROOT = Path(__file__).parents[1]
WORDS = {
    "hierarchical, exact": "hierarchical, exact",
    "hierarchical": "hierarchical, by points",
    "pooled": "pooled: one function for all",
    "probit": "*quadratic ordinal probit*",
    "marginal": "*frequencies of the categories*",
}
EFFECT = "learnt-2, clips a random effect"


class Data:
    """Answers q of persons `who` at points x, and the points `cell` at which they count for a fit; all in [0, 1]."""

    def __init__(self, x, cell, q, who, categories, context=None):
        low, high = x.min(axis=0), x.max(axis=0)
        self.x, self.q, self.categories = (x - low) / (high - low), q, categories
        self.names, self.who = np.unique(who, return_inverse=True)
        self.points, self.place = np.unique((cell - low) / (high - low), axis=0, return_inverse=True)
        self.place = self.place.reshape(-1)
        counts = np.zeros((len(self.names), len(self.points), categories))
        np.add.at(counts, (self.who, self.place, q), 1.0)
        x = np.broadcast_to(self.points, (len(self.names), *self.points.shape))
        self.counts = Tallies(jnp.asarray(x), jnp.asarray(counts))
        self.context = None if context is None else np.unique(context, return_inverse=True)[1]

    def trials(self, given, effect=False):
        """Stacked answers of everybody as far as they are `given` (n,), at the points at which they count."""
        each = [np.flatnonzero(self.who == person) for person in range(len(self.names))]
        rows = np.stack([np.resize(own, max(map(len, each))) for own in each])
        mask = given[rows] & (np.arange(rows.shape[1])[None, :] < np.array(list(map(len, each)))[:, None])
        context = jnp.asarray(self.context[rows]) if effect else None
        return jax.vmap(Trials)(jnp.asarray(self.points[self.place[rows]]), jnp.asarray(self.q[rows]), mask, context)


def video(path, _):
    table = pd.read_csv(path)
    table = table[table["is_reference"] == 0]
    x = np.log(table[["bitrate_kbps", "height_px"]].to_numpy(float))
    return Data(x, x, table["rating"].to_numpy() - 1, table["observer"].to_numpy(), 5, table["content"].to_numpy())


def orientation(path, cell):
    table = pd.read_csv(path)
    contrast = np.log(table["contrast"].to_numpy())
    angle = table["orientation_deg"].clip(-20, 20).to_numpy()
    x, middle = (np.c_[a, contrast] for a in (angle, np.round(angle / cell) * cell))
    return Data(x, middle, table["response8"].to_numpy() - 1, table["subject"].to_numpy(), 8)


def start(data):
    """Thresholds where the categories' frequencies put them."""
    share = np.asarray(data.counts.counts.sum(axis=(0, 1))) + 0.5
    thresholds = 2.0 * norm.ppf(np.cumsum(share)[:-1] / share.sum())
    return OrdinalGP(RBF((1.0, 1.0), 3.0), OrdinalProbit(thresholds, 1.0))


@jax.jit
def each(gp, counts):
    """Everybody's own posterior, stacked."""
    return jax.lax.map(lambda person: fit_counts(gp, *person), (counts.x, counts.counts))


@jax.jit
def predicted(gp, share, counts, common, mask, x):
    """Rule -> class probabilities (n, C) of a new person at x; `mask`: who is known."""
    prior = gp.kernel.variance
    experts = each(gp, counts)
    means, explained = jax.vmap(lambda p: p.predict_explained(x))(experts)
    maps = {}
    for rule in POINTWISE:
        part = share if rule == "hierarchical" else None
        maps[rule] = aggregate(rule, means, explained, prior, share=part, mask=mask)
    maps["hierarchical"] = maps["hierarchical"][0], maps["hierarchical"][1] + (1 - share) * prior
    model = PeopleModel.of(gp, share, len(counts.x))
    pivots = pivots_of(model.unit, counts, counts.x.shape[1], 1e-14)
    mean, variance = shared_function(model, counts, counts.blank, pivots).function.predict(x)
    maps["hierarchical, exact"] = mean, variance + (1 - share) * prior
    maps["pooled"] = fit_counts(gp, counts.x[0], jnp.sum(counts.counts, axis=0)).predict(x)
    return {rule: jax.vmap(gp.likelihood.class_probabilities)(*moments) for rule, moments in maps.items()}


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("data", choices=["video", "orientation"])
    options.add_argument("file", type=Path)
    options.add_argument("--cell", type=float, default=2.5, help="degrees, of the orientations' cells")
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    data = (video if chosen.data == "video" else orientation)(chosen.file, chosen.cell)
    begun = time.perf_counter()
    everybody = learn_people(start(data), data.counts, max_steps=60)
    print(describe(everybody), flush=True)
    chances, shares, wide = {}, [], []
    for left in range(len(data.names)):
        mask = np.arange(len(data.names)) != left
        kept = jnp.asarray(mask[:, None, None] * 1.0)
        counts = Tallies(data.counts.x, data.counts.counts * kept)  # all shapes stay: one compilation
        learnt = learn_people(everybody.gp, counts, float(everybody.share), max_steps=40)
        shares.append(float(learnt.share))
        test = data.who == left
        longest = np.bincount(data.who).max()
        rows = np.resize(np.flatnonzero(test), longest)  # padded, for one compilation
        x = jnp.asarray(data.x[rows])
        by_rule = predicted(learnt.gp, learnt.share, counts, None, jnp.asarray(mask), x)
        by_rule = {rule: np.asarray(p)[: test.sum()] for rule, p in by_rule.items()}
        by_recipe = {name: by(recipe, data, test) for name, recipe in RECIPES.items()}
        if data.context is not None:
            by_recipe[EFFECT] = by(LEARNT_2, data, test, effect=True)
        by_rule |= {name: chance for name, (chance, _) in by_recipe.items()}
        wide.append(by_recipe[LEARNT_1.name][1])
        by_rule["probit"] = quadratic(data.x, data.q, data.categories, ~test)[test]
        by_rule["marginal"] = constant(data.q, data.categories, ~test)[test]
        for rule, p in by_rule.items():
            chances.setdefault(rule, np.zeros((len(data.q), data.categories)))[test] = p
        print(data.names[left], f"{time.perf_counter() - begun:.0f} s, share {shares[-1]:.3f}", flush=True)
    text = table(chosen, data, chances, everybody, shares, wide)
    if data.context is not None:
        text += of_new_contexts(data)
    print(text)
    if chosen.write:
        put("methods/aggregation.md", chosen.data, text)


def by(recipe, data, test, effect=False):
    """Class probabilities (n, C) of the answers `test` from all others, and whether people have widths of their own."""
    trials = data.trials(~test, effect)
    learnt = learn(trials, data.categories, recipe=recipe)
    if not bool(learnt.converged):
        print(f"{recipe.name}: the search did not end well", flush=True)
    context = jnp.asarray(data.context[test]) if effect else None
    mean, variance = learnt_map(learnt, trials).newcomer(jnp.asarray(data.x[test]), context)
    chances = class_probabilities(learnt.model.gp.likelihood, mean, variance, learnt.scale)
    return np.asarray(chances), learnt.scale is not None


def of_new_contexts(data):
    """Two sentences: answers to each clip, predicted from those to the others, without and with the random effect."""
    cost, inside = [], []
    for effect in (False, True):
        chances = np.zeros((len(data.q), data.categories))
        for context in np.unique(data.context):
            test = data.context == context
            chances[test] = by(LEARNT_2, data, test, effect)[0]
        cost.append(-np.log(chances[np.arange(len(data.q)), data.q]))
        u = integral_transform(chances, data.q, 0)
        inside.append(clustered(((u > 0.025) & (u < 0.975)).astype(float), data.context))
    gain, error = clustered(cost[0] - cost[1], data.context)
    (less, less_error), (more, more_error) = inside
    return (
        f"\nResponses to an unseen clip cost {cost[0].mean():.3f} nats without and {cost[1].mean():.3f} with the"
        f" random effect (gain {gain:+.3f} ± {error:.3f}, errors by clip); {100 * less:.1f} ± {100 * less_error:.1f} %"
        f" and {100 * more:.1f} ± {100 * more_error:.1f} % of them lie within the central 95 %.\n"
    )


def describe(learnt):
    gp = learnt.gp
    theta, edges = (", ".join(f"{v:.2f}" for v in part) for part in (gp.kernel.theta, gp.likelihood.thresholds))
    return (
        f"Fitted to all participants: theta {theta}, variance {float(gp.kernel.variance):.2f}, thresholds {edges}"
        f" (noise 1), share {float(learnt.share):.3f}; log evidence {float(learnt.log_evidence):.1f}."
    )


def table(chosen, data, chances, everybody, shares, wide):
    n = np.arange(len(data.q))
    cost = {rule: -np.log(p[n, data.q]) for rule, p in chances.items()}
    order = sorted(cost, key=lambda rule: cost[rule].mean())
    lines = [
        f"Made by `python benchmarks/people.py {chosen.data} FILE --write`: {len(data.names)} participants,"
        f" {len(data.q):,} responses, {len(data.points)} points.",
        describe(everybody),
        f"Over the folds the share was between {min(shares):.3f} and {max(shares):.3f}; learnt-1 used individual"
        f" widths in {sum(wide)} of {len(wide)}.",
        "",
        "| method | mean negative log density | gain over the probit | within the central 95 % |",
        "|---|---:|---:|---:|",
    ]
    for rule in order:
        mean, error = clustered(cost[rule], data.who)
        gain, gain_error = clustered(cost["probit"] - cost[rule], data.who)
        u = integral_transform(chances[rule], data.q, 0)
        inside, inside_error = clustered(((u > 0.025) & (u < 0.975)).astype(float), data.who)
        difference = "" if rule == "probit" else f"{gain:+.3f} ± {gain_error:.3f}"
        lines.append(
            f"| {WORDS.get(rule, rule)} | {mean:.3f} ± {error:.3f} | {difference} |"
            f" {100 * inside:.1f} ± {100 * inside_error:.1f} % |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
