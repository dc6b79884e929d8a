"""Every kind of error against an independent implementation, and clusters that give none."""

import numpy as np
import pytest
from reference_statistics import Reference, estimates
from scipy import stats
from scipy.special import expit

from hilbo.statistics import cluster_robust, ordered_logit, wild_bootstrap
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
    model, theta, reference, exact, _, _ = both
    np.testing.assert_allclose(theta, np.array(exact, float), rtol=0, atol=1e-12)
    score, information = reference.pieces(exact)
    np.testing.assert_allclose(ordered_logit.scores(model, theta), score, rtol=0, atol=1e-11)
    np.testing.assert_allclose(ordered_logit.information(model, theta), information, rtol=0, atol=1e-11)


def test_errors_iid_one_way_and_two_way(both):
    model, theta, reference, exact, cluster, item = both
    scores, information = ordered_logit.scores(model, theta), ordered_logit.information(model, theta)
    np.testing.assert_allclose(cluster_robust.iid(information).matrix, reference.covariance(exact), rtol=1e-10)
    for labels in ((cluster,), (item,), (cluster, item)):
        expected = reference.covariance(exact, *labels)
        values, vectors = np.linalg.eigh(expected)
        if values[0] < 0:
            expected = vectors @ np.diag(np.where(values > 0, values, 0)) @ vectors.T
        found = cluster_robust.sandwich(scores, information, cluster_robust.ways(*labels))
        np.testing.assert_allclose(found.matrix, expected, rtol=0, atol=1e-11 * np.abs(expected).max())
        assert found.degrees_of_freedom == min(len(set(way)) for way in labels) - 1
        assert (found.repaired > 0) == (values[0] < 0)


def test_wild_bootstrap_sign_by_sign(both):
    model, theta, reference, exact, cluster, item = both
    scores, information = ordered_logit.scores(model, theta), ordered_logit.information(model, theta)
    for labels in ((cluster,), (cluster, item)):
        if np.linalg.eigvalsh(reference.covariance(exact, *labels))[0] < 0:
            continue  # the repaired error is checked above
        ways = cluster_robust.ways(*labels)
        errors = np.sqrt(np.diag(cluster_robust.sandwich(scores, information, ways).matrix))
        test = wild_bootstrap.wild(model, theta, errors, ways)
        assert test.complete and len(test.weights) == 64
        for j, value in ((0, 0.0), (1, 0.3)):
            size, drawn = reference.wild(exact, j, value, *labels)
            np.testing.assert_allclose(
                np.sort(np.repeat(wild_bootstrap._statistics(test, j, value), 2)), np.sort(drawn), rtol=1e-8
            )
            assert wild_bootstrap.p_value(test, j, value) == np.mean(drawn >= size)


def test_wild_interval_is_where_the_p_value_crosses():
    _, category, x, edges, start, cluster, _ = next(three_models(np.random.default_rng(5)))
    found = st.binary_logit(category, {"a": x[:, 1], "b": x[:, 2]}, {"person": cluster})
    model, theta = ordered_logit.design(category, x, edges), np.array(estimates(found))
    np.testing.assert_allclose(theta, ordered_logit.fit(model, start), atol=1e-12)
    row = found.by("wild bootstrap by person").loc["a"]
    errors = found.by("clustered by person")["std_error"].to_numpy()
    test = wild_bootstrap.wild(model, theta, errors, cluster_robust.ways(cluster))
    assert row["p_value"] == wild_bootstrap.p_value(test, 1, 0.0)
    for end, inward in ((row["low"], 1e-4), (row["high"], -1e-4)):
        assert wild_bootstrap.p_value(test, 1, end - inward) <= 0.05 < wild_bootstrap.p_value(test, 1, end + inward)


@pytest.mark.parametrize(("clusters", "rows", "complete"), [(3, 108, True), (7, 64, True), (12, 2048, True)])
def test_all_weights(clusters, rows, complete):
    weights, all_of_them = wild_bootstrap.wild_weights(clusters)
    assert weights.shape == (rows, clusters) and all_of_them == complete
    everything = np.vstack([weights, -weights])
    assert len(np.unique(everything, axis=0)) == 2 * rows
    np.testing.assert_allclose(everything.T @ everything / len(everything), np.eye(clusters), atol=1e-12)


def test_drawn_weights_are_repeatable():
    first, complete = wild_bootstrap.wild_weights(13, seed=3)
    assert not complete and first.shape == (999, 13)
    np.testing.assert_array_equal(first, wild_bootstrap.wild_weights(13, seed=3)[0])
    assert np.any(first != wild_bootstrap.wild_weights(13, seed=4)[0])


def test_statsmodels_agrees():
    discrete = pytest.importorskip("statsmodels.discrete.discrete_model")
    ordinal = pytest.importorskip("statsmodels.miscmodels.ordinal_model")
    models = {case[0]: case for case in three_models(np.random.default_rng(7))}
    _, success, x, _, _, cluster, item = models["binary"]
    found = st.binary_logit(success, {"a": x[:, 1], "b": x[:, 2]}, {"person": cluster, "item": item}, bootstrap=False)
    fit = discrete.Logit(success, x).fit(disp=0, tol=1e-14, maxiter=100)
    assert found.log_likelihood == pytest.approx(fit.llf, rel=1e-12)
    np.testing.assert_allclose(found.by("iid")[["std_error", "p_value"]], np.c_[fit.bse, fit.pvalues], rtol=1e-8)
    options = {"disp": 0, "tol": 1e-14, "maxiter": 100, "cov_type": "cluster"}
    one = discrete.Logit(success, x).fit(**options, cov_kwds={"groups": cluster, "df_correction": True}, use_t=True)
    here = found.by("clustered by person")
    dof = {"df": here["degrees_of_freedom"].iloc[0]}
    np.testing.assert_allclose(here["std_error"], one.bse, rtol=1e-8)
    np.testing.assert_allclose(here["p_value"], 2 * stats.t.sf(np.abs(one.tvalues), **dof), rtol=1e-8)
    reach = stats.t.ppf(0.975, **dof) * one.bse
    np.testing.assert_allclose(here[["low", "high"]], np.c_[one.params - reach, one.params + reach], rtol=1e-8)
    two = discrete.Logit(success, x).fit(**options, cov_kwds={"groups": np.c_[cluster, item]})
    np.testing.assert_allclose(found.by("clustered by person and item")["std_error"], two.bse, rtol=1e-8)
    _, category, x, *_ = models["ordered"]
    found = st.ordered_logit(category, {"a": x[:, 0], "b": x[:, 1]}, bootstrap=False)
    fit = ordinal.OrderedModel(category, x, distr="logit").fit(method="bfgs", disp=0, gtol=1e-8)
    assert found.log_likelihood == pytest.approx(fit.llf, rel=1e-10)
    iid = found.by("iid")
    np.testing.assert_allclose(iid["estimate"][["a", "b"]], fit.params[:2], rtol=1e-5)
    np.testing.assert_allclose(iid["std_error"][["a", "b"]], fit.bse[:2], rtol=1e-4)  # its Hessian is numerical


def test_far_tails_stay_exact():
    model = ordered_logit.design(np.array([0, 1, 2]), np.ones((3, 1)), np.eye(2))
    theta = np.array([300.0, -1.0, 1.0])
    far = ordered_logit.log_likelihood(model.rows(np.array([0])), theta)
    middle = ordered_logit.log_likelihood(model.rows(np.array([1])), theta)
    assert far == pytest.approx(-301.0, rel=1e-15)
    assert middle == pytest.approx(-299.0 + np.log1p(-np.exp(-2.0)), rel=1e-15)
    np.testing.assert_allclose(ordered_logit.scores(model, theta)[:2, 0], [-1, -1], rtol=1e-15)


# Degenerate clusters


def test_an_indefinite_two_way_covariance_is_repaired_and_reported():
    rng = np.random.default_rng(0)
    person, item = (index.ravel() for index in np.indices((6, 6)))
    success = (person + item) % 2  # rows and columns agree exactly, cells do not
    x = rng.standard_normal(36)
    found = st.binary_logit(success, {"x": x}, {"person": person, "item": item}, bootstrap=False)
    assert np.linalg.eigvalsh(found.covariances["clustered by person and item"])[0] >= -1e-15
    assert any("indefinite" in sentence for sentence in found.warnings)
    labels = person.tolist(), item.tolist()
    reference = Reference("binary", success, np.c_[np.ones(36), x])
    raw = reference.covariance(estimates(found).to_numpy(), *labels)
    assert np.linalg.eigvalsh(raw)[0] < 0


def test_clusters_that_agree_exactly_give_no_error():
    success = np.tile([1, 1, 0], 12)
    found = st.binary_logit(success, None, {"person": np.repeat(np.arange(12), 3)})
    row = found.by("clustered by person").loc["Intercept"]
    assert np.isnan(row["std_error"]) and np.isnan(row["p_value"]) and "nothing is left" in row["assumes"]
    assert np.isnan(found.by("wild bootstrap by person").loc["Intercept", "p_value"])


def test_a_clustered_error_below_the_iid_one_is_warned_about():
    rng = np.random.default_rng(2)
    person = np.repeat(np.arange(10), 10)
    alike = np.concatenate([rng.permutation(np.arange(10) < 5 + (p % 2)) for p in range(10)])
    differ = rng.random(100) < np.repeat(expit(2 * rng.standard_normal(10)), 10)
    quiet, loud = (st.binary_logit(y, None, {"person": person}, bootstrap=False) for y in (differ, alike))
    assert any("below the iid ones for Intercept" in sentence for sentence in loud.warnings)
    assert not any("below the iid" in sentence for sentence in quiet.warnings)
    assert any("There are 10 clusters" in sentence for sentence in quiet.warnings)


def test_one_participant_gives_iid_errors_only():
    found = st.binary_logit([1, 0, 1, 1], None, {"participant": ["P"] * 4})
    assert list(found.table["errors"]) == ["iid"]
    assert found.warnings == ("There is one participant only: no error can be clustered by it.",)


def test_two_participants_have_an_open_or_finite_bootstrap_interval():
    found = st.binary_logit([1, 0, 1, 1, 0, 0, 1, 1], None, {"participant": [0, 0, 0, 0, 0, 1, 1, 1]})
    row = found.by("wild bootstrap by participant").loc["Intercept"]
    assert row["p_value"] > 0.05 and row["low"] == -np.inf and row["high"] == np.inf
