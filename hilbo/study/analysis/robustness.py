"""The paper's robustness check: do the optima move if the hyperparameters maximise the marginal likelihood?

The population optimum and the individual optima are computed twice, with the study's fixed hyperparameters and with
learnt ones (shared by all, or per participant), and compared in units of the search ranges (NRMSE). In addition, the
derivative of the population optimum with respect to each hyperparameter shows its influence. Participants are
aggregated by the study's method, point by point; the shared variance fraction of the hierarchical method is estimated
again, and kept fixed for the derivative. For comparison with the shift, a bootstrap gives the sampling variation over
participants.

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
    """Optima with fixed and with learnt hyperparameters, and the distances between them."""

    judged: Judged
    """Learnt hyperparameters, one model if `shared`, otherwise stacked per participant; and the error of the Laplace
    approximation there."""
    fixed: Optimum
    optimised: Optimum
    fixed_individuals: Optimum
    optimised_individuals: Optimum
    posteriors: Posterior
    """All participants' posteriors with the fixed hyperparameters."""
    optimised_posteriors: Posterior
    """All participants' posteriors with the learnt hyperparameters."""
    nrmse: Float[Array, ""]
    """NRMSE between the population optima."""
    individual_nrmse: Float[Array, " M"]
    resampled: Float[Array, " draws"] | None
    """NRMSE of the population optimum of each bootstrap resample to that of all participants, fixed hyperparameters;
    None with fewer than two participants."""
    sensitivity: dict[str, Float[Array, "..."]]
    """d(population optimum, unit cube) / d(log theta, log noise, first threshold, log gaps) at the fixed values."""
    shared: bool = eqx.field(static=True)
    rule: str = eqx.field(static=True)
    """Aggregation method, point by point: the study's, or its counterpart if that takes all responses at once."""
    shares: tuple[Float[Array, ""] | None, Float[Array, ""] | None]
    """Shared variance fraction of the hierarchical method, with fixed and with learnt hyperparameters; otherwise
    None."""

    @property
    def maximum(self) -> MaximumEvidence:
        """The learnt hyperparameters and their convergence diagnostics."""
        return self.judged.maximum

    def maps(self) -> tuple[partial, partial]:
        """The population maps with fixed and with learnt hyperparameters: functions of points (m, d) of the unit cube
        that return mean and variance (m,)."""
        both = zip((self.posteriors, self.optimised_posteriors), self.shares, strict=True)
        fixed, learnt = (partial(predict_people, posteriors, rule=self.rule, share=share) for posteriors, share in both)
        return fixed, learnt

    @property
    def flagged(self) -> Bool[Array, ""]:
        """Whether the population optimum moves by 3 % of the search ranges or more, a scalar."""
        return self.nrmse >= LIMIT

    @property
    def flagged_individuals(self) -> Bool[Array, " M"]:
        """Mask of the participants whose optimum moves by 3 % of the search ranges or more."""
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
    """Repeat the paper's robustness check for a cohort.

    `learn`: hyperparameters to learn, of "theta", "noise" and "thresholds". `shared`: one set for all participants,
    otherwise one for each. `weak_priors` keep the learnt values finite if 25 ordinal responses do not
    (`maximum.runaway` marks those that diverged even so). Raises InputError for another hyperparameter, and for a study
    whose method learns them itself.
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
    """Raise InputError for hyperparameters that cannot be learnt here, and for a study without fixed ones."""
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
    """Refit with learnt hyperparameters `gp`; returns the study with them (unchanged unless `shared`), and the
    posteriors."""
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
    """Bootstrap over participants: NRMSE of each resample's optimum, among x and 1000 candidates, to x. None for fewer
    than two participants with responses."""
    if not can_resample(posteriors):
        return None
    points = jnp.concatenate([x[None, :], candidates[:_POINTS]])
    tops = resampled_tops(posteriors, points, rule, share, study.gp.kernel.variance, seed)
    return nrmse(points[tops], x[None, :], study.gp.kernel.levels)


def _share(study: Study, cohort: Cohort) -> Float[Array, ""] | None:
    """Shared variance fraction estimated from the cohort, if the study's method uses it; otherwise None."""
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
    """Derivatives of the population optimum x by each hyperparameter in `learn`; see `Robustness.sensitivity`."""

    def refit(gp):
        return jax.vmap(lambda t: fit(gp, t, inference=study.inference, throw=False))(trials)

    def height(w, posteriors):
        return predict_people(posteriors, study.space.from_box(w)[None, :], rule, share)[0][0]

    box, searched = study.space.to_box(x), study.space.searched
    between = {name: searched.get(name) for name in ("walls", "held")}
    return optimum_sensitivity(height, refit, box, study.gp, study.space.from_box, learn, **between)
