"""The population map of a cohort by any aggregation method, as one record that predicts; and the share of the prior
variance that participants have in common.

Methods of `pointwise` combine the individual posteriors point by point. Others use the responses themselves:

- `hierarchical`, where the responses are few enough: the posterior of the shared function g, exact (`shared`); point by
  point otherwise, at the committee machine's cost.
- `pooled`: one function for all participants.
- `learnt-1`, `learnt-2`, `learnt-3`: hierarchical, with hyperparameters that are learnt from the responses as well
  (`learnt`).

The share is learnt by evidence, from evenly spaced participants if there are many, and its posterior mean is used: the
most probable share may be 0 or 1, where nothing, or everything, would be common.
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
from hilbo.population.shared.scale_use import ScaleUse
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
    """The population map by one aggregation method (`rule`): predicts at points of the unit cube.

    `method` is "by points" for a map combined from the stacked individual posteriors `experts`, or "exact" for the
    posterior `shared` of the shared function, from all responses at once; the other one is None. `share`: fraction of
    `prior`, the prior variance of one participant's function, that participants have in common.
    """

    rule: str = eqx.field(static=True)
    method: str = eqx.field(static=True)
    """ "by points" from each participant's posterior, or "exact" from all answers at once."""
    experts: Posterior | None
    """Stacked, one for each person, of a map by points."""
    shared: Posterior | None
    """Of the shared function g, of an exact map."""
    share: Float[Array, ""]
    prior: Float[Array, ""]
    """Prior variance of one person's function."""
    reach: Float[Array, ""] | None = None
    """Of a versioned method the largest variance of the map at a tested stimulus: beyond it no optimum is searched."""
    scale: ScaleUse | None = None
    """How people differ in the use of the scale; None if they do not."""
    centred: bool = eqx.field(static=True, default=False)
    """By a recipe whether the optimum is the centre of where joint draws are largest; see `map_optimum`."""
    effects: ContextEffects | None = None
    """What contexts add, by a recipe and a study with a random effect."""

    def __repr__(self) -> str:
        """One line: aggregation method, "by points" or "exact", and the number of participants of a map by points."""
        people = (
            f", {self.experts.trials.mask.shape[0]} participants"
            if self.experts is not None and has_values(self.experts.trials.mask)
            else ""
        )
        return f"RuleMap({self.rule}, {self.method}{people})"

    def predict(self, x: Float[Array, "m d"]) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
        """Mean and variance (m,) of the map at points (m, d) of the unit cube, without individual differences."""
        if self.method == "exact":
            assert self.shared is not None
            return self.shared.predict(x)
        assert self.experts is not None
        return pointwise.merged(
            self.rule, self.experts, x, self.prior, self.share if RULES[self.rule].learns_share else None
        )

    def astype(self, dtype: DTypeLike) -> "RuleMap":
        """Copy with all floating-point arrays converted to another float dtype."""
        return jax.tree.map(lambda leaf: leaf.astype(dtype) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf, self)

    @property
    def apart(self) -> Float[Array, ""]:
        """Variance of one participant's function about the map, a scalar: (1 - share) times the prior variance, hence 0
        unless the method is hierarchical.

        With a random effect, the variance that an untested context adds is included.
        """
        own = (1.0 - self.share) * self.prior
        return own if self.effects is None else own + self.effects.prior

    @property
    def map_prior(self) -> Float[Array, ""]:
        """Variance of the map far from all tested points, a scalar: the prior variance that participants share; for the
        unweighted average, one participant's prior variance over their number.
        """
        if not RULES[self.rule].weighted:
            return self.prior / jax.tree.leaves(self.experts)[0].shape[0]
        return self.share * self.prior

    def newcomer(
        self, x: Float[Array, "m d"], context: Int[Array, " m"] | None = None
    ) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
        """Mean and variance (m,) of a new participant's function at points (m, d), which predict that participant's
        responses.

        `context` (m,): the contexts as indices from 0; None: new contexts, whose effects are not known. It is ignored
        without a random effect.
        """
        mean, variance = self.predict(x)
        if self.effects is None or context is None:
            return mean, variance + self.apart
        shift, more = self.effects.added(x, context)
        return mean + shift, variance + more + (1.0 - self.share) * self.prior

    def class_probabilities(self, likelihood: OrdinalProbit, x: Float[Array, "m d"]) -> Float[Array, "m C"]:
        """Probabilities (m, C) of a new participant's responses at points (m, d), in new contexts."""
        return class_probabilities(likelihood, *self.newcomer(x), self.scale)


def point_rule(rule: str, share: Float[Array, ""] | None = None) -> tuple[str, Float[Array, ""] | None]:
    """The pointwise method that stands in for `rule` where no map of all responses is fitted, and its share.

    The method is `rule` itself if it is pointwise, "bcm" or "hierarchical" otherwise. The share is None unless that
    method is hierarchical.
    """
    by_points = RULES[rule].pointwise
    return by_points, share if RULES[by_points].learns_share else None


def learnt_map(learnt: Learnt, trials: Trials) -> RuleMap:
    """Exact map from stacked trials (M, n), with the hyperparameters of `learnt`, which are not fitted again.

    `reach` becomes the largest variance of the map at a tested point.
    """
    shared, effects = learnt_function(learnt, trials)
    _, variances = shared.predict(trials.x.reshape(-1, trials.x.shape[-1]))
    reach = jnp.max(jnp.where(trials.mask.reshape(-1), variances, 0.0))
    model = learnt.model
    prior, centred = model.shared + model.own, RULES[learnt.recipe].centred
    return RuleMap(learnt.recipe, "exact", None, shared, model.share, prior, reach, learnt.scale, centred, effects)


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
    """Fit the map by an aggregation method of `GIVEN` from stacked trials (M, n).

    **Arguments:**

    - `posteriors`: the individual ones, stacked, if they exist; else fitted here where they are needed.
    - `share`: of the hierarchical method, else learnt by `share_of`.
    - `largest`: exact models are used up to so many latent values; beyond it, and with exact inference, the
      hierarchical method combines point by point.

    Raises `InputError` for a method that is not in `GIVEN`, without responses, for a share that cannot be learnt, and
    for "pooled" with more latent values than `largest`.
    """
    if rule not in GIVEN:
        raise InputError(f'rule_map: the rule is "{rule}"; it must be one of {", ".join(GIVEN)}.')
    if not np.asarray(trials.mask).any():
        raise InputError("rule_map: there are no responses; at least one participant's are needed.")
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
    """Posterior of the share of the prior variance that participants have in common, from stacked trials (M, n).

    With more than `largest` responses, only evenly spaced participants are used. Exact inference is replaced by
    expectation propagation. Raises `InputError` if fewer than two participants gave a response.
    """
    answered = np.flatnonzero(np.asarray(trials.mask).any(axis=1))
    if len(answered) < 2:
        raise InputError(
            'The rule "hierarchical" estimates individual differences, and responses are from'
            f' {len(answered)} participant; use "bcm", whose map is then the individual map.'
        )
    few = rows_of(trials, answered[even_rows(rows_of(trials, answered), largest)])
    return learn_share(gp, few, "ep" if inference == "exact" else inference)


def even_rows(trials: Trials, largest: int) -> Int[np.ndarray, " k"]:
    """Rows of evenly spaced participants of stacked trials (M, n), in order, so many that on average they gave at most
    `largest` responses; at least two rows, and all of them if there are not more responses.
    """
    answers = int(np.asarray(trials.mask).sum())
    people = trials.mask.shape[0]
    count = people if answers <= largest else max(2, int(people * largest / answers))
    return np.unique(np.linspace(0, people - 1, count).round().astype(int))


def _experts(gp: OrdinalGP, trials: Trials, inference: str) -> Posterior:
    """The individual posteriors, stacked, converged or not; with Laplace's method and many repeated points, from counts
    of responses at each distinct point.
    """
    if inference == "laplace":
        answers = tallied(trials, gp.likelihood.categories)
        if 2 * answers.x.shape[1] < trials.mask.shape[1]:
            return _fit_people_from_counts(gp, answers)
    return _fit_people_from_trials(gp, trials, inference)


@program
def _fit_people_from_counts(gp: OrdinalGP, answers: Tallies) -> Posterior:
    """Laplace posterior of each participant, stacked, from counts of responses at each point; one after the other."""
    return jax.lax.map(lambda person: fit_counts(gp, *person), (answers.x, answers.counts))


@program
def _fit_people_from_trials(gp: OrdinalGP, trials: Trials, inference: str) -> Posterior:
    """Posterior of each participant, stacked, from trials (M, n), converged or not."""
    return jax.vmap(lambda person: fit(gp, person, inference=inference, throw=False))(trials)


def _shared_function(
    gp: OrdinalGP, trials: Trials, share: Float[Array, ""], inference: str, largest: int
) -> Posterior | None:
    """Posterior of the shared function from all responses at once, converged or not; `share`: a scalar.

    None if that costs more than a fit of `largest` latent values, and with exact inference.
    """
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
    return _shared_of_people(gp, of_people(trials), share, inference)


@program
def _shared_of_people(gp: OrdinalGP, people: Trials, share: Float[Array, ""], inference: str) -> Posterior:
    """Posterior of the shared function from the trials of `of_people`, converged or not."""
    return shared_posterior(fit_people(gp, people, share, inference=inference, throw=False))


def _pooled(gp: OrdinalGP, trials: Trials, inference: str, largest: int) -> Posterior | None:
    """Posterior of one function from all responses, as if of one participant, converged or not; None if it has more
    than `largest` latent values.
    """
    mask = np.asarray(trials.mask)
    everybody = Trials.from_arrays(np.asarray(trials.x)[mask], np.asarray(trials.q)[mask])
    if inference != "laplace":
        return None if mask.sum() > largest else fit(gp, everybody, inference=inference, throw=False)
    answers = tallied(jax.tree.map(lambda leaf: leaf[None], everybody), gp.likelihood.categories)
    return None if answers.x.shape[1] > largest else fit_counts(gp, answers.x[0], answers.counts[0])
