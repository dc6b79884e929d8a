"""A study with fixed and with optimised hyperparameters, by the criterion that belongs to its aggregation method.

- Committees, combined point by point: the evidence of each participant given all others
  (`hilbo.population.judged.left_out_evidence`).
- One model of all responses ("pooled"): its evidence, by Laplace's method. A single participant: the individual
  evidence.
- Methods that learn the hyperparameters: their own, the evidence of the hierarchical model; fixed are the medians of
  the recipe's priors.

All have weak priors, the committees' and the pooled model's about the study's own values. Paper, section IV-3.
"""

import dataclasses
import math
from typing import NamedTuple

import jax
import numpy as np

from hilbo.errors import InputError
from hilbo.hyperparameters.judged_evidence import judged_sentences, maximise_judged
from hilbo.ordinal_gp import Trials, fit
from hilbo.population.judged.evidence_search import Maximum
from hilbo.population.judged.left_out_evidence import maximise_left_out
from hilbo.population.judged.pooled_evidence import maximise_pooled
from hilbo.population.learnt.rule import not_learnt
from hilbo.population.maps import share_of
from hilbo.population.rules.registry import RECIPES, RULES
from hilbo.study.cohort import Cohort
from hilbo.study.config import Inference, Study
from hilbo.study.estimate.learnt import resolved

__all__ = ["LEARNABLE", "FixedAndOptimised", "differentiable", "fixed_and_optimised"]

LEARNABLE = ("theta", "noise", "thresholds")
"""Hyperparameters that are optimised. The prior variance is kept: it fixes the scale of the latent function."""
_COORDINATES = {"shared": "shared variance", "own": "individual variance", "middle": "thresholds", "gaps": "thresholds"}
_COORDINATES |= {"widths": "individual use of the scale", "effect": "random effect"}
_COORDINATES |= {"sensitivities": "individual use of the scale", "spread": "individual use of the scale"}


class FixedAndOptimised(NamedTuple):
    """A study with fixed and with optimised hyperparameters.

    `criterion`: what these maximise, in words; `learn`: which were optimised; `gain`: by how much the logarithm of the
    criterion is larger there, nats, None where the two are not of the same responses and coordinates; `runaway`: the
    maximum is out of reach, so that the priors determine the hyperparameters; `limits`: sentences on the search.
    """

    fixed: Study
    optimised: Study
    criterion: str
    learn: tuple[str, ...]
    gain: float | None
    converged: bool
    runaway: bool
    limits: tuple[str, ...] = ()

    @property
    def labels(self) -> tuple[str, str]:
        """Words for the fixed and the optimised hyperparameters, in titles of figures and tables."""
        rule = RULES[self.fixed.rule]
        return ("medians of the priors", f"learnt by {rule.name}") if rule.learns else ("fixed", "optimised")


def fixed_and_optimised(study: Study, cohort: Cohort, learn: tuple[str, ...] = LEARNABLE) -> FixedAndOptimised:
    """Optimise the hyperparameters `learn` for a cohort, by the criterion of the study's method.

    A method that learns its hyperparameters learns all that the study does not state, whatever `learn` says. A search
    that fails does not raise: read `converged`. Raises `InputError` without responses.
    """
    rule, trials = RULES[study.rule], cohort.trials
    if not np.asarray(trials.mask).any():
        raise InputError("hyperparameters: there are no responses; at least one is needed.")
    if rule.learns:
        return _learnt(study, cohort)
    if np.sum(cohort.counts() > 0) < 2:
        return _of_one_person(study, trials, learn)
    if rule.exact_only:
        return _compared(
            study, maximise_pooled(study.gp, trials, learn), "the evidence of all answers by one model", learn
        )
    share = share_of(study.gp, trials, study.inference).mean if RULES[rule.pointwise].learns_share else None
    inference = differentiable(study.inference)
    maximum = maximise_left_out(study.gp, trials, rule.pointwise, learn, share, inference=inference)
    return _compared(study, maximum, "the evidence of each participant's answers given those of all others", learn)


def differentiable(inference: Inference) -> Inference:
    """The inference itself, or EP for the exact one, which has no derivatives."""
    return "ep" if inference == "exact" else inference


def _compared(study: Study, maximum: Maximum, criterion: str, learn: tuple[str, ...]) -> FixedAndOptimised:
    """The record of a search from the study's hyperparameters."""
    gain = maximum.log_evidence - maximum.log_evidence_before
    return FixedAndOptimised(
        fixed=study,
        optimised=dataclasses.replace(study, gp=maximum.gp),
        criterion=criterion,
        learn=learn,
        gain=gain if math.isfinite(gain) else None,
        converged=maximum.converged,
        runaway=maximum.runaway,
        limits=_search_sentences(maximum.converged, maximum.runaway),
    )


def _learnt(study: Study, cohort: Cohort) -> FixedAndOptimised:
    """The study of a method that learns: at the medians of the priors, and learnt."""
    optimised = resolved(study, cohort)
    before = not_learnt(cohort.trials, len(study.responses), study.stated, RECIPES[study.rule])
    fixed = dataclasses.replace(study, gp=before.model.gp, learnt=before)
    learnt = optimised.learnt
    assert learnt is not None
    comparable = learnt.people == len(cohort.names) and learnt.scale is None
    return FixedAndOptimised(
        fixed=fixed,
        optimised=optimised,
        criterion="the evidence of all answers by the hierarchical model",
        learn=tuple(dict.fromkeys(_COORDINATES.get(name, name) for name in learnt.coordinates)),
        gain=float(learnt.log_evidence - before.log_evidence) if comparable else None,
        converged=bool(learnt.converged),
        runaway=False,
    )


def _of_one_person(study: Study, trials: Trials, learn: tuple[str, ...]) -> FixedAndOptimised:
    """The record of a search by the evidence of the only participant with responses; EP checks Laplace's evidence."""
    person = jax.tree.map(lambda leaf: leaf[np.flatnonzero(np.asarray(trials.mask).any(axis=1))], trials)
    inference = differentiable(study.inference)
    judged = maximise_judged(study.gp, person, learn, inference=inference)
    end, last = judged.maximum, "ep" if bool(judged.again) else inference
    alone = jax.tree.map(lambda leaf: leaf[0], person)
    before = fit(study.gp, alone, inference=last, throw=False).log_evidence
    counts = int(end.steps), bool(end.converged), bool(end.runaway)
    maximum = Maximum(end.gp, float(end.log_evidence), float(before), *counts)
    compared = _compared(study, maximum, "the evidence of the only participant's answers", learn)
    return compared._replace(limits=(*compared.limits, *judged_sentences(judged)))


def _search_sentences(converged: bool, runaway: bool) -> tuple[str, ...]:
    """Sentences on a search that did not converge, or found no maximum in reach."""
    if runaway:
        return ("The evidence has no maximum in reach: the weak priors determine the optimised hyperparameters.",)
    return () if converged else ("The search for hyperparameters of maximum evidence did not converge.",)
