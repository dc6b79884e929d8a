"""Tables II to IV, preferences and ties: printed figures of the paper, closed forms, and bad input."""

import functools

import jaxtyping
import numpy as np
import pandas as pd
import pytest
from reference_statistics import estimates
from scipy import stats
from scipy.special import expit, logit
from studies import BEST, MID, WORST, paper_counts

from hilbo.errors import InputError
from hilbo.statistics import logits as st
from hilbo.statistics.paper_tables import paper_tables
from hilbo.statistics.preferences import classifications, confusion, preference_rates, rate


@pytest.fixture(scope="module")
def paper():
    return paper_tables(paper_counts(np.random.default_rng(1)))


def test_table_2_of_the_paper(paper):
    coefficients = estimates(paper.table_2)
    assert round(coefficients["Intercept"], 4) == -2.5123 and round(coefficients["Best"], 2) == 4.94
    exact = logit(24 / 320), logit(147 / 160) - logit(24 / 320)
    np.testing.assert_allclose(coefficients[["Intercept", "Best"]], exact, rtol=1e-12)
    iid = paper.table_2.by("iid")["std_error"]
    np.testing.assert_allclose(iid["Intercept"], np.sqrt(1 / 24 + 1 / 296), rtol=1e-12)
    np.testing.assert_allclose(iid["Best"], np.sqrt(1 / 24 + 1 / 296 + 1 / 147 + 1 / 13), rtol=1e-12)


def test_table_3_of_the_paper(paper):
    coefficients = estimates(paper.table_3)
    assert round(coefficients["Best"], 4) == -4.1431 and round(coefficients["Worst"], 4) == 2.9738
    assert list(coefficients.index) == ["Best", "Worst", "close|similar", "similar|different"]


def test_table_4_of_the_paper(paper):
    assert round(estimates(paper.table_4)["Aggregate-Best"], 4) == 0.9773
    kinds = ["iid", "clustered by participant", "clustered by set", "clustered by participant and set"]
    kinds += ["jackknife by participant", "jackknife by set"]
    assert list(paper.table_4.table["errors"]) == kinds
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


# Preferences and ties


def test_rates_against_closed_forms():
    hits = np.arange(80) < 76
    intervals = rate(hits, {"participant": np.tile(np.arange(20), 4)}).set_index("errors")
    z, p = stats.norm.ppf(0.975), 0.95
    middle, half = (p + z**2 / 160), z * np.sqrt(p * (1 - p) / 80 + z**2 / 25600)
    np.testing.assert_allclose(intervals.loc["Wilson", "low"], (middle - half) / (1 + z**2 / 80))
    np.testing.assert_allclose(intervals.loc["exact", "high"], stats.beta.ppf(0.975, 77, 4))
    clustered = intervals.loc["clustered by participant"]
    assert 0 < clustered["low"] < 0.95 < clustered["high"] < 1


def test_ties_are_counted_and_modelled():
    """With one pair Rao & Kupper's model is saturated: the shares give strength and tie in closed form."""
    wins, losses, ties = 50, 20, 30
    chosen = np.repeat(["a1", "a2", "tie"], [wins, losses, ties])
    coefficients = estimates(st.tied_preferences(["a1"] * 100, ["a2"] * 100, chosen))
    won, lost = logit(wins / 100), logit(losses / 100)
    np.testing.assert_allclose(coefficients[["a1", "tie"]], [(won - lost) / 2, -(won + lost) / 2], rtol=1e-10)
    turned = st.tied_preferences(["a2"] * 100, ["a1"] * 100, chosen, reference="a1")
    np.testing.assert_allclose(estimates(turned)[["a2", "tie"]], [-coefficients["a1"], coefficients["tie"]], rtol=1e-10)
    tables = paper_tables(paper_counts(np.random.default_rng(4), ties=20))
    assert list(estimates(tables.table_4).index) == ["Aggregate-Best", "tie"]
    np.testing.assert_allclose(estimates(tables.table_4)["Aggregate-Best"], (logit(279 / 384) - logit(85 / 384)) / 2)


def test_strengths_from_three_sets_and_the_order_shown(paper):
    table = paper_counts(np.random.default_rng(1)).query("session == 'model'")
    fitted = st.tied_preferences(
        table["set_a"], table["set_b"], table["preferred"], table[["participant"]], order=np.ones(len(table))
    )
    strength = estimates(fitted)
    assert strength["best"] > strength["mid"] > 0 and list(strength.index) == ["best", "mid", "shown first"]
    assert np.isfinite(strength).all()  # 80 of 80 does not separate what the other pairs join


def test_a_pair_of_ties_only_has_no_rate():
    table = pd.DataFrame({"participant": ["A", "B"], "set_a": "x", "set_b": "y", "preferred": "tie"})
    row = preference_rates(table).squeeze()
    assert row["ties"] == 2 and np.isnan(row["rate"])


# The table, whole


def test_counts_of_classes():
    table = paper_counts(np.random.default_rng(1))
    assert len(classifications(table)) == 480
    shares = confusion(table, sets=("best", "mid", "worst"))
    assert shares.loc["mid", "similar"] == 114


def test_roles_and_sources_come_from_the_sets_table(paper):
    table = paper_counts(np.random.default_rng(1))
    ids = {name: f"s{i}" for i, name in enumerate(pd.unique(table[["set_a", "set_b"]].to_numpy().ravel()))}
    sets = pd.DataFrame({"set_id": ids.values(), "role": ids.keys()}).assign(
        source=[name if ":" in name else "aggregate" for name in ids]
    )
    for column in ("set_a", "set_b", "preferred"):
        table[column] = table[column].replace(ids)
    renamed = paper_tables(table, sets.set_index("set_id"))
    for name in ("table_2", "table_3", "table_4"):
        pd.testing.assert_series_equal(estimates(getattr(renamed, name)), estimates(getattr(paper, name)))
    with pytest.raises(InputError, match="is not in the sets table; add it there"):
        paper_tables(table, sets.set_index("set_id").drop("s3"))


def test_missing_sessions_are_said():
    table = paper_counts(np.random.default_rng(1))
    first = paper_tables(table.query("session == 'model'"))
    assert first.table_4 is None and "Table IV is missing: no comparison" in first.limits[0]
    second = paper_tables(table.query("session != 'model'"))
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
        (lambda: st.tied_preferences(["tie", "b"], ["b", "tie"], ["b", "tie"]), 'a set called "tie"'),
        (lambda: rate([]), "not empty"),
    ],
)
def test_bad_input_is_one_sentence(call, sentence):
    with pytest.raises(InputError, match=sentence):
        call()


def test_a_category_that_never_occurs_has_no_edge():
    fitted = st.ordered_logit([0, 2, 0, 2, 2], {"x": [0.0, 0, 1, 1, 0]}, categories=("low", "mid", "high"))
    assert list(estimates(fitted).index) == ["x", "low|high"]
    binary = st.binary_logit([0, 1, 0, 1, 1], {"x": [0.0, 0, 1, 1, 0]})
    np.testing.assert_allclose(estimates(fitted)["x"], estimates(binary)["x"], rtol=1e-10)


@functools.cache
def in_units(scale, separated):
    """A logit of two predictors, the first one in other units, back in its own; clustered both ways."""
    rng = np.random.default_rng(4)
    x, z = rng.normal(size=120), rng.normal(size=120)
    chance = x > 0.2 if separated else rng.random(120) < expit(0.3 + 0.8 * x - 0.5 * z)
    clusters = pd.DataFrame({"person": np.arange(120) % 9, "set": np.arange(120) // 9 % 5})
    fitted = st.binary_logit(chance.astype(int), {"x": x * scale, "z": z}, clusters)
    table = fitted.table.set_index(["term", "errors"])[["estimate", "std_error", "low", "high", "p_value"]]
    table.loc["x", ["estimate", "std_error", "low", "high"]] *= scale
    return table, fitted


@pytest.mark.parametrize("separated", [False, True])
@pytest.mark.parametrize(
    "scale", [1e-20, 1e4, 1e20, *(pytest.param(scale, marks=pytest.mark.deep) for scale in (1e-8, 1e-3, 1e8))]
)
def test_the_units_of_a_predictor_do_not_matter(scale, separated):
    table, fitted = in_units(scale, separated)
    expected, own = in_units(1.0, separated)
    pd.testing.assert_frame_equal(table, expected, rtol=1e-7, atol=1e-12)
    assert [words.partition("(")[0] for words in fitted.warnings] == [words.partition("(")[0] for words in own.warnings]
    for name, covariance in fitted.covariances.items():
        if "x" in covariance:
            assert covariance.loc["x", "x"] * scale**2 == pytest.approx(own.covariances[name].loc["x", "x"], rel=1e-7)


@pytest.mark.parametrize("origin", [1e5, 739_000.0, 1.7e9])
def test_the_origin_of_a_predictor_does_not_matter(origin):
    rng = np.random.default_rng(4)
    x, clusters = rng.normal(size=60), {"p": np.arange(60) % 9}
    yes, rank = (rng.random(60) < expit(x)).astype(int), np.digitize(x + rng.logistic(size=60), [-1.0, 1.0])
    for fitted in (lambda x: st.binary_logit(yes, {"x": x}, clusters), lambda x: st.ordered_logit(rank, {"x": x})):
        here, there = (fitted(at).table.set_index("term").loc[["x"]] for at in (x, x + origin))
        pd.testing.assert_frame_equal(there, here, rtol=1e-15 * origin + 1e-9)


YES = np.array([0, 1, 1, 0, 1, 1, 0, 1])
U = {"u": np.array([0.1, 0.5, 0.2, 0.7, 0.9, 0.3, 0.8, 0.4])}
MISSING = pd.Series([0, 1, None, 0, 1, 1, 0, 1], dtype="boolean")
A_LEVEL = "level is 95; it must be above 0 and below 1, such as 0.95."
NAMED = "give a DataFrame, a Series or a dict, so that each column has a name."
MISTAKES = {
    "a logit of level 95": (lambda: st.binary_logit(YES, U, level=95), A_LEVEL),
    "a rate of level 95": (lambda: rate(YES, level=95), A_LEVEL),
    "pairs of level 95": (lambda: preference_rates(pd.DataFrame({"preferred": []}), level=95), A_LEVEL),
    "tables of level 95": (lambda: paper_tables(paper_counts(np.random.default_rng(1)), level=95), A_LEVEL),
    "a level of text": (
        lambda: rate(YES, level="95%"),
        "level is '95%'; it must be above 0 and below 1, such as 0.95.",
    ),
    "clusters in a list": (lambda: st.binary_logit(YES, U, list("aabbccdd")), f"clusters is a list; {NAMED}"),
    "clusters of a rate in a list": (lambda: rate(YES > 2, list("aabbccdd")), f"clusters is a list; {NAMED}"),
    "clusters in an array": (lambda: st.binary_logit(YES, U, YES), f"clusters is a ndarray; {NAMED}"),
    "predictors in an array": (lambda: st.binary_logit(YES, U["u"]), f"predictors is a ndarray; {NAMED}"),
    "too few clusters": (
        lambda: rate(np.ones(3, int), {"p": ["a", "b"]}),
        'clusters "p" has 2 entries for 3 answers; give one for each answer.',
    ),
    "a predictor of text": (
        lambda: st.binary_logit(YES, {"u": list("abcdefgh")}),
        'predictor "u" must have one finite number for each of the 8 answers.',
    ),
    "a missing outcome": (
        lambda: st.binary_logit(MISSING, U),
        "the outcome of a binary logit must be a list of 0 and 1 (or no and yes), and not empty.",
    ),
    "predictors in another order": (
        lambda: st.binary_logit(pd.Series(YES), pd.DataFrame(U).sort_values("u")),
        "predictors and outcome have different row labels; bring their rows into one order, then"
        " reset_index(drop=True) both.",
    ),
    "clusters in another order": (
        lambda: st.binary_logit(YES, pd.DataFrame(U), {"p": pd.Series(YES, index=range(8, 0, -1))}),
        "clusters and predictors have different row labels; bring their rows into one order, then"
        " reset_index(drop=True) both.",
    ),
    "a missing success": (lambda: rate(MISSING), "a rate needs a list of 0 and 1 (or no and yes) that is not empty."),
    "pairs of two lengths": (
        lambda: st.tied_preferences(["a", "b"], ["b", "a"], ["a"]),
        "first, second and preferred must be lists of one length: an entry each for a comparison.",
    ),
    "a missing order": (
        lambda: st.tied_preferences(["a", "b"], ["b", "a"], ["a", "a"], order=[1, np.nan]),
        "order must be 1, -1 or 0 for each comparison: first was shown first, second, or unknown.",
    ),
}


@pytest.mark.parametrize("what", MISTAKES)
def test_what_is_given_wrongly_gets_one_sentence(what, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # who uses hilbo has no checks of types
    mistake, sentence = MISTAKES[what]
    with pytest.raises(InputError) as refused:
        mistake()
    assert str(refused.value) == sentence


def test_a_column_with_its_name_is_enough_and_ids_may_be_numbers_and_texts():
    table = st.binary_logit(YES, U, {"p": list("aabbccdd")}).table
    ids = pd.Series([1, 1, "b", "b", 3, 3, "d", "d"], name="p", dtype=object)
    pd.testing.assert_frame_equal(st.binary_logit(YES, pd.Series(U["u"], name="u"), ids).table, table)
    pd.testing.assert_frame_equal(st.binary_logit(pd.Series(YES).astype("boolean"), U, ids).table, table)
    assert rate(np.ones(8, int), ids)["errors"].tolist() == ["Wilson", "exact", "exact, of 4 by p"]
