"""A cohort's posteriors, its population map by the study's aggregation method, and the optima of both, as one record.

    table     = read_trials("trials.csv", study)
    cohort    = cohort_of(table, study)
    aggregate = aggregate_cohort(study, cohort)

Participants are fitted in compiled batches over trials padded to one capacity. The population map is a committee
machine over their posteriors (`hilbo.bcm`), or that of another method (`hilbo.population.maps`). Cohorts of any size
are computed in this way, on all devices of JAX's current mesh (`hilbo.numerics.sharding`): above `MANY` participants in
batches of that many, and without results that need another fit of every participant.
"""

import contextlib
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from hilbo.errors import InputError
from hilbo.likelihoods import OrdinalProbit
from hilbo.numerics.host import to_device
from hilbo.numerics.sharding import devices, of_each_person
from hilbo.numerics.shown import has_values
from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import OrdinalGP, Posterior, Trials, fit
from hilbo.population.maps import LARGEST_EXACT, RuleMap, learnt_map, rule_map, share_of
from hilbo.population.newcomer import class_probabilities
from hilbo.population.rules.registry import GIVEN, RULES
from hilbo.population.shared.hierarchical import Share
from hilbo.search.apart import middle_of
from hilbo.search.candidates import search_points
from hilbo.study.cohort import Cohort
from hilbo.study.config import Inference, Study
from hilbo.study.estimate.learnt import resolved
from hilbo.study.estimate.optimum import Optimum, individual_optima, map_optimum, predict_map

__all__ = [
    "MANY",
    "Aggregate",
    "First",
    "SayCount",
    "aggregate_cohort",
    "asked_variance",
    "fit_cohort",
    "other_inference",
    "silent",
]

MANY = 1000
"""Participants per batch; for a larger cohort, results that need another fit of every participant are left out."""
_LARGEST_POOL = 3000  # answers of the pooled alternative: its fit is cubic in their number


_People = TypeVar("_People", bound=PyTree)
_Result = TypeVar("_Result", bound=PyTree)

First = Callable[[Optimum, RuleMap], None]

SayCount = Callable[[str, int, int], None]
"""Progress report: description, number of participants done, number of all."""


def silent(words: str, done: int, people: int) -> None:
    """Ignore a progress report."""
    del words, done, people


class Surface(eqx.Module):
    """A population map as a callable function of points."""

    map: RuleMap

    def __call__(self, x: Float[ArrayLike, "m d"]) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
        """Mean and variance (m,) of the map at points of the unit cube."""
        return predict_map(self.map, to_device(x))


class Newcomer(eqx.Module):
    """A new participant's latent function as a callable function of points."""

    map: RuleMap

    def __call__(self, x: Float[ArrayLike, "m d"]) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
        """Mean and variance (m,) of the function at points of the unit cube. By hierarchical methods the variance
        exceeds that of the map, which is the function that participants share."""
        mean, variance = predict_map(self.map, to_device(x))
        return mean, variance + self.map.apart


class Aggregate(eqx.Module):
    """A study's posteriors, its population optimum by the study's method, and alternatives to compare with."""

    cohort: Cohort
    posteriors: Posterior
    optimum: Optimum
    own: Optimum | None
    """Individual optima, stacked; None if they were not computed."""
    alternatives: dict[str, Optimum]
    """Method or inference -> optimum: of the plain average of the latent functions, of one GP on all responses (if not
    too many), of the hierarchical method and bcm unless the study's own, and of the study's method with another
    inference ("ep", or "laplace" if the study's own is "ep")."""
    map: RuleMap
    """The population map by the study's method."""
    maps: dict[str, RuleMap]
    """Maps of all requested methods, the study's included, and that with the other inference."""
    share: Share | None
    """Estimated shared variance fraction; None if it was not needed, or with fewer than two participants with
    responses."""

    def __repr__(self) -> str:
        """One line with cohort, map and optimum; the field structure while JAX traces."""
        if not has_values(self.optimum.x):
            return eqx.tree_pformat(self)
        return f"Aggregate({self.cohort!r}; {self.map!r}; {self.optimum!r})"

    @property
    def likelihood(self) -> OrdinalProbit:
        """The likelihood with which the posteriors were fitted: the study's, or the learnt one."""
        return jax.tree.map(lambda leaf: leaf[0], self.posteriors.gp).likelihood

    @property
    def hierarchical(self) -> RuleMap | None:
        """The map by the method "hierarchical"; None if it was not computed."""
        return self.maps.get("hierarchical")

    @property
    def certificates(self) -> dict[str, np.ndarray]:
        """Convergence diagnostics of all participants' fits: name -> (M,)."""
        certificate = self.posteriors.certificate
        return {name: np.asarray(getattr(certificate, name)) for name in certificate.__dataclass_fields__}

    @property
    def individuals(self) -> Optimum:
        """Optimum of each participant, stacked (M). Raises `InputError` if they were not computed."""
        if self.own is None:
            raise InputError("Aggregate: individual optima were not computed; aggregate with individuals=True.")
        return self.own

    @property
    def asked_variance(self) -> Float[Array, ""] | None:
        """Largest variance of the map at a tested stimulus, a scalar; None if not known, as in the function
        `asked_variance`."""
        return asked_variance(self.map, self.cohort)

    @property
    def surface(self) -> Surface:
        """The population map as a function, which may be passed to compiled programs: it does not contain the
        participants' ids."""
        return Surface(self.map)

    def class_probabilities(self, likelihood: OrdinalProbit, x: Float[ArrayLike, "m d"]) -> Float[Array, "m C"]:
        """Probabilities (m, C) of a new participant's responses at points of the unit cube."""
        return class_probabilities(likelihood, *self.newcomer(x), self.map.scale)

    @property
    def newcomer(self) -> Newcomer:
        """A new participant's latent function, which may be passed to compiled programs, as `surface`."""
        return Newcomer(self.map)

    @property
    def mean_of_optima(self) -> Float[Array, " d"]:
        """Mean (d,) of the individual optima in the unit cube, for levels the most frequent one; the paper compares the
        map with it. Raises `InputError` if they were not computed."""
        return to_device(middle_of(self.posteriors.gp.kernel.levels, np.asarray(self.individuals.x)))


def fit_cohort(study: Study, cohort: Cohort, inference: Inference | None = None) -> Posterior:
    """Posterior of each participant, stacked (M). `inference`: instead of the study's. Fits that fail do not raise; see
    their certificates."""
    return _fitted(study, cohort, inference, silent)


def _fitted(study: Study, cohort: Cohort, inference: Inference | None, say: SayCount) -> Posterior:
    """Posterior of each participant, stacked (M), fitted in batches. None for `inference`: the study's. `say` is called
    after each batch if there are several."""
    by = study.inference if inference is None else inference
    return _in_batches(lambda trials: _fit_cohort(study.gp, trials, by), cohort.trials, "participants fitted", say)


# Programs take what they use: two studies that differ in their words share them.
@program
def _fit_cohort(gp: OrdinalGP, trials: Trials, inference: Inference) -> Posterior:
    """Compiled fit of all participants with one model."""

    def each(trials, gp):
        return jax.vmap(lambda t: fit(gp, t, inference=inference, throw=False))(trials)

    return of_each_person(each, trials, gp)


def _in_batches(function: Callable[[_People], _Result], people: _People, words: str, say: SayCount) -> _Result:
    """Apply a function to stacked participants in batches of at most `MANY`, to bound memory, and join the results.

    All batches have one size and so one compiled program: the last is padded with copies of the last participant, which
    are removed again. `say` is called with `words` after each batch if there are several.
    """
    count = jax.tree.leaves(people)[0].shape[0]
    if count <= MANY:
        return function(people)
    parts = []
    for first in range(0, count, MANY):
        rows = np.minimum(np.arange(first, first + MANY), count - 1)
        part = function(jax.tree.map(lambda leaf, rows=rows: leaf[rows], people))
        parts.append(jax.tree.map(lambda leaf, most=count - first: leaf[:most], part))
        say(words, min(first + MANY, count), count)
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


def other_inference(study: Study) -> Inference:
    """The inference with which a study's results are compared: "ep", or "laplace" if the study's own is "ep"."""
    return "laplace" if study.inference == "ep" else "ep"


def aggregate_cohort(
    study: Study,
    cohort: Cohort,
    seed: int = 0,
    alternatives: bool = True,
    first: First = lambda optimum, map_: None,
    *,
    individuals: bool = True,
    say: SayCount = silent,
) -> Aggregate:
    """Fit all participants, aggregate, and find the optima; the study's `rule` determines the population optimum.

    `seed` determines the candidates from which optima are searched. A method that learns the hyperparameters does so
    first unless the study is resolved. `first` is called with the optimum and its map as soon as they are known.
    `individuals`: compute each participant's optimum. `alternatives`: compute optima by other methods and another
    inference. `say` receives the progress above `MANY` participants. Fits that fail do not raise: see
    `posteriors.certificate`. Raises `InputError` if `cohort` is not a Cohort.
    """
    if not isinstance(cohort, Cohort):
        raise InputError(
            f"aggregate_cohort: cohort is a {type(cohort).__name__}; hilbo.study.cohort.cohort_of(table, study) makes"
            " one of a table."
        )
    study = resolved(study, cohort)
    candidates = search_points(study.space, seed)
    posteriors = _fitted(study, cohort, None, say)
    share = share_of(study.gp, cohort.trials, study.inference) if RULES[study.rule].learns_share else None
    map_ = _rule_map(study, cohort, study.rule, posteriors, share)
    optimum = map_optimum(study, map_, candidates)
    first(optimum, map_)
    beside = alternatives and not RULES[study.rule].learns
    with (
        _InOrder() if devices() > 1 else ThreadPoolExecutor(1) as other_core
    ):  # for computations that do not need the share
        own = other_core.submit(_own_optima, study, posteriors, candidates, say) if individuals else None
        by_other = other_core.submit(_by_other_inference, study, cohort, candidates, share) if beside else None
        if share is None and beside and np.sum(cohort.counts() > 0) > 1:
            share = share_of(study.gp, cohort.trials, study.inference)
        rules = _rules(study, cohort, share) if alternatives else [study.rule]
        maps = {rule: _rule_map(study, cohort, rule, posteriors, share) for rule in rules if rule != study.rule}
        others = {rule: map_optimum(study, other_map, candidates) for rule, other_map in maps.items()}
    if by_other is not None:
        other = other_inference(study)
        other_map, others[other] = by_other.result()
        maps |= {} if other_map is None else {other: other_map}
    return Aggregate(
        cohort=cohort,
        posteriors=posteriors,
        optimum=optimum,
        own=None if own is None else own.result(),
        alternatives=others,
        map=map_,
        maps={study.rule: map_} | maps,
        share=share,
    )


class _InOrder(contextlib.nullcontext):
    """Executor that computes at once in the caller's thread, for several devices: each process must run the same
    programs in the same order."""

    def submit(self, function: Callable[..., _Result], *args: object) -> Future[_Result]:
        """Call the function now and return a finished future. An exception is raised here, not stored."""
        result: Future[_Result] = Future()
        result.set_result(function(*args))
        return result

    def __enter__(self) -> "_InOrder":
        """This executor."""
        return self


def _own_optima(study: Study, posteriors: Posterior, candidates: Float[Array, "m d"], say: SayCount) -> Optimum:
    """Optimum of each participant, in batches, with progress reports."""
    words = "participants' own optima found (--no-individuals leaves them out)"
    return _in_batches(lambda people: individual_optima(study, people, candidates), posteriors, words, say)


def _by_other_inference(
    study: Study, cohort: Cohort, candidates: Float[Array, "m d"], share: Share | None
) -> tuple[RuleMap | None, Optimum]:
    """Refit all participants by `other_inference`; returns the map by the study's method (None above `MANY`
    participants, to save memory) and its optimum."""
    other = other_inference(study)
    map_ = _rule_map(study, cohort, study.rule, fit_cohort(study, cohort, inference=other), share, other)
    optimum = map_optimum(study, map_, candidates)
    return (map_ if len(cohort.names) <= MANY else None), optimum


def _rules(study: Study, cohort: Cohort, share: Share | None) -> list[str]:
    """The methods whose maps are computed, without repeats: the study's, then those with given hyperparameters that the
    number of responses and a known `share` allow, of these the hierarchical one first."""
    few = cohort.counts().sum() <= _LARGEST_POOL
    given = sorted((RULES[name] for name in GIVEN), key=lambda rule: not rule.learns_share)
    beside = [r.name for r in given if (few or not r.exact_only) and (share is not None or not r.learns_share)]
    return list(dict.fromkeys([study.rule, *beside]))


def _rule_map(
    study: Study, cohort: Cohort, rule: str, posteriors: Posterior, share: Share | None, inference: str | None = None
) -> RuleMap:
    """Map by a method, from the posteriors or from all responses at once, as the method requires. A method that learns
    must be resolved; `share` and `inference` (None: the study's) are not for it. Raises `InputError` as `rule_map`."""
    if RULES[rule].learns:
        assert study.learnt is not None
        return learnt_map(study.learnt, cohort.trials)
    return rule_map(
        study.gp,
        cohort.trials,
        rule,
        posteriors=posteriors,
        share=None if share is None else share.mean,
        inference=study.inference if inference is None else inference,
        largest=_LARGEST_POOL if RULES[rule].exact_only else LARGEST_EXACT,
    )


def asked_variance(map_: RuleMap, cohort: Cohort) -> Float[Array, ""] | None:
    """Largest variance of a map at a tested stimulus, a scalar: the map's `reach` if it has one. None for a larger
    cohort than `MANY` without it, because all participants would have to be predicted at all stimuli."""
    if map_.reach is not None:
        return map_.reach
    if len(cohort.names) > MANY:
        return None
    points = np.unique(np.asarray(cohort.trials.x)[np.asarray(cohort.trials.mask)], axis=0)
    return to_device(np.asarray(predict_map(map_, to_device(points))[1]).max())
