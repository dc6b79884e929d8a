"""Every kind of error against an independent implementation, and clusters that give none."""

import ast
from pathlib import Path

import mpmath
import numpy as np
import pytest
from reference_statistics import Reference, estimates
from scipy import stats
from scipy.special import expit

from hilbo.statistics import cluster_robust, ordered_logit, regression
from hilbo.statistics import logits as st

# Errors of all kinds against an independent implementation


def three_models(rng):
    """Category, predictors, edges, a start and two ways of clustering; unbalanced, with few clusters."""
    n = 60
    x = np.column_stack([rng.integers(-1, 2, n), rng.integers(0, 2, n)]).astype(float)
    latent = x @ [0.8, -0.5] + rng.logistic(size=n)
    ones = np.ones((n, 1))
    cluster, item = rng.integers(0, 7, n), rng.integers(0, 9, n)
    ordered = np.digitize(latent, [-0.7, 0.9])
    yield "binary", (latent > 0).astype(int), np.hstack([ones, x]), np.zeros((1, 0)), np.zeros(3), cluster, item
    yield "ordered", ordered, x, np.eye(2), np.array([0, 0, -1.0, 1.0]), cluster, item
    yield "ties", ordered, x, np.array([[-1.0], [1.0]]), np.array([0, 0, 1.0]), cluster, item


@pytest.fixture(scope="module", params=["binary", "ordered", "ties"])
def both(request):
    """A model here and in the reference, fitted on both sides."""
    cases = {case[0]: case for case in three_models(np.random.default_rng(5))}
    kind, category, x, edges, start, cluster, item = cases[request.param]
    model = ordered_logit.design(category, x, edges)
    reference = Reference(kind, category, x)
    return model, ordered_logit.fit(model, start), reference, reference.fit(start), cluster, item


def test_estimates_scores_and_information(both):
    model, fitted, reference, exact, _, _ = both
    np.testing.assert_allclose(fitted.estimate, np.array(exact, float), rtol=0, atol=1e-12)
    score, information = reference.pieces(exact)
    np.testing.assert_allclose(ordered_logit.scores(model, fitted.estimate), score, rtol=0, atol=1e-11)
    np.testing.assert_allclose(
        ordered_logit.information(model, fitted.estimate), information.sum(axis=0), rtol=0, atol=1e-11
    )
    likelihoods = [reference.probability(exact, row, c) for row, c in zip(reference.x, reference.category, strict=True)]
    assert fitted.log_likelihood == pytest.approx(float(sum(map(mpmath.log, likelihoods))), rel=1e-13)


def repaired(reference, theta, labels):
    """The reference's covariance without negative eigenvalues, and the worst over the largest of the one-way sum."""
    values, vectors = np.linalg.eigh(reference.covariance(theta, *labels))
    largest = np.linalg.eigvalsh(sum(reference.covariance(theta, way) for way in labels))[-1]
    return vectors @ np.diag(np.where(values > 0, values, 0)) @ vectors.T, max(-values[0] / largest, 0)


def test_errors_iid_one_way_and_two_way(both):
    _, fitted, reference, exact, cluster, item = both
    np.testing.assert_allclose(fitted.covariance, reference.covariance(exact), rtol=1e-10)
    for labels in ((cluster,), (item,), (cluster, item)):
        expected, worst = repaired(reference, exact, labels)
        covariance = cluster_robust.clustered(fitted, *labels)
        np.testing.assert_allclose(covariance.matrix, expected, rtol=0, atol=1e-11 * np.abs(expected).max())
        assert covariance.degrees_of_freedom == min(len(set(way)) for way in labels) - 1
        assert covariance.repaired == pytest.approx(worst, rel=1e-9)


@pytest.mark.parametrize("kind", ["binary", "ordered"])
def test_the_table_against_sandwiches_summed_cluster_by_cluster(kind):
    cases = {case[0]: case for case in three_models(np.random.default_rng(7))}
    _, category, x, _, start, cluster, item = cases[kind]
    fit = {"binary": st.binary_logit, "ordered": st.ordered_logit}[kind]
    table = fit(category, {"a": x[:, -2], "b": x[:, -1]}, {"person": cluster, "item": item})
    reference = Reference(kind, category, x)
    exact = reference.fit(start)
    estimate = np.array(exact, float)
    for ways in ((), ("person",), ("item",), ("person", "item")):
        labels = [{"person": cluster, "item": item}[way] for way in ways]
        covariance = repaired(reference, exact, labels)[0] if labels else reference.covariance(exact)
        error = np.sqrt(np.diag(covariance))
        student = stats.t(min(len(set(way)) for way in labels) - 1) if labels else stats.norm()
        reach = student.ppf(0.975) * error
        rows = table.by(f"clustered by {' and '.join(ways)}" if ways else "iid")
        expected = [estimate, error, 2 * student.sf(np.abs(estimate) / error), estimate - reach, estimate + reach]
        np.testing.assert_allclose(
            rows[["estimate", "std_error", "p_value", "low", "high"]], np.transpose(expected), rtol=1e-9
        )


@pytest.mark.parametrize("unit", [1.0, 1e-5])
def test_a_fit_that_newton_steps_alone_would_lose(unit):
    """At the start all curvature is 0 to rounding but for one answer's; and the predictor's unit does not matter."""
    x = np.array([-0.012, -0.064, 0.0, -0.132, 0.032, -0.084])
    category, edges = np.array([0, 0, 1, 1, 0, 1]), np.zeros((1, 0))
    plain = ordered_logit.fit(ordered_logit.design(category, np.c_[np.ones(6), x], edges), np.zeros(2))
    model = ordered_logit.design(category, np.c_[np.ones(6), unit * x], edges)
    fitted = ordered_logit.fit(model, np.array([40.0, -900.0 / unit]))
    np.testing.assert_allclose(fitted.estimate * [1, unit], plain.estimate, rtol=1e-9)
    np.testing.assert_allclose(fitted.scores.sum(axis=0), 0, atol=1e-14)


def test_far_tails_stay_exact():
    model = ordered_logit.design(np.array([0, 1, 2]), np.ones((3, 1)), np.eye(2))
    theta = np.array([300.0, -1.0, 1.0])
    far = ordered_logit.log_likelihood(model.rows(np.array([0])), theta)
    middle = ordered_logit.log_likelihood(model.rows(np.array([1])), theta)
    assert far == pytest.approx(-301.0, rel=1e-15)
    assert middle == pytest.approx(-299.0 + np.log1p(-np.exp(-2.0)), rel=1e-15)
    np.testing.assert_allclose(ordered_logit.scores(model, theta)[:2, 0], [-1, -1], rtol=1e-15)


def test_statsmodels_is_imported_where_something_is_fitted_and_not_before():
    for path in Path(regression.__file__).parent.glob("*.py"):
        for node in ast.parse(path.read_text()).body:
            assert not isinstance(node, ast.Import | ast.ImportFrom) or "statsmodels" not in ast.unparse(node), path


# Degenerate clusters


def test_an_indefinite_two_way_covariance_is_repaired_and_reported():
    rng = np.random.default_rng(0)
    person, item = (index.ravel() for index in np.indices((6, 6)))
    success = (person + item) % 2  # rows and columns agree exactly, cells do not
    x = rng.standard_normal(36)
    fitted = st.binary_logit(success, {"x": x}, {"person": person, "item": item})
    assert np.linalg.eigvalsh(fitted.covariances["clustered by person and item"])[0] >= -1e-15
    assert any("indefinite" in sentence for sentence in fitted.warnings)
    labels = person.tolist(), item.tolist()
    reference = Reference("binary", success, np.c_[np.ones(36), x])
    raw = reference.covariance(estimates(fitted).to_numpy(), *labels)
    assert np.linalg.eigvalsh(raw)[0] < 0


def test_clusters_that_agree_exactly_give_no_error():
    success = np.tile([1, 1, 0], 12)
    fitted = st.binary_logit(success, None, {"person": np.repeat(np.arange(12), 3)})
    row = fitted.by("clustered by person").loc["Intercept"]
    assert np.isnan(row["std_error"]) and np.isnan(row["p_value"]) and "nothing is left" in row["assumes"]


def test_a_clustered_error_below_the_iid_one_is_warned_about():
    rng = np.random.default_rng(2)
    person = np.repeat(np.arange(10), 10)
    alike = np.concatenate([rng.permutation(np.arange(10) < 5 + (p % 2)) for p in range(10)])
    differ = rng.random(100) < np.repeat(expit(2 * rng.standard_normal(10)), 10)
    quiet, loud = (st.binary_logit(y, None, {"person": person}) for y in (differ, alike))
    assert any("below the iid ones for Intercept" in sentence for sentence in loud.warnings)
    assert not any("below the iid" in sentence for sentence in quiet.warnings)
    assert any("There are 10 clusters" in sentence for sentence in quiet.warnings)


def test_one_participant_gives_iid_errors_only():
    fitted = st.binary_logit([1, 0, 1, 1], None, {"participant": ["P"] * 4})
    assert list(fitted.table["errors"]) == ["iid"]
    assert fitted.warnings == ("There is one participant only: no error can be clustered by it.",)


def test_the_jackknife_is_near_that_of_refits_and_wider_with_unequal_clusters():
    rng = np.random.default_rng(7)
    who = np.repeat(np.arange(8), [60, 40, 20, 15, 10, 8, 5, 4])
    x = rng.normal(size=len(who)) + who / 8
    y = rng.logistic(size=len(who)) + 0.8 * x + rng.normal(size=8)[who] > 0
    fitted = st.binary_logit(y, {"x": x}, {"person": who})
    without = np.array([st.binary_logit(y[who != g], {"x": x[who != g]}).by("iid")["estimate"] for g in range(8)])
    moved = without - fitted.by("iid")["estimate"].to_numpy()
    by_refits = np.sqrt(7 / 8 * np.sum(moved**2, axis=0))
    errors = fitted.by("jackknife by person")["std_error"]
    np.testing.assert_allclose(errors, by_refits, rtol=0.2)  # with 60 of 162 answers in one cluster
    assert np.all(errors > fitted.by("clustered by person")["std_error"])
    assert np.all(fitted.by("jackknife by person")["degrees_of_freedom"] == 7)


def test_there_is_no_jackknife_where_one_cluster_decides():
    """Only person 0 was asked with x = 1."""
    x, who = np.repeat([0.0, 1.0], [12, 4]), np.repeat([0, 1, 2, 0], 4)
    y = np.tile([True, False], 8)
    fitted = st.binary_logit(y, {"x": x}, {"person": who})
    assert not fitted.table["errors"].str.startswith("jackknife").any()
    assert "Without one person the answers do not decide all coefficients: no jackknife by person." in fitted.warnings
