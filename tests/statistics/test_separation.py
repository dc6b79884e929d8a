"""Separation against exact rays and closed forms; tables of any kind are answered."""

import numpy as np
import pandas as pd
import pytest
from reference_statistics import counts_to_answers, estimates, extreme_rays
from scipy import stats
from scipy.optimize import minimize, minimize_scalar
from scipy.special import expit, logit

from hilbo.errors import InputError
from hilbo.statistics import logits as st
from hilbo.statistics import ordered_logit, separation

DROP = -2 * np.log(0.025)


# Separation


def cone_of(model):
    has_upper, has_lower = np.isfinite(model.upper_offset), np.isfinite(model.lower_offset)
    return np.vstack([model.upper[has_upper], -model.lower[has_lower]])


def test_separation_agrees_with_the_rays_of_the_cone():
    rng, seen = np.random.default_rng(3), set()
    for case in range(30):
        n = int(rng.integers(4, 9))
        x = rng.integers(-1, 2, (n, 1 + case % 2)).astype(float)
        category = rng.integers(0, 3, n)
        if len(np.unique(category)) < 3:
            continue
        model = ordered_logit.design(category, x, np.eye(2))
        if not separation.independent(model).all():
            continue
        rays = extreme_rays(cone_of(model))
        separated = separation.separation(model)
        k = model.upper.shape[1]
        total = np.sum(rays, axis=0) if rays else np.zeros(k)
        np.testing.assert_array_equal(separated.rises, np.any([ray > 0 for ray in rays] or [np.zeros(k, bool)], axis=0))
        np.testing.assert_array_equal(separated.falls, np.any([ray < 0 for ray in rays] or [np.zeros(k, bool)], axis=0))
        up = np.isinf(model.upper_offset) | (model.upper @ total > 0)
        down = np.isinf(model.lower_offset) | (model.lower @ total < 0)
        np.testing.assert_array_equal(separated.upper, up)
        np.testing.assert_array_equal(separated.lower, down)
        if separated.infinite.any() and not separated.certain.all():
            start = np.concatenate([np.zeros(k - 2), [-1, 1]])
            loss = lambda v, c=category, x=x: -plain_log_likelihood(v, c, x)  # noqa: E731
            far = minimize(loss, start + 50 * total, options={"gtol": 1e-8})
            assert separation.supremum(model, start, separated) == pytest.approx(-far.fun, abs=1e-7)
        half_open = bool(np.any(up & ~down & np.isfinite(model.upper_offset)))
        seen.add((bool(separated.infinite.any()), bool(separated.certain.all()), half_open))
    assert {(False, False, False), (True, False, False), (True, False, True), (True, True, False)} <= seen


def plain_log_likelihood(theta, category, x):
    cuts = np.concatenate([[-np.inf], theta[-2:], [np.inf]])
    shift = x @ theta[:-2]
    with np.errstate(invalid="ignore", divide="ignore"):
        value = np.sum(np.log(expit(cuts[category + 1] - shift) - expit(cuts[category] - shift)))
    return value if np.isfinite(value) else -1e10


def test_a_cell_of_100_percent_has_a_one_sided_interval():
    category, group, person = counts_to_answers([(160, 0), (24, 296)], 20, np.random.default_rng(0))
    fitted = st.binary_logit(category == 0, {"Best": group == 0}, {"participant": person})
    assert "Best cannot be estimated: 160 answers are separated" in fitted.warnings[0]
    best = fitted.table.query("term == 'Best'").squeeze()
    assert best["estimate"] == np.inf and best["high"] == np.inf and best["errors"] == "profile likelihood"
    assert best["p_value"] < 1e-80 and np.isnan(best["std_error"])

    def at(b):
        """Twice the drop of the log-likelihood, the intercept free."""
        one = lambda a: 160 * np.log1p(np.exp(-a - b)) - 24 * np.log(expit(a)) - 296 * np.log(expit(-a))  # noqa: E731
        least = minimize_scalar(one, bracket=(-3, 0), tol=1e-12).fun
        return 2 * (least + 24 * np.log(24 / 320) + 296 * np.log(296 / 320))

    assert at(best["low"]) == pytest.approx(DROP, abs=1e-8)
    # What is not separated is as if the others had not been asked.
    alone = st.binary_logit(category[group == 1] == 0, None, {"participant": person[group == 1]})
    for kind in ("iid", "clustered by participant"):
        mine, theirs = (f.by(kind).loc["Intercept"].drop(["errors", "assumes"]).astype(float) for f in (fitted, alone))
        pd.testing.assert_series_equal(mine, theirs, rtol=1e-8)


def test_an_outcome_that_never_changes_has_the_closed_interval():
    fitted = st.binary_logit(np.ones(80), None, {"participant": np.arange(80) % 20})
    row = fitted.table.squeeze()
    exact = stats.binomtest(80, 80)  # Clopper & Pearson
    assert row["estimate"] == np.inf and row["low"] == pytest.approx(logit(exact.proportion_ci().low), abs=1e-9)
    assert row["p_value"] == pytest.approx(exact.pvalue, rel=1e-8)
    losses = st.binary_logit(np.zeros(80)).table.squeeze()
    assert losses["estimate"] == -np.inf and losses["high"] == pytest.approx(-row["low"], abs=1e-9)


def test_a_combination_that_separates_is_found():
    x, y = np.array([0.0, 1, 2, 3]), np.array([0, 0, 1, 1])
    fitted = st.binary_logit(y, {"x": x})
    assert fitted.by("iid").loc["x", "estimate"] == np.inf
    assert fitted.by("iid").loc["Intercept", "estimate"] == -np.inf
    apart = st.binary_logit([1, 1, 0, 0], {"a": [0.0, 1, 0, 0], "b": [1.0, 0, 0, 0]})  # one ray, and more than one
    assert np.all(np.isinf(apart.table["estimate"]))


def test_a_sign_that_the_answers_do_not_decide():
    rows = st.binary_logit([1, 1, 1, 1], {"x": [0.0, 1, 0, 1]}).by("iid")
    assert np.isnan(rows.loc["x", "estimate"]) and rows.loc["x", "low"] == -np.inf
    assert rows.loc["x", "high"] == np.inf and rows.loc["x", "p_value"] == 1


def test_separated_ordered_logit_keeps_the_rest():
    category, group, person = counts_to_answers([(40, 0, 0), (12, 20, 8), (3, 9, 28)], 10, np.random.default_rng(1))
    shifts = {"Best": group == 0, "Worst": group == 2}
    fitted = st.ordered_logit(category, shifts, {"participant": person})
    rest = group > 0
    alone = st.ordered_logit(category[rest], {"Worst": group[rest] == 2}, {"participant": person[rest]})
    assert estimates(fitted)["Best"] == -np.inf
    for kind in ("iid", "clustered by participant"):
        mine, theirs = (f.by(kind).loc["Worst"].drop(["errors", "assumes"]).astype(float) for f in (fitted, alone))
        pd.testing.assert_series_equal(mine, theirs, rtol=1e-8)


def random_regression(rng):
    """A small table of any kind, often separated, with few and unequal clusters; None if it is refused."""
    n = int(rng.integers(1, 30))
    x = {f"x{i}": rng.standard_normal(n) * 10 ** rng.uniform(-2, 2) for i in range(rng.integers(0, 3))}
    if rng.random() < 0.5:
        x = {name: np.sign(values) for name, values in x.items()}
    clusters = {name: rng.integers(0, rng.integers(1, 6) + 1, n) for name in ("p", "q")[: rng.integers(1, 3)]}
    kind, sets = rng.integers(0, 3), np.array(["s", "t", "u"])
    first = rng.integers(0, 3, n)
    second = (first + rng.integers(1, 3, n)) % 3
    winner = np.where(rng.random(n) < 0.7, sets[first], sets[second])
    preferred = np.where(rng.random(n) < 0.3, "tie", winner)
    try:
        if kind == 0:
            return st.binary_logit(rng.random(n) < rng.random(), x, clusters)
        if kind == 1:
            return st.ordered_logit(rng.integers(0, 3, n), x, clusters)
        return st.tied_preferences(sets[first], sets[second], preferred, clusters, order=rng.integers(-1, 2, n))
    except InputError:
        return None


@pytest.mark.parametrize(
    "seeds", [range(390, 400), pytest.param(range(390), marks=pytest.mark.deep)], ids=["few", "many"]
)
def test_any_table_is_answered(seeds):
    kinds = set()
    for seed in seeds:
        fitted = random_regression(np.random.default_rng(seed))
        if fitted is None:
            continue
        table = fitted.table
        gone = table["errors"] == "profile likelihood"
        assert np.isfinite(table.loc[~gone, "estimate"]).all() and not np.isfinite(table.loc[gone, "estimate"]).any()
        outside = (table["low"] > table["estimate"]) | (table["high"] < table["estimate"])
        assert not outside.any(), (seed, table[outside])
        assert table["p_value"].dropna().between(0, 1).all()
        kinds |= {bool(gone.any()), bool(gone.all())}
    assert kinds == {True, False}
