"""Every rule on one cohort as data, its figures, and what it recommends."""

import dataclasses
import json

import jax.numpy as jnp
import pytest
from test_report import answered, plain_study

from hilbo.comparison import compare, recommendation
from hilbo.errors import InputError
from hilbo.hierarchical import Share
from hilbo.population_rules import ALL_RULES
from hilbo.report_comparison import write_comparison


@pytest.mark.deep
def test_everything_is_compared_and_written(tmp_path):
    study = dataclasses.replace(plain_study(2), rule="poe")
    content = write_comparison(study, answered(study, people=4), tmp_path)
    assert json.loads((tmp_path / "comparison.json").read_text()) == content
    assert set(content["rules"]) == set(ALL_RULES)
    for found in content["rules"].values():
        assert found["negative_log_density"] > 0 and 0 <= found["central_95"] <= 1 and 0 <= found["covered"] <= 1
        assert set(found["influence"]) == {"P0", "P1", "P2", "P3"}
        assert set(found["optimum"]) == {"p0", "p1"}
    assert content["rules"]["pooled"]["agreement_with_pooled"] == pytest.approx(1.0)
    assert content["rules"]["poe"]["covered"] < 1 and content["rules"]["average"]["covered"] < 1
    for rule in ("bcm", "hierarchical", "pooled"):
        low, middle, high = content["rules"][rule]["optimum_by_draws"]["p0"]
        assert 1 <= low <= middle <= high <= 10
    assert content["rules"]["pooled"]["optimum_by_bootstrap"] is None
    assert {"comparison.png", "reliability.svg", "coverage.png", "comparison.csv"} <= {
        p.name for p in tmp_path.iterdir()
    }


def test_two_people_cannot_be_compared():
    study = plain_study(2)
    with pytest.raises(InputError, match="at least three are needed"):
        compare(study, answered(study, people=2))


def share(mean, against):
    """A posterior of the share with this Bayes factor against 1."""
    shares = jnp.linspace(0.0, 1.0, 101)
    curve = jnp.where(shares < 1, float(against), 0.0)
    ends = jnp.asarray([mean - 0.1, mean + 0.1])
    one = jnp.asarray(mean)
    return Share(shares, curve, one, one, ends, jnp.zeros(()), jnp.asarray(True))


def scored(**costs):
    return {
        rule: {"negative_log_density": c, "negative_log_density_error": 0.02, "central_95": 0.95}
        for rule, c in costs.items()
    }


def test_the_recommendation_follows_evidence_and_density():
    differ, alike = share(0.5, 40.0), share(0.9, -2.0)
    assert "Recommended: hierarchical" in recommendation(scored(bcm=1.2, hierarchical=1.205, gpoe=1.199), differ, 12)
    assert "Recommended: gpoe" in recommendation(scored(bcm=1.2, hierarchical=1.3, gpoe=1.19), differ, 12)
    assert "Recommended: bcm" in recommendation(scored(bcm=1.2, hierarchical=1.205, gpoe=1.199), alike, 12)
    assert "hardly told from chance" in recommendation(scored(bcm=1.2, hierarchical=1.1), differ, 4)
