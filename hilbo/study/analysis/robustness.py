"""The paper's robustness check: do the optima stay where they are when the evidence chooses the hyperparameters?

The population optimum and everybody's own are found twice, under the study's fixed hyperparameters and under learnt
ones (shared by all, or each person's own), and compared in units of the search ranges (NRMSE). Besides, the derivative
of the population optimum with respect to each hyperparameter says which of them it leans on. People are aggregated by
the study's rule, point by point; the share of the hierarchical rule is learnt anew, and held for the derivative. Beside
the shift stands what the choice of the people leaves open anyway: a bootstrap over people.
Paper, section IV-3: less than 3 %.
"""

from collections.abc import Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from hilbo.errors import InputError
from hilbo.hyperparameters.judged_evidence import Judged, maximise_judged
from hilbo.hyperparameters.maximum_evidence import MaximumEvidence, optimum_sensitivity
from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import OrdinalGP, Posterior, Trials, fit
from hilbo.population.maps import point_rule, share_of
from hilbo.population.rules.registry import RULES
from hilbo.search.apart import nrmse
from hilbo.search.candidates import search_points
from hilbo.study.analysis.bootstrap import can_resample, resampled_tops
from hilbo.study.cohort import Cohort
from hilbo.study.config import Study
from hilbo.study.estimate.aggregate import fit_cohort
from hilbo.study.estimate.optimum import Optimum, individual_optima, population_optimum, predict_people

__all__ = ["LIMIT", "Robustness", "robustness"]

_LEARNABLE = ("theta", "noise", "thresholds")
_POINTS = 1000  # among which the optimum of resampled people is sought
LIMIT = 0.03
"""NRMSE from which an optimum is flagged as not robust (paper, section IV-3)."""


class Robustness(eqx.Module):
    """Optima under fixed and under learnt hyperparameters, and how far apart they are."""

    judged: Judged
    """What was learnt, one model if `shared`, else stacked, one for each participant; and Laplace's error there."""
    fixed: Optimum
    optimised: Optimum
    fixed_individuals: Optimum
    optimised_individuals: Optimum
    posteriors: Posterior
    """Of all participants, under the fixed hyperparameters,"""
    optimised_posteriors: Posterior
    """and under the learnt ones."""
    nrmse: Float[Array, ""]
    """Between the population optima."""
    individual_nrmse: Float[Array, " M"]
    resampled: Float[Array, " draws"] | None
    """NRMSE of the population optimum of bootstrap resamples of the people to that of all, fixed hyperparameters; None
    of one person, who says nothing of others."""
    sensitivity: dict[str, Float[Array, "..."]]
    """d(population optimum, unit cube) / d(log theta, log noise, first threshold, log gaps) at the fixed values."""
    shared: bool = eqx.field(static=True)
    rule: str = eqx.field(static=True)
    """By which people were aggregated, point by point: the study's, or bcm where that takes all answers at once."""
    shares: tuple[Float[Array, ""] | None, Float[Array, ""] | None]
    """Of the hierarchical rule, under the fixed and under the learnt hyperparameters."""

    @property
    def maximum(self) -> MaximumEvidence:
        """The hyperparameters."""
        return self.judged.maximum

    def maps(self) -> tuple[partial, partial]:
        """The population maps under the fixed and under the learnt hyperparameters: functions of points (m, d)."""
        both = zip((self.posteriors, self.optimised_posteriors), self.shares, strict=True)
        fixed, learnt = (partial(predict_people, posteriors, rule=self.rule, share=share) for posteriors, share in both)
        return fixed, learnt

    @property
    def flagged(self) -> Bool[Array, ""]:
        """Whether the population optimum moves by 3 % of the search ranges or more."""
        return self.nrmse >= LIMIT

    @property
    def flagged_individuals(self) -> Bool[Array, " M"]:
        """The same for everybody's own optimum."""
        return self.individual_nrmse >= LIMIT


def robustness(
    study: Study,
    cohort: Cohort,
    seed: int = 0,
    *,
    learn: Sequence[str] = _LEARNABLE,
    shared: bool = True,
    weak_priors: bool = True,
) -> Robustness:
    """Repeat the paper's check for a cohort.

    `shared`: one set of hyperparameters for all, else each participant's own. `weak_priors` keep the learnt values
    finite where 25 ordinal answers do not (`maximum.runaway` says where even they ran away).
    """
    _check(study, learn)
    candidates = search_points(study.space, seed)
    posteriors = fit_cohort(study, cohort)
    judged = maximise_judged(
        study.gp, cohort.trials, learn, shared=shared, weak_priors=weak_priors, inference=study.inference
    )
    optimised_study, again = _refitted(study, cohort, judged.maximum.gp, shared)
    rule, share = point_rule(study.rule, _share(study, cohort))
    shares = share, None if share is None else _share(optimised_study, cohort)
    fixed, optimised = (
        population_optimum(s, p, candidates, rule, share)
        for s, p, share in zip((study, optimised_study), (posteriors, again), shares, strict=True)
    )
    levels = study.gp.kernel.levels
    before, after = (individual_optima(s, p, candidates) for s, p in ((study, posteriors), (optimised_study, again)))
    return Robustness(
        judged=judged,
        fixed=fixed,
        optimised=optimised,
        fixed_individuals=before,
        optimised_individuals=after,
        posteriors=posteriors,
        optimised_posteriors=again,
        nrmse=nrmse(optimised.x, fixed.x, levels),
        individual_nrmse=nrmse(after.x, before.x, levels),
        resampled=_resampled(study, posteriors, candidates, fixed.x, rule, share, seed),
        sensitivity=_sensitivity(study, cohort.trials, fixed.x, tuple(learn), rule, share),
        shared=shared,
        rule=rule,
        shares=shares,
    )


def _check(study: Study, learn: Sequence[str]) -> None:
    """Raises InputError for a study, or hyperparameters, that cannot be compared."""
    if "variance" in learn:
        raise InputError("robustness: the prior variance cannot be learnt here; the committee needs one prior for all.")
    if unknown := [name for name in learn if name not in _LEARNABLE]:
        raise InputError(f'robustness: asked to learn "{unknown[0]}"; choose from {", ".join(_LEARNABLE)}.')
    if RULES[study.rule].learns:
        raise InputError(
            f'robustness: compares fixed hyperparameters with learnt ones, and the rule "{study.rule}" has no fixed'
            " ones; its result.json has their intervals."
        )


def _refitted(study: Study, cohort: Cohort, gp: OrdinalGP, shared: bool) -> tuple[Study, Posterior]:
    """The study with learnt hyperparameters where everybody shares them, and the posteriors under these or each
    person's own."""
    if not shared:
        return study, fit_cohort(study, cohort, gp)
    learnt = eqx.tree_at(lambda s: s.gp, study, gp)
    return learnt, fit_cohort(learnt, cohort)


def _resampled(
    study: Study,
    posteriors: Posterior,
    candidates: Float[Array, "m d"],
    x: Float[Array, " d"],
    rule: str,
    share: Float[Array, ""] | None,
    seed: int,
) -> Float[Array, " draws"] | None:
    """How far the optimum of resampled people is from x, sought among x and some of the candidates; None of one person,
    of whom every resample is the same."""
    if not can_resample(posteriors):
        return None
    points = jnp.concatenate([x[None, :], candidates[:_POINTS]])
    tops = resampled_tops(posteriors, points, rule, share, study.gp.kernel.variance, seed)
    return nrmse(points[tops], x[None, :], study.gp.kernel.levels)


def _share(study: Study, cohort: Cohort) -> Float[Array, ""] | None:
    """What people have in common, where the study's rule asks for it."""
    return share_of(study.gp, cohort.trials, study.inference).mean if RULES[study.rule].learns_share else None


@program
def _sensitivity(
    study: Study,
    trials: Trials,
    x: Float[Array, " d"],
    learn: tuple[str, ...],
    rule: str,
    share: Float[Array, ""] | None,
) -> dict[str, Float[Array, "..."]]:
    """Derivatives of the population optimum x, as `Robustness.sensitivity`."""

    def refit(gp):
        return jax.vmap(lambda t: fit(gp, t, inference=study.inference, throw=False))(trials)

    def height(w, posteriors):
        return predict_people(posteriors, study.space.from_box(w)[None, :], rule, share)[0][0]

    box, searched = study.space.to_box(x), study.space.searched
    between = {name: searched.get(name) for name in ("walls", "held")}
    return optimum_sensitivity(height, refit, box, study.gp, study.space.from_box, learn, **between)
