"""All aggregation methods on one cohort: cross-validated predictions of left-out participants, and properties of each
map.

For each method: predictive density, calibration and reliability per response (`leave_one_out`); its optimum; the spread
of the optimum by joint draws of the map (bcm, hierarchical and pooled, whose joint posterior is known) and by a
bootstrap over participants (of methods that aggregate point by point); the influence of each participant; its agreement
with one model of all responses; and the proportion of the space where the responses reduce the map's standard
deviation. And, once, the differences between participants, with a recommendation in words.
"""

import dataclasses
import math
from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hilbo.errors import InputError
from hilbo.ordinal_gp import Posterior
from hilbo.population.joint import joint_map, posterior_map
from hilbo.population.judged.leave_one_out import (
    LeftOut,
    calibration,
    clustered,
    influence,
    leave_one_out,
    leave_one_out_learnt,
    reliability,
)
from hilbo.population.judged.left_out_kept import leave_one_out_kept
from hilbo.population.maps import RuleMap, learnt_map, rule_map, share_of
from hilbo.population.rules.registry import GIVEN, RECOMMENDED, RULES
from hilbo.population.shared.hierarchical import Share
from hilbo.search.apart import nrmse
from hilbo.search.candidates import search_points
from hilbo.study.analysis.heterogeneity import SURE, share_content
from hilbo.study.cohort import Cohort
from hilbo.study.config import Study
from hilbo.study.estimate.aggregate import Aggregate
from hilbo.study.estimate.bootstrap import resampled_tops
from hilbo.study.estimate.learnt import resolved, that_learns
from hilbo.study.estimate.optimum import map_optimum

__all__ = ["FEWEST", "KNOWN", "compare", "differences", "recommendation"]

FEWEST = 3
"""Smallest number of participants with responses: each is left out in turn, and two must remain. parts.html has the
number too."""
KNOWN = 0.8
"""Ratio of the map's standard deviation to that without responses, below which a point counts as covered by
responses."""

_POINTS = 400  # candidate points of joint draws and bootstrap
_DRAWS = 2000


def compare(study: Study, aggregate: Aggregate, seed: int = 0, *, learns: bool = True) -> dict[str, Any]:
    """Compare all methods with given hyperparameters, and, if `learns`, one that learns them in each fold (the study's,
    otherwise the recommended one).

    Returns a dict for comparison.json: "share", "people", "answers", "recommendation", and "rules": method -> its
    figures, or {"refused": reason}. Participants without responses are left out. Raises InputError for fewer than three
    others: two must remain when one is left out.
    """
    answered = np.flatnonzero(aggregate.cohort.counts() > 0)
    if len(answered) < FEWEST:
        raise InputError(
            f"compare: {len(answered)} people gave answers; at least three are needed, since each is left out in turn."
        )
    everybody = len(answered) == len(aggregate.cohort.names)
    cohort = aggregate.cohort if everybody else aggregate.cohort.rows(answered)
    posteriors = jax.tree.map(lambda leaf: leaf[answered], aggregate.posteriors)
    share = aggregate.share or share_of(study.gp, cohort.trials, study.inference)
    fitted = aggregate.maps if everybody else {}
    maps = {rule: fitted.get(rule) or _map(study, cohort, rule, posteriors, share) for rule in GIVEN}
    ground = _ground(study, cohort, posteriors, maps["pooled"], seed)
    rules: dict[str, Any] = {}
    left: dict[str, LeftOut] = {}
    for rule, map_ in maps.items():
        if isinstance(map_, str):
            rules[rule] = {"refused": map_}
            continue
        left[rule], folds = leave_one_out(
            study.gp, cohort.trials, rule, share=share.mean, posteriors=posteriors, inference=study.inference
        )
        rules[rule] = _entry(study, ground, map_, left[rule], folds)
        rules[rule]["hyperparameters"] = "given" if study.learnt is None else "learnt from all answers"
    recipe = study.rule if RULES[study.rule].learns else RECOMMENDED
    if learns:
        left[recipe], rules[recipe] = _learnt_entry(_that_learns(study, recipe, cohort, everybody), ground)
    for rule, (difference, error) in differences(left).items():
        rules[rule] |= {"difference": difference, "difference_error": error}
    words = recommendation(left, rules, share, len(answered))
    if learns and cohort.contexts:
        words += f" Only {recipe} takes account of the random effect of {study.file.random_effect}."
    content = {"share": share_content(share), "people": len(answered), "answers": int(cohort.counts().sum())}
    return content | {"rules": rules, "recommendation": words}


class _Ground(NamedTuple):
    """The data shared by all methods: participants with responses, and the points at which maps are compared."""

    cohort: Cohort
    posteriors: Posterior
    candidates: Float[Array, "m d"]
    """Points from which optima are searched."""
    x: Float[Array, "p d"]
    """Points at which maps are compared, drawn and resampled."""
    pooled: tuple[Float[Array, " p"], Float[Array, " d"]] | None
    """Of one model of all responses: mean at `x`, and optimum; None if it was refused."""
    seed: int


def _ground(study: Study, cohort: Cohort, posteriors: Posterior, pooled: RuleMap | str, seed: int) -> _Ground:
    """The shared data: candidates, 400 points, and mean and optimum of the pooled map (None if it was refused)."""
    candidates = search_points(study.space, seed)
    x = candidates[: min(_POINTS, len(candidates))]
    one = None if isinstance(pooled, str) else (pooled.predict(x)[0], map_optimum(study, pooled, candidates).x)
    return _Ground(cohort, posteriors, candidates, x, one, seed)


def _that_learns(study: Study, recipe: str, cohort: Cohort, everybody: bool) -> Study:
    """The study with hyperparameters learnt from this cohort by `recipe`; earlier ones are reused only if the
    cohort is complete (`everybody`)."""
    learns = study if study.rule == recipe else that_learns(study, recipe)
    return resolved(learns if everybody else dataclasses.replace(learns, learnt=None), cohort)


def _learnt_entry(learns: Study, ground: _Ground) -> tuple[LeftOut, dict[str, Any]]:
    """Predictions and figures (see `_entry`) of a method whose hyperparameters are learnt again in each fold; with the
    mean cost if they are learnt once from all."""
    assert learns.learnt is not None
    trials = ground.cohort.trials
    left, folds = leave_one_out_learnt(learns.learnt, trials, learns.stated)
    kept = leave_one_out_kept(learns.learnt, trials)
    entry = _entry(learns, ground, learnt_map(learns.learnt, trials), left, folds)
    entry["hyperparameters"] = "learnt in each fold"
    entry["negative_log_density_kept"] = float(kept.cost.mean())
    return left, entry


def _map(study: Study, cohort: Cohort, rule: str, posteriors: Posterior, share: Share) -> RuleMap | str:
    """Map by a method, or the sentence with the reason why there is none."""
    try:
        return rule_map(
            study.gp, cohort.trials, rule, posteriors=posteriors, share=share.mean, inference=study.inference
        )
    except InputError as error:
        return str(error)


def _entry(study: Study, ground: _Ground, map_: RuleMap, left: LeftOut, folds: list[RuleMap]) -> dict[str, Any]:
    """Figures of one method, as a dict: calibration of the `left`-out predictions, optimum, influence and so on.
    `folds`: its map without each participant."""
    best = map_optimum(study, map_, ground.candidates)
    mean, variance = map_.predict(ground.x)
    moved = influence(map_, folds, ground.x)
    agreement = from_pooled = None
    if ground.pooled is not None:
        other, other_best = ground.pooled
        agreement = _agreement(mean, other)
        from_pooled = float(nrmse(best.x, other_best, study.gp.kernel.levels))
    return calibration(left, ground.seed) | {
        "reliability": reliability(left),
        "method": map_.method,
        "optimum": _parameters(study, best.x),
        "optimum_sd": float(best.sd),
        "covered": float(jnp.mean(jnp.sqrt(variance / map_.map_prior) < KNOWN)),
        "influence": dict(zip(ground.cohort.names, moved.tolist(), strict=True)),
        "agreement_with_pooled": agreement,
        "from_pooled": from_pooled,
        "optimum_by_draws": _by_draws(study, ground, map_),
        "optimum_by_bootstrap": _by_bootstrap(study, ground, map_),
    }


def _agreement(mean: Float[Array, " p"], other: Float[Array, " p"]) -> float:
    """Correlation of two maps over the points; independent of their scales."""
    return float(jnp.corrcoef(mean, other)[0, 1])


def _by_draws(study: Study, ground: _Ground, map_: RuleMap) -> dict[str, list[float]] | None:
    """5, 50 and 95 % quantiles of the maximum of joint draws of the map; None if the map has no joint posterior."""
    x, closeness = ground.x, partial(study.goal.closeness, study.gp.likelihood)
    if map_.method == "exact" and map_.shared is not None:
        joint = posterior_map(map_.shared, x)
    elif RULES[map_.rule].product:
        joint = joint_map(ground.posteriors, x)
    else:
        return None
    return _quantiles(study, x, np.asarray(joint.optima(jax.random.key(ground.seed), _DRAWS, closeness=closeness)))


def _by_bootstrap(study: Study, ground: _Ground, map_: RuleMap) -> dict[str, list[float]] | None:
    """5, 50 and 95 % quantiles of the map's maximum under resampling of participants; None for methods that do not
    aggregate point by point."""
    if not RULES[map_.rule].by_points:
        return None
    share = map_.share if RULES[map_.rule].learns_share else None
    x = ground.x
    tops = resampled_tops(study, ground.posteriors, x, map_.rule, share, map_.prior, ground.seed, _DRAWS // 4)
    return _quantiles(study, x, np.bincount(tops, minlength=x.shape[0]) / len(tops))


def _quantiles(study: Study, x: Float[Array, "p d"], weight: Float[np.ndarray, " p"]) -> dict[str, list[float]]:
    """Parameter -> its 5, 50 and 95 % quantiles over weighted points, in its unit; of levels a list with the most
    probable one."""
    physical = np.asarray(study.space.to_physical(np.asarray(x)))
    quantiles = {}
    for i, p in enumerate(study.space.parameters):
        if p.levels:
            quantiles[p.name] = [p.shown(np.bincount(physical[:, i].astype(int), weight).argmax().item())]
            continue
        order = np.argsort(physical[:, i])
        total = np.cumsum(weight[order])
        places = np.searchsorted(total, np.array([0.05, 0.5, 0.95]) * total[-1])
        quantiles[p.name] = physical[order[np.minimum(places, len(order) - 1)], i].tolist()
    return quantiles


def _parameters(study: Study, x: Float[Array, " d"]) -> dict[str, Any]:
    """A point of the unit cube as parameter -> value in physical units, levels by name."""
    values = np.asarray(study.space.to_physical(np.asarray(x))).tolist()
    return {p.name: p.shown(v) if p.levels else v for p, v in zip(study.space.parameters, values, strict=True)}


def recommendation(left: Mapping[str, LeftOut], rules: dict[str, Any], share: Share, people: int) -> str:
    """Sentences on the differences between participants and on the method that predicts best. `left`: method -> its
    cross-validated predictions; `rules`: as in `compare`; `people`: number of participants.

    A method is recommended only if all others predict worse by more than two standard errors, and unless it assumes
    identical participants where these differ. Costs are compared response by response, with errors clustered by
    participant: participants are easy or hard to predict for all methods alike, so that the error of one method's mean
    cost would exaggerate the uncertainty.
    """
    scored = {rule: scores for rule, scores in rules.items() if "negative_log_density" in scores}
    best = min(scored, key=lambda rule: scored[rule]["negative_log_density"])
    low, high = (float(end) for end in share.interval)
    differ = float(share.against_one)
    evidence = (
        "Participants differ"
        if differ > SURE
        else "There is no evidence that participants differ"
        if differ < 0
        else "Participants may differ"
    )
    words = (
        f"{evidence}: the shared variance fraction is {float(share.mean):.2f} (95 % from {low:.2f} to {high:.2f}; log"
        f" Bayes factor for differences {differ:+.1f}). In cross-validation {best} predicts best"
        f" ({scored[best]['negative_log_density']:.3f} ± {scored[best]['negative_log_density_error']:.3f} nats per"
        f" response; {100 * scored[best]['central_95']:.1f} % of the responses lie in its central 95 %)."
    )
    tied = [rule for rule, gap in differences(left).items() if rule != best and _near(*gap)]
    if RULES[best].homogeneous and differ > SURE:
        words += f" No method is recommended: {best} assumes identical participants, so its intervals are too narrow."
    elif tied:
        words += f" No method is recommended: {', '.join(tied)} predict{'s' * (len(tied) == 1)} as well, within two"
        words += " standard errors of the difference."
    else:
        words += f" Exploratory recommendation, based on the same responses: use {best}."
    if people < 8:
        words += f" With {people} participants differences between methods are hardly distinguishable from chance."
    return words


def differences(left: Mapping[str, LeftOut]) -> dict[str, tuple[float, float]]:
    """Method -> difference of its mean cost from the lowest one (nats per response), and the standard error of that
    difference, paired by response and clustered by participant; (0, 0) for the best method."""
    best = min(left, key=lambda rule: left[rule].cost.mean())
    return {rule: clustered(each.cost - left[best].cost, each.person) for rule, each in left.items()}


def _near(difference: float, error: float) -> bool:
    """Whether a difference is at most two of its standard errors; True if the error is not finite."""
    return not math.isfinite(error) or difference <= 2 * error
