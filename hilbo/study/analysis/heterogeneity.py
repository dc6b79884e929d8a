"""Differences between participants, for result.json, and a warning if the aggregation method assumes that there are
none."""

import math
from typing import Any

import numpy as np

from hilbo.numerics.host import to_device
from hilbo.population.maps import RuleMap
from hilbo.population.rules.registry import RECOMMENDED, RULES
from hilbo.population.shared.hierarchical import Share
from hilbo.study.config import Study
from hilbo.study.estimate.optimum import predict_map

__all__ = ["SURE", "heterogeneity", "how_aggregated", "rule_warnings", "share_content"]

SURE = 3.0  # log Bayes factor, about 20 to 1
_TOO_SURE = 1.5  # ratio of standard deviations above which it is reported


def heterogeneity(aggregate: Any) -> dict[str, Any] | None:
    """Estimate of how much participants differ, as a dict for result.json (`share_content`); None if the aggregate has
    none."""
    return None if aggregate.share is None else share_content(aggregate.share)


def share_content(share: Share) -> dict[str, Any]:
    """Estimate of the shared variance fraction as a dict of plain numbers: mean, mode, 95 % interval, log Bayes factor
    against identical participants, convergence."""
    return {
        "share": float(share.mean),
        "most_probable": float(share.best),
        "interval": np.asarray(share.interval).tolist(),
        "log_bayes_factor_that_people_differ": float(share.against_one),
        "converged": bool(share.converged),
    }


def how_aggregated(map_: RuleMap) -> str:
    """How maps of fewer trials and of bootstrap resamples are aggregated, as a phrase such as "by bcm"; "" if as the
    map itself."""
    rule = RULES[map_.rule]
    if map_.method == "by points":
        return ""
    if rule.exact_only:
        return f"by {rule.pointwise}"
    return f"by the method {rule.pointwise} point by point" + (", with the learnt hyperparameters" * rule.learns)


def rule_warnings(study: Study, aggregate: Any) -> list[str]:
    """A list with one warning if the study's method assumes identical participants and the responses show differences
    (log Bayes factor of 3 or more); otherwise empty."""
    share = aggregate.share
    if share is None or not RULES[study.rule].homogeneous or float(share.against_one) < SURE:
        return []
    low, high = np.asarray(share.interval).tolist()
    words = (
        f"Participants differ: about {100 * float(share.mean):.0f} % (95 % interval {100 * low:.0f} to"
        f' {100 * high:.0f} %) of the prior variance is shared, but "{study.rule}" assumes 100 %, so its intervals'
        " are too narrow"
    )
    ratio = _sd_ratio(aggregate)
    if ratio is not None and ratio >= _TOO_SURE:
        words += (
            f": at the optimum its standard deviation is {float(aggregate.optimum.sd):.2f}, that of"
            f' "hierarchical" {ratio:.1f} times as much'
        )
    return [words + f'. Use "{RECOMMENDED}" or "hierarchical".']


def _sd_ratio(aggregate: Any) -> float | None:
    """Standard deviation of the hierarchical map divided by that of the map, at the map's optimum; None without the
    former."""
    if aggregate.hierarchical is None:
        return None
    _, variance = predict_map(aggregate.hierarchical, to_device(np.asarray(aggregate.optimum.x)[None, :]))
    return math.sqrt(float(np.asarray(variance)[0])) / float(aggregate.optimum.sd)
