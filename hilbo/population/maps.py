"""A cohort's population map by any rule, as one record that predicts; and what the answers say of how people differ.

Rules of `pointwise` aggregate everybody's own posterior point by point. Two rules look at the answers themselves:

* `hierarchical`, where the answers are few enough: the posterior of the shared function g, exact (`shared`); point by
  point otherwise, at the committee's cost.
* `pooled`: one function for all.
* `learnt-1`, `learnt-2`: hierarchical, with hyperparameters that are learnt from the answers as well (`learnt`).

The share that people have in common is learnt by evidence, from an even choice of people if there are many, and its
posterior mean is used: the most probable share may be 0 or 1, where nothing, or everything, would be common.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int

from hilbo.errors import InputError
from hilbo.likelihoods import OrdinalProbit
from hilbo.numerics.host import to_device
from hilbo.numerics.rows import rows_of
from hilbo.numerics.shown import has_values
from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import OrdinalGP, Posterior, Trials, fit
from hilbo.population import pointwise
from hilbo.population.learnt.rule import Learnt, learnt_function
from hilbo.population.newcomer import class_probabilities
from hilbo.population.rules.registry import GIVEN, RULES
from hilbo.population.shared.features import every_point
from hilbo.population.shared.hierarchical import Share, few_points, fit_people, learn_share, of_people, shared_posterior
from hilbo.population.shared.people_model import PeopleModel
from hilbo.population.shared.posterior import ContextEffects, shared_function
from hilbo.population.shared.tallies import Tallies, fit_counts, tallied

__all__ = [
    "LARGEST_EXACT",
    "RuleMap",
    "even_rows",
    "learnt_map",
    "point_rule",
    "rule_map",
    "share_of",
]

LARGEST_EXACT = 1500
"""Answers, or latent values, up to which the exact models are used: they are cubic in their number."""
_SHARE = 600  # answers from which the share is learnt


class RuleMap(eqx.Module):
    """The population map by one rule: predicts at points of the unit cube."""

    rule: str = eqx.field(static=True)
    method: str = eqx.field(static=True)
    """ "by points" from everybody's posterior, or "exact" from all answers at once."""
    experts: Posterior | None
    """Stacked, one for each person, of a map by points."""
    shared: Posterior | None
    """Of the shared function g, of an exact map."""
    share: Float[Array, ""]
    prior: Float[Array, ""]
    """Prior variance of one person's function."""
    reach: Float[Array, ""] | None = None
    """By a recipe the largest variance of the map where somebody answered: beyond it no optimum is sought."""
    widths: bool = eqx.field(static=True, default=False)
    """Whether people differ in the widths of their middle categories."""
    centred: bool = eqx.field(static=True, default=False)
    """By a recipe whether the optimum is the centre of where joint draws are largest; see `map_optimum`."""
    effects: ContextEffects | None = None
    """What contexts add, by a recipe and a study with a random effect."""

    def __repr__(self) -> str:
        people = (
            f", {self.experts.trials.mask.shape[0]} participants"
            if self.experts is not None and has_values(self.experts.trials.mask)
            else ""
        )
        return f"RuleMap({self.rule}, {self.method}{people})"

    def predict(self, x: Float[Array, "m d"]) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
        """Mean and variance (m,) of the map at points (m, d)."""
        if self.method == "exact":
            assert self.shared is not None
            return self.shared.predict(x)
        assert self.experts is not None
        return pointwise.merged(
            self.rule, self.experts, x, self.prior, self.share if RULES[self.rule].learns_share else None
        )

    def astype(self, dtype: DTypeLike) -> "RuleMap":
        """The same map that predicts in another precision."""
        return jax.tree.map(lambda leaf: leaf.astype(dtype) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf, self)

    @property
    def apart(self) -> Float[Array, ""]:
        """Variance of one person's function about the map's: only the hierarchical model says that people differ; in a
        context that nobody was asked in, if there is a random effect."""
        own = (1.0 - self.share) * self.prior
        return own if self.effects is None else own + self.effects.prior

    @property
    def map_prior(self) -> Float[Array, ""]:
        """Variance of the map where nobody answered, against which its own tells what the answers say."""
        if not RULES[self.rule].weighted:
            return self.prior / jax.tree.leaves(self.experts)[0].shape[0]
        return self.share * self.prior

    def newcomer(
        self, x: Float[Array, "m d"], context: Int[Array, " m"] | None = None
    ) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
        """Mean and variance (m,) of a new person's function, from which answers are predicted; in these contexts, or in
        new ones."""
        mean, variance = self.predict(x)
        if self.effects is None or context is None:
            return mean, variance + self.apart
        shift, more = self.effects.added(x, context)
        return mean + shift, variance + more + (1.0 - self.share) * self.prior

    def class_probabilities(self, likelihood: OrdinalProbit, x: Float[Array, "m d"]) -> Float[Array, "m C"]:
        """Probabilities (m, C) of a new person's answers at points (m, d)."""
        return class_probabilities(likelihood, *self.newcomer(x), self.widths)


def point_rule(rule: str, share: Float[Array, ""] | None = None) -> tuple[str, Float[Array, ""] | None]:
    """By which rule, and with which share, everybody's posteriors are aggregated point by point in place of a map: by
    the same rule, or by bcm where the rule takes all answers at once; a recipe is the hierarchical one."""
    by_points = RULES[rule].pointwise
    return by_points, share if RULES[by_points].learns_share else None


def learnt_map(learnt: Learnt, trials: Trials) -> RuleMap:
    """The map by learnt hyperparameters, from stacked trials (M, n)."""
    shared, effects = learnt_function(learnt, trials)
    _, variances = shared.predict(trials.x.reshape(-1, trials.x.shape[-1]))
    reach = jnp.max(jnp.where(trials.mask.reshape(-1), variances, 0.0))
    model = learnt.model
    prior, centred = model.shared + model.own, RULES[learnt.recipe].centred
    return RuleMap(learnt.recipe, "exact", None, shared, model.share, prior, reach, learnt.widths, centred, effects)


def rule_map(
    gp: OrdinalGP,
    trials: Trials,
    rule: str,
    *,
    posteriors: Posterior | None = None,
    share: Float[Array, ""] | None = None,
    inference: str = "laplace",
    largest: int = LARGEST_EXACT,
) -> RuleMap:
    """The map by a rule of `GIVEN` from stacked trials (M, n).

    **Arguments:** `posteriors`: everybody's own, if they are there; `share`: of the hierarchical rule, else learnt by
    `share_of`; `largest`: exact models are used up to so many latent values. Raises InputError for what a rule cannot
    do with these answers.
    """
    if rule not in GIVEN:
        raise InputError(f'rule_map: the rule is "{rule}"; it must be one of {", ".join(GIVEN)}.')
    if not np.asarray(trials.mask).any():
        raise InputError("rule_map: nobody gave an answer; at least one person's answers are needed.")
    prior = jnp.asarray(gp.kernel.variance)
    one = to_device(1.0, prior.dtype)
    if RULES[rule].learns_share:
        map_share = jnp.asarray(share_of(gp, trials, inference).mean if share is None else share, prior.dtype)
        shared = _shared_function(gp, trials, map_share, inference, largest)
        if shared is not None:
            return RuleMap(rule, "exact", None, shared, map_share, prior)
    else:
        map_share, shared = one, None
    if RULES[rule].exact_only:
        shared = _pooled(gp, trials, inference, largest)
        if shared is None:
            answers, people = int(np.asarray(trials.mask).sum()), trials.mask.shape[0]
            raise InputError(
                f'The rule "{rule}" fits one model to all answers at once, and {answers:,} of {people:,} people are too'
                ' many; use "bcm", "hierarchical" or another rule that aggregates people point by point.'
            )
        return RuleMap(rule, "exact", None, shared, one, prior)
    if posteriors is None:
        posteriors = _experts(gp, trials, inference)
    return RuleMap(rule, "by points", posteriors, None, map_share, prior)


def share_of(gp: OrdinalGP, trials: Trials, inference: str = "laplace", largest: int = _SHARE) -> Share:
    """The posterior of the share that people have in common; from an even choice of people where there are many."""
    answered = np.flatnonzero(np.asarray(trials.mask).any(axis=1))
    if len(answered) < 2:
        raise InputError(
            'The rule "hierarchical" learns how people differ, and only'
            f' {len(answered)} of them gave an answer; use "bcm", whose map is then that person\'s.'
        )
    few = rows_of(trials, answered[even_rows(rows_of(trials, answered), largest)])
    return learn_share(gp, few, "ep" if inference == "exact" else inference)


def even_rows(trials: Trials, largest: int) -> Int[np.ndarray, " k"]:
    """Places of all people, or of so many of them, evenly chosen and at least two, that their answers are not more."""
    answers = int(np.asarray(trials.mask).sum())
    people = trials.mask.shape[0]
    count = people if answers <= largest else max(2, int(people * largest / answers))
    return np.unique(np.linspace(0, people - 1, count).round().astype(int))


def _experts(gp: OrdinalGP, trials: Trials, inference: str) -> Posterior:
    """Everybody's own posterior, stacked; from counts where many answers are at the same points."""
    if inference == "laplace":
        answers = tallied(trials, gp.likelihood.categories)
        if 2 * answers.x.shape[1] < trials.mask.shape[1]:
            return _fit_people_from_counts(gp, answers)
    return _fit_people_from_trials(gp, trials, inference)


@program
def _fit_people_from_counts(gp: OrdinalGP, answers: Tallies) -> Posterior:
    return jax.lax.map(lambda person: fit_counts(gp, *person), (answers.x, answers.counts))


@program
def _fit_people_from_trials(gp: OrdinalGP, trials: Trials, inference: str) -> Posterior:
    return jax.vmap(lambda person: fit(gp, person, inference=inference, throw=False))(trials)


def _shared_function(
    gp: OrdinalGP, trials: Trials, share: Float[Array, ""], inference: str, largest: int
) -> Posterior | None:
    """The shared function's posterior from all answers at once; None if they are too many."""
    mask = np.asarray(trials.mask)
    if inference == "laplace" and few_points(trials):
        people, points = int(mask.any(axis=1).sum()), len(np.unique(np.asarray(trials.x)[mask], axis=0))
        if people * points**3 > largest**3:
            return None
        answers = tallied(trials, gp.likelihood.categories)
        model = PeopleModel.of(gp, share, len(mask))
        return shared_function(model, answers, answers.blank, every_point(model.unit, answers)).function
    if inference == "exact" or mask.sum() > largest:
        return None
    return shared_posterior(fit_people(gp, of_people(trials), share, inference=inference, throw=False))


def _pooled(gp: OrdinalGP, trials: Trials, inference: str, largest: int) -> Posterior | None:
    """One GP on everybody's answers, as if from one person; None if they are too many."""
    mask = np.asarray(trials.mask)
    everybody = Trials.from_arrays(np.asarray(trials.x)[mask], np.asarray(trials.q)[mask])
    if inference != "laplace":
        return None if mask.sum() > largest else fit(gp, everybody, inference=inference, throw=False)
    answers = tallied(jax.tree.map(lambda leaf: leaf[None], everybody), gp.likelihood.categories)
    return None if answers.x.shape[1] > largest else fit_counts(gp, answers.x[0], answers.counts[0])
