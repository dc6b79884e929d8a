"""Aggregation methods that learn the hyperparameters from all responses: the study with the learnt model, and its
description."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from hilbo.errors import InputError
from hilbo.population.learnt.posterior import Stated, prior_model
from hilbo.population.learnt.rule import Learnt
from hilbo.population.learnt.sample import learn_from_sample
from hilbo.population.maps import RuleMap
from hilbo.population.rules.registry import RECIPES, RECOMMENDED, RULES, WITHDRAWN
from hilbo.population.shared.scale_use import INDIVIDUAL
from hilbo.study.cohort import Cohort
from hilbo.study.config import Study

__all__ = ["by_rule", "effect_content", "learnt_content", "learnt_sentences", "resolved", "that_learns"]

_LABELS = {"effect": "random effect", "spread": "spread of sensitivities"}
_UNKNOWN = 0.9  # of the prior's standard deviation: above it, not identified by the responses


def that_learns(study: Study, recipe: str = RECOMMENDED) -> Study:
    """Copy of the study with a method that learns the hyperparameters, without the values of [gp] and what was learnt
    before; levels are kept, and inference becomes "laplace"."""
    stated = Stated(levels=study.stated.levels)
    gp = prior_model(study.space.dim, len(study.responses), stated)
    return dataclasses.replace(study, rule=recipe, gp=gp, inference="laplace", stated=stated, learnt=None)


def by_rule(study: Study, rule: str) -> Study:
    """Copy of the study with another aggregation method (the same study if it is that one already). Raises InputError
    for an unknown or withdrawn method, and for one that needs [gp] if the study's own method learns it."""
    if rule == study.rule:
        return study
    if rule in WITHDRAWN:
        raise InputError(f"--rule is {WITHDRAWN[rule]}")
    if rule not in RULES:
        raise InputError(f'--rule is "{rule}"; it must be one of {", ".join(RULES)}.')
    if RULES[rule].learns:
        return that_learns(study, rule)
    if RULES[study.rule].learns:
        raise InputError(f'--rule is "{rule}", and the study, whose rule is "{study.rule}", has no [gp] for it.')
    return dataclasses.replace(study, rule=rule)


def resolved(study: Study, cohort: Cohort) -> Study:
    """Copy of the study with the model learnt from the cohort (from a random sample of a large one). The same study if
    its method does not learn, or has learnt already. Raises `InputError` without responses."""
    if not RULES[study.rule].learns or study.learnt is not None:
        return study
    learnt = learn_from_sample(cohort.trials, len(study.responses), study.stated, RECIPES[study.rule])
    return dataclasses.replace(study, gp=learnt.model.gp, learnt=learnt)


def learnt_content(study: Study, names: Sequence[str], map_: RuleMap) -> dict[str, Any] | None:
    """Learnt hyperparameters as a dict for result.json: estimates, 95 % intervals, and the names of those that the data
    do not identify. None if nothing was learnt. `names`: the participants'; `map_`: the map by these hyperparameters,
    whose log evidence is of all responses, by more features than the search uses."""
    learnt = study.learnt
    if learnt is None:
        return None
    model = learnt.model
    content: dict[str, Any] = {
        "recipe": learnt.recipe,
        "stated": study.stated.numbers,
        "noise": float(model.noise),
        "theta": dict(zip(study.space.names, np.asarray(model.theta).tolist(), strict=True)),
        "shared_variance": float(model.shared),
        "own_variance": float(model.own),
        "share": float(model.share),
        "thresholds": np.asarray(model.thresholds).tolist(),
        "log_evidence": float(learnt.log_evidence if map_.shared is None else map_.shared.log_evidence),
        "steps": int(learnt.steps),
        "converged": bool(learnt.converged),
        "people": learnt.people,
    }
    content["intervals"] = {name: list(ends) for name, ends, _ in _coordinates(study, learnt)}
    content["not_identified"] = [name for name, _, known in _coordinates(study, learnt) if not known]
    if model.fixed_point is not None:
        content["sensitivities_about"] = (
            "the highest threshold" if model.fixed_point == 1.0 else "the middle of the thresholds"
        )
    for kind, key in (("width", "widths"), ("sensitivity", "sensitivities")):
        if key in learnt.coordinates:
            logs, sd = np.asarray(learnt.coordinates[key]), np.asarray(learnt.sd[key])
            ends = np.exp(np.stack([logs, logs - 1.96 * sd, logs + 1.96 * sd], axis=1)).tolist()
            content[key] = {
                name: {kind: value, "interval": [low, high]}
                for name, (value, low, high) in zip(names, ends, strict=True)
            }
    return content


def effect_content(study: Study, cohort: Cohort, map_: RuleMap) -> dict[str, Any] | None:
    """Random effect as a dict for result.json: learnt variance, and for each level with a response its posterior mean
    and standard deviation, which are added to the latent score. None if the map has none."""
    effects, trials = map_.effects, cohort.trials
    if effects is None:
        return None
    present = np.unique(np.asarray(trials.context)[np.asarray(trials.mask)])
    means, sds = np.asarray(effects.mean)[present], np.sqrt(np.asarray(effects.variance)[present])
    return {
        "column": study.file.random_effect,
        "variance": float(effects.prior),
        "levels": {
            cohort.contexts[c]: {"mean": mean, "sd": sd}
            for c, mean, sd in zip(present, means.tolist(), sds.tolist(), strict=True)
        },
    }


def _coordinates(study: Study, learnt: Learnt) -> list[tuple[str, tuple[float, float], bool]]:
    """A row per learnt hyperparameter: name, 95 % interval, and whether it is identified (posterior sd below 0.9 of the
    prior's). Threshold distances and variances are in units of the noise; individual widths and sensitivities are left
    out."""
    rows = []
    for name, value in learnt.coordinates.items():
        if name in INDIVIDUAL:
            continue
        means, sds = np.atleast_1d(np.asarray(value)), np.atleast_1d(np.asarray(learnt.sd[name]))
        labels = [f"theta.{p}" for p in study.space.names] if name == "theta" else [name]
        labels = [f"gap {i + 1}" for i in range(len(means))] if name == "gaps" else labels
        labels = [_LABELS[name]] if name in _LABELS else labels
        for label, mean, sd in zip(labels, means.tolist(), sds.tolist(), strict=True):
            ends = mean - 1.96 * sd, mean + 1.96 * sd
            ends = ends if name == "middle" else (math.exp(ends[0]), math.exp(ends[1]))
            known = math.isfinite(sd) and sd < _UNKNOWN * RECIPES[learnt.recipe].priors[name].sd
            rows.append((label, ends, known))
    return rows


def learnt_sentences(study: Study) -> list[str]:
    """Warnings about a learnt model: sample instead of all, hyperparameters that are not identified, fixed thresholds,
    no convergence. Empty if nothing was learnt."""
    learnt = study.learnt
    if learnt is None:
        return []
    sentences, people = [], len(learnt.weights)
    if learnt.people < people:
        sentences.append(
            f"The hyperparameters were learnt from a random sample of {learnt.people:,} of {people:,} participants; the"
            " map uses the responses of all."
        )
    unknown = [name for name, _, known in _coordinates(study, learnt) if not known]
    if unknown:
        sentences.append(
            f"The data do not constrain {', '.join(unknown)}; their values come from the prior ({learnt.recipe})."
        )
    if study.stated.thresholds is not None and study.stated.theta is None:
        sentences.append(
            "The study specifies the thresholds and learns theta: with thresholds that do not fit the responses, learnt"
            " length scales are misleading; leave gp.thresholds out."
        )
    if not bool(learnt.converged):
        sentences.append(
            "The search for the hyperparameters did not end well; compare the optimum with that of another rule."
        )
    return sentences
