"""Statistics of validation sessions: printed figures of the paper, independent implementations, and hopeless data."""

from itertools import product

import numpy as np
import pandas as pd
import pytest
from reference_statistics import Reference, counts_to_answers, extreme_rays
from scipy import stats
from scipy.optimize import minimize, minimize_scalar
from scipy.special import expit, logit

from hilbo import cluster_robust, ordered_logit, separation, wild_bootstrap
from hilbo import statistics as st
from hilbo.errors import InputError
from hilbo.paper_tables import paper_tables
from hilbo.preferences import classifications, confusion, preference_rates, rate

BEST, MID, WORST = (147, 11, 2), (24, 114, 22), (0, 39, 121)  # close, similar, different
CHI = stats.chi2.ppf(0.95, 1)


def estimates(regression):
    return regression.table.drop_duplicates("term").set_index("term")["estimate"]


def study(rng, ties=0):
    """A validation table with the paper's counts: 20 people for the sets, 8 people and 24 individuals for table IV."""
    words = ("close", "similar", "different")
    pools = {
        name: list(rng.permutation(np.repeat(words, counts)))
        for name, counts in (("best", BEST), ("mid", MID), ("worst", WORST))
    }
    losses = {("best", "mid"): 4, ("best", "worst"): 0, ("mid", "worst"): 8}
    lost = {pair: list(rng.permutation([1] * count + [0] * (80 - count))) for pair, count in losses.items()}
    rows = []
    for person, _, pair in product(range(20), range(4), losses):
        a, b = pair[:: rng.choice([-1, 1])]
        win = pair[lost[pair].pop()]
        rows.append((f"P{person}", "model", a, b, "a", pools[a].pop(), pools[b].pop(), win))
    ours = list(rng.permutation(["aggregate"] * 279 + ["individual"] * (105 - ties) + ["tie"] * ties))
    for person, item, _ in product(range(8), range(24), range(2)):
        win = {"individual": "b", "aggregate": "aggregate", "tie": "tie"}[ours.pop()]
        rows.append((f"V{person}", "aggregate-best", "aggregate", f"individual:{item}", "b", "", "", win))
    names = ["participant", "session", "set_a", "set_b", "first", "class_a", "class_b", "preferred"]
    table = pd.DataFrame(rows, columns=names).assign(material="foam")
    return table.assign(trial=table.groupby("participant").cumcount() + 1)


@pytest.fixture(scope="module")
def paper():
    return paper_tables(study(np.random.default_rng(1)))


def test_table_2_of_the_paper(paper):
    found = estimates(paper.table_2)
    assert round(found["Intercept"], 4) == -2.5123 and round(found["Best"], 2) == 4.94
    exact = logit(24 / 320), logit(147 / 160) - logit(24 / 320)
    np.testing.assert_allclose(found[["Intercept", "Best"]], exact, rtol=1e-12)
    iid = paper.table_2.by("iid")["std_error"]
    np.testing.assert_allclose(iid["Intercept"], np.sqrt(1 / 24 + 1 / 296), rtol=1e-12)
    np.testing.assert_allclose(iid["Best"], np.sqrt(1 / 24 + 1 / 296 + 1 / 147 + 1 / 13), rtol=1e-12)


def test_table_3_of_the_paper(paper):
    found = estimates(paper.table_3)
    assert round(found["Best"], 4) == -4.1431 and round(found["Worst"], 4) == 2.9738
    assert list(found.index) == ["Best", "Worst", "close|similar", "similar|different"]


def test_table_4_of_the_paper(paper):
    assert round(estimates(paper.table_4)["Aggregate-Best"], 4) == 0.9773
    kinds = ["iid", "clustered by participant", "clustered by set", "clustered by participant and set"]
    wild = [kind.replace("clustered", "wild bootstrap") for kind in kinds[1:]]
    assert list(paper.table_4.table["errors"]) == kinds + wild
    assert paper.table_4.clusters == {"participant": 8, "set": 24}
    # The paper's own two-way error, 0.0844, is below this one.
    np.testing.assert_allclose(paper.table_4.by("iid")["std_error"], np.sqrt(1 / 279 + 1 / 105), rtol=1e-12)


def test_counts_behind_the_tables(paper):
    assert paper.limits == ()
    np.testing.assert_array_equal(paper.confusion, [BEST, MID, WORST])
    pairs = paper.preferences.drop_duplicates(["set", "over"]).set_index(["set", "over"])
    assert list(pairs["wins"]) == [76, 80, 72] and list(pairs["rate"]) == [0.95, 1.0, 0.9]


def test_a_pair_without_a_loss_is_answered_and_not_fitted(paper):
    rows = paper.preferences.query("set == 'best' and over == 'worst'").set_index("errors")
    assert list(rows.index) == ["Wilson", "exact", "exact, of 20 by participant"]
    np.testing.assert_allclose(rows.loc["exact", ["low", "high"]].astype(float), [0.025 ** (1 / 80), 1])
    np.testing.assert_allclose(rows.loc["exact, of 20 by participant", "low"], 0.025 ** (1 / 20))
    np.testing.assert_allclose(rows.loc["exact, of 20 by participant", "p_value"], 2.0**-19)


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


# Separation


def cone_of(model):
    has_upper, has_lower = np.isfinite(model.upper_offset), np.isfinite(model.lower_offset)
    return np.vstack([model.upper[has_upper], -model.lower[has_lower]])


def test_separation_agrees_with_the_rays_of_the_cone():
    rng, seen = np.random.default_rng(3), set()
    for case in range(120):
        n = int(rng.integers(4, 9))
        x = rng.integers(-1, 2, (n, 1 + case % 2)).astype(float)
        category = rng.integers(0, 3, n)
        if len(np.unique(category)) < 3:
            continue
        model = ordered_logit.design(category, x, np.eye(2))
        if not separation.independent(model).all():
            continue
        rays = extreme_rays(cone_of(model))
        found = separation.separation(model)
        k = model.upper.shape[1]
        total = np.sum(rays, axis=0) if rays else np.zeros(k)
        np.testing.assert_array_equal(found.rises, np.any([ray > 0 for ray in rays] or [np.zeros(k, bool)], axis=0))
        np.testing.assert_array_equal(found.falls, np.any([ray < 0 for ray in rays] or [np.zeros(k, bool)], axis=0))
        up = np.isinf(model.upper_offset) | (model.upper @ total > 0)
        down = np.isinf(model.lower_offset) | (model.lower @ total < 0)
        np.testing.assert_array_equal(found.upper, up)
        np.testing.assert_array_equal(found.lower, down)
        if found.infinite.any() and not found.certain.all():
            start = np.concatenate([np.zeros(k - 2), [-1, 1]])
            far = minimize(lambda v: -plain_log_likelihood(v, category, x), start + 50 * total, options={"gtol": 1e-8})  # noqa: B023
            assert separation.supremum(model, start, found) == pytest.approx(-far.fun, abs=1e-7)
        half_open = bool(np.any(up & ~down & np.isfinite(model.upper_offset)))
        seen.add((bool(found.infinite.any()), bool(found.certain.all()), half_open))
    assert {(False, False, False), (True, False, False), (True, False, True), (True, True, False)} <= seen


def plain_log_likelihood(theta, category, x):
    cuts = np.concatenate([[-np.inf], theta[-2:], [np.inf]])
    shift = x @ theta[:-2]
    with np.errstate(invalid="ignore", divide="ignore"):
        found = np.sum(np.log(expit(cuts[category + 1] - shift) - expit(cuts[category] - shift)))
    return found if np.isfinite(found) else -1e10


def test_a_cell_of_100_percent_has_a_one_sided_interval():
    category, group, person = counts_to_answers([(160, 0), (24, 296)], 20, np.random.default_rng(0))
    found = st.binary_logit(category == 0, {"Best": group == 0}, {"participant": person})
    assert "Best cannot be estimated: 160 answers are separated" in found.warnings[0]
    best = found.table.query("term == 'Best'").squeeze()
    assert best["estimate"] == np.inf and best["high"] == np.inf and best["errors"] == "profile likelihood"
    assert best["p_value"] < 1e-80 and np.isnan(best["std_error"])

    def at(b):
        """Twice the drop of the log-likelihood, the intercept free."""
        one = lambda a: 160 * np.log1p(np.exp(-a - b)) - 24 * np.log(expit(a)) - 296 * np.log(expit(-a))  # noqa: E731
        least = minimize_scalar(one, bracket=(-3, 0), tol=1e-12).fun
        return 2 * (least + 24 * np.log(24 / 320) + 296 * np.log(296 / 320))

    assert at(best["low"]) == pytest.approx(CHI, abs=1e-8)
    # What is not separated is as if the others had not been asked.
    alone = st.binary_logit(category[group == 1] == 0, None, {"participant": person[group == 1]})
    for kind in ("iid", "clustered by participant", "wild bootstrap by participant"):
        mine, theirs = (f.by(kind).loc["Intercept"].drop(["errors", "assumes"]).astype(float) for f in (found, alone))
        pd.testing.assert_series_equal(mine, theirs, rtol=1e-8)


def test_an_outcome_that_never_changes_has_the_closed_interval():
    found = st.binary_logit(np.ones(80), None, {"participant": np.arange(80) % 20})
    row = found.table.squeeze()
    q = np.exp(-CHI / 160)
    assert row["estimate"] == np.inf and row["low"] == pytest.approx(logit(q), abs=1e-9)
    assert row["p_value"] == pytest.approx(stats.chi2.sf(160 * np.log(2), 1), rel=1e-8)
    losses = st.binary_logit(np.zeros(80)).table.squeeze()
    assert losses["estimate"] == -np.inf and losses["high"] == pytest.approx(-logit(q), abs=1e-9)


def test_a_combination_that_separates_is_found():
    x, y = np.array([0.0, 1, 2, 3]), np.array([0, 0, 1, 1])
    found = st.binary_logit(y, {"x": x}, bootstrap=False)
    assert found.by("iid").loc["x", "estimate"] == np.inf
    assert found.by("iid").loc["Intercept", "estimate"] == -np.inf
    apart = st.binary_logit([1, 1, 0, 0], {"a": [0.0, 1, 0, 0], "b": [1.0, 0, 0, 0]})  # one ray, and more than one
    assert np.all(np.isinf(apart.table["estimate"]))


def test_a_sign_that_the_answers_do_not_decide():
    found = st.binary_logit([1, 1, 1, 1], {"x": [0.0, 1, 0, 1]}).by("iid")
    assert np.isnan(found.loc["x", "estimate"]) and found.loc["x", "low"] == -np.inf
    assert found.loc["x", "high"] == np.inf and found.loc["x", "p_value"] == 1


def test_separated_ordered_logit_keeps_the_rest():
    category, group, person = counts_to_answers([(40, 0, 0), (12, 20, 8), (3, 9, 28)], 10, np.random.default_rng(1))
    shifts = {"Best": group == 0, "Worst": group == 2}
    found = st.ordered_logit(category, shifts, {"participant": person})
    rest = group > 0
    alone = st.ordered_logit(category[rest], {"Worst": group[rest] == 2}, {"participant": person[rest]})
    assert estimates(found)["Best"] == -np.inf
    for kind in ("iid", "clustered by participant", "wild bootstrap by participant"):
        mine, theirs = (f.by(kind).loc["Worst"].drop(["errors", "assumes"]).astype(float) for f in (found, alone))
        pd.testing.assert_series_equal(mine, theirs, rtol=1e-8)


# Preferences and ties


def test_rates_against_closed_forms():
    hits = np.arange(80) < 76
    found = rate(hits, {"participant": np.tile(np.arange(20), 4)}).set_index("errors")
    z, p = stats.norm.ppf(0.975), 0.95
    middle, half = (p + z**2 / 160), z * np.sqrt(p * (1 - p) / 80 + z**2 / 25600)
    np.testing.assert_allclose(found.loc["Wilson", "low"], (middle - half) / (1 + z**2 / 80))
    np.testing.assert_allclose(found.loc["exact", "high"], stats.beta.ppf(0.975, 77, 4))
    clustered = found.loc["clustered by participant"]
    assert 0 < clustered["low"] < 0.95 < clustered["high"] < 1


def test_ties_are_counted_and_modelled():
    """With one pair Rao & Kupper's model is saturated: the shares give strength and tie in closed form."""
    wins, losses, ties = 50, 20, 30
    chosen = np.repeat(["a1", "a2", "tie"], [wins, losses, ties])
    found = estimates(st.tied_preferences(["a1"] * 100, ["a2"] * 100, chosen))
    won, lost = logit(wins / 100), logit(losses / 100)
    np.testing.assert_allclose(found[["a1", "tie"]], [(won - lost) / 2, -(won + lost) / 2], rtol=1e-10)
    turned = st.tied_preferences(["a2"] * 100, ["a1"] * 100, chosen, reference="a1")
    np.testing.assert_allclose(estimates(turned)[["a2", "tie"]], [-found["a1"], found["tie"]], rtol=1e-10)
    tables = paper_tables(study(np.random.default_rng(4), ties=20), bootstrap=False)
    assert list(estimates(tables.table_4).index) == ["Aggregate-Best", "tie"]
    np.testing.assert_allclose(estimates(tables.table_4)["Aggregate-Best"], (logit(279 / 384) - logit(85 / 384)) / 2)


def test_strengths_from_three_sets_and_the_order_shown(paper):
    table = study(np.random.default_rng(1)).query("session == 'model'")
    found = st.tied_preferences(
        table["set_a"], table["set_b"], table["preferred"], table[["participant"]], order=np.ones(len(table))
    )
    strength = estimates(found)
    assert strength["best"] > strength["mid"] > 0 and list(strength.index) == ["best", "mid", "shown first"]
    assert np.isfinite(strength).all()  # 80 of 80 does not separate what the other pairs join


def test_a_pair_of_ties_only_has_no_rate():
    table = pd.DataFrame({"participant": ["A", "B"], "set_a": "x", "set_b": "y", "preferred": "tie"})
    found = preference_rates(table).squeeze()
    assert found["ties"] == 2 and np.isnan(found["rate"])


# The table, whole


def test_counts_of_classes():
    table = study(np.random.default_rng(1))
    assert len(classifications(table)) == 480
    shares = confusion(table, sets=("best", "mid", "worst"))
    assert shares.loc["mid", "similar"] == 114


def test_roles_and_sources_come_from_the_sets_table(paper):
    table = study(np.random.default_rng(1))
    ids = {name: f"s{i}" for i, name in enumerate(pd.unique(table[["set_a", "set_b"]].to_numpy().ravel()))}
    sets = pd.DataFrame({"set_id": ids.values(), "role": ids.keys()}).assign(
        source=[name if ":" in name else "aggregate" for name in ids]
    )
    for column in ("set_a", "set_b", "preferred"):
        table[column] = table[column].replace(ids)
    found = paper_tables(table, sets.set_index("set_id"), bootstrap=False)
    for name in ("table_2", "table_3", "table_4"):
        pd.testing.assert_series_equal(estimates(getattr(found, name)), estimates(getattr(paper, name)))
    with pytest.raises(InputError, match="is not in the sets table; add it there"):
        paper_tables(table, sets.set_index("set_id").drop("s3"))


def test_missing_sessions_are_said():
    table = study(np.random.default_rng(1))
    first = paper_tables(table.query("session == 'model'"), bootstrap=False)
    assert first.table_4 is None and "Table IV is missing: no comparison" in first.limits[0]
    second = paper_tables(table.query("session != 'model'"), bootstrap=False)
    assert second.table_2 is None and second.table_3 is None and second.table_4 is not None
    assert len(second.limits) == 2 and second.confusion.to_numpy().sum() == 0 and second.preferences.empty


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: st.binary_logit([0, 1, 2]), "must be a list of 0 and 1"),
        (lambda: st.binary_logit([]), "not empty"),
        (lambda: st.binary_logit([0, 1], {"x": [1.0, np.nan]}), 'predictor "x" must have one finite number'),
        (lambda: st.binary_logit([0, 1, 1], {"x": [2.0, 2, 2]}), '"x" is a combination of the other coefficients'),
        (lambda: st.ordered_logit([0, 1, 2], {"x": [2.0, 2, 2]}), '"x" is a combination of the other coefficients'),
        (lambda: st.ordered_logit([1, 1], {"x": [0.0, 1]}, categories="abc"), 'all 2 answers are "b"'),
        (lambda: st.ordered_logit([0, 3], {"x": [0.0, 1]}, categories="abc"), "category 3 has no name"),
        (lambda: st.ordered_logit([0.5, 1.0], {"x": [0.0, 1]}), "whole numbers from 0"),
        (lambda: st.binary_logit([0, 1], None, {"a": [1, 2], "b": [1, 2], "c": [1, 2]}), "not by 3"),
        (lambda: st.binary_logit([0, 1], None, {"a": [1]}), "has 1 entries for 2 answers"),
        (lambda: st.binary_logit([0, 1], None, {"a": ["x", None]}), "has empty entries"),
        (lambda: st.tied_preferences(["a"], ["b"], ["c"]), "must prefer one of its two sets"),
        (lambda: st.tied_preferences(["a"], ["b"], ["a"], reference="z"), 'reference "z" is in no comparison'),
        (lambda: rate([]), "not empty"),
    ],
)
def test_bad_input_is_one_sentence(call, sentence):
    with pytest.raises(InputError, match=sentence):
        call()


def test_a_category_that_never_occurs_has_no_edge():
    found = st.ordered_logit([0, 2, 0, 2, 2], {"x": [0.0, 0, 1, 1, 0]}, categories=("low", "mid", "high"))
    assert list(estimates(found).index) == ["x", "low|high"]
    binary = st.binary_logit([0, 1, 0, 1, 1], {"x": [0.0, 0, 1, 1, 0]})
    np.testing.assert_allclose(estimates(found)["x"], estimates(binary)["x"], rtol=1e-10)
