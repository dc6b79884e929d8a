"""Every rule on one cohort as data, its figures, and what it recommends."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
from studies import answered, plain_study

from hilbo.population.judged.leave_one_out import LeftOut, calibration
from hilbo.population.rules.registry import GIVEN, RECOMMENDED
from hilbo.population.shared.hierarchical import Share
from hilbo.report.study.comparison import write_comparison
from hilbo.study.analysis.rule_comparison import compare, recommendation
from hilbo.study.estimate.aggregate import aggregate_cohort


@pytest.mark.deep
def test_everything_is_compared_and_written(tmp_path):
    study = dataclasses.replace(plain_study(2), rule="average")
    aggregate = aggregate_cohort(study, answered(study, people=4))
    content = write_comparison(study, aggregate, compare(study, aggregate), tmp_path).content
    assert json.loads((tmp_path / "comparison.json").read_text()) == content
    assert set(content["rules"]) == {*GIVEN, RECOMMENDED}
    assert content["rules"][RECOMMENDED]["hyperparameters"] == "learnt in each fold"
    for scores in content["rules"].values():
        assert scores["negative_log_density"] > 0 and 0 <= scores["central_95"] <= 1 and 0 <= scores["covered"] <= 1
        assert set(scores["influence"]) == {"P0", "P1", "P2", "P3"}
        assert set(scores["optimum"]) == {"p0", "p1"}
    assert content["rules"]["pooled"]["agreement_with_pooled"] == pytest.approx(1.0)
    assert content["rules"]["average"]["covered"] < 1
    for rule in ("bcm", "hierarchical", "pooled"):
        low, middle, high = content["rules"][rule]["optimum_by_draws"]["p0"]
        assert 1 <= low <= middle <= high <= 10
    assert content["rules"]["pooled"]["optimum_by_bootstrap"] is None
    assert {"comparison.png", "reliability.svg", "coverage.png", "comparison.csv"} <= {
        p.name for p in tmp_path.iterdir()
    }


def share(mean, against):
    """A posterior of the share with this Bayes factor against 1."""
    shares = np.linspace(0.0, 1.0, 101)
    curve = np.where(shares < 1, float(against), 0.0)
    ends, one = np.array([mean - 0.1, mean + 0.1]), np.array(mean)
    return Share(*map(jnp.asarray, (shares, curve, one, one, ends, np.zeros(()), np.array(True))))


def advice(learnt, people=12, spread=0.5, paired=0.01, **costs):
    """With these mean costs; people differ by `spread` in all rules alike, and by `paired` between rules."""
    rng = np.random.default_rng(0)
    person = np.repeat(np.arange(people), 5)

    def noise(scale):
        values = rng.normal(size=people)
        return scale * (values - values.mean()) / values.std(ddof=1)

    common, left = noise(spread), {}
    for rule, mean in costs.items():
        cost = (mean + common + (noise(paired) if rule == "hierarchical" else 0.0))[person]
        probabilities = np.stack([np.exp(-cost), 1 - np.exp(-cost)], axis=1)
        left[rule] = LeftOut(person, np.zeros(len(person), int), probabilities)
    return recommendation(left, {rule: calibration(each) for rule, each in left.items()}, learnt, people)


def test_the_best_is_recommended_where_the_others_are_worse():
    """0.05 is a third of a mean cost's error, and far more than the difference's."""
    words = advice(share(0.5, 40.0), bcm=2.2, hierarchical=2.15, average=2.3)
    assert "Participants differ" in words and "use hierarchical" in words and "Exploratory" in words
    alike = advice(share(0.5, 40.0), bcm=2.1, hierarchical=2.15, average=2.3)  # best, though people differ
    assert "No method is recommended: bcm assumes identical participants" in alike and "use bcm" not in alike


def test_nothing_is_recommended_on_a_tie():
    words = advice(share(0.9, -2.0), bcm=2.2, hierarchical=2.204, average=2.4, paired=0.2)
    assert "There is no evidence that participants differ" in words
    assert "No method is recommended: hierarchical predicts as well" in words and "use bcm" not in words
    assert "hardly distinguishable from chance" in advice(share(0.5, 40.0), 4, bcm=2.2, hierarchical=2.1)
