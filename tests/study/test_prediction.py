"""From a DataFrame of one's own to a cohort, and to predictions in physical units; and a map on axes of one's own."""

import equinox as eqx
import jax
import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from studies import PLAIN

from hilbo import InputError, Study
from hilbo.report.figures.on_axes import plot_map
from hilbo.study.analysis.prediction import predict
from hilbo.study.cohort import cohort_of, read_trials
from hilbo.study.estimate.aggregate import aggregate_cohort, fit_cohort
from hilbo.study.file.reserved_names import is_reserved
from hilbo.study.results.arviz_groups import groups, inference_data

STUDY = Study.from_dict(PLAIN)
LOW, HIGH = STUDY.responses[0], STUDY.responses[-1]


@pytest.fixture(scope="module")
def table():
    rng = np.random.default_rng(1)
    people = {"participant": np.repeat([7, 3], 6), "trial": np.tile(np.arange(1, 7), 2)}
    values = {p.name: rng.uniform(p.low, p.high, 12) for p in STUDY.space.parameters}
    return pd.DataFrame(people | values | {"response": pd.Categorical(rng.choice([LOW, HIGH], 12)), "note": "x"})


@pytest.fixture(scope="module")
def cohort(table):
    return cohort_of(table, STUDY)


@pytest.fixture(scope="module")
def people(cohort):
    return fit_cohort(STUDY, cohort)


@pytest.fixture(scope="module")
def one(people):
    return jax.tree.map(lambda leaf: leaf[1], people)


@pytest.fixture(scope="module")
def aggregate(cohort):
    return aggregate_cohort(STUDY, cohort, alternatives=False)


def test_ones_own_table_is_a_cohort_with_the_bits_of_a_file(table, cohort, tmp_path):
    table.to_csv(tmp_path / "t.csv", index=False)
    read = cohort_of(read_trials(tmp_path / "t.csv", STUDY), STUDY)
    assert cohort.names == read.names == ("3", "7")
    np.testing.assert_array_equal(cohort.physical, read.physical)
    np.testing.assert_array_equal(cohort.trials.q, read.trials.q)
    assert repr(cohort) == "Cohort(2 participants (3, 7), 12 answers, 2 parameters)"


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (
            lambda t: t.assign(u=9.0),
            'DataFrame: row 1: u is "9.0"; it must be a number from 0 to 1, the study\'s range.',
        ),
        (lambda t: t.drop(columns="v"), 'DataFrame: column "v" is missing; a trial table of this study has'),
        (lambda t: t.assign(participant=np.nan), "DataFrame: row 1: participant is empty"),
        (lambda t: t.assign(response="fine"), 'DataFrame: row 1: response is "fine"; it must be one of'),
        (lambda t: pd.concat([t, t]), "DataFrame: row 13: participant 7, trial 1 is in row 1 already"),
        (lambda t: t.iloc[:0], "DataFrame: has no rows"),
        (lambda t: pd.concat([t, t[["u"]]], axis=1), 'DataFrame: column "u" is there twice; remove one of them.'),
    ],
)
def test_what_is_wrong_with_ones_own_table_is_one_sentence(table, change, sentence):
    with pytest.raises(InputError) as refused:
        cohort_of(change(table), STUDY)
    assert str(refused.value).startswith(sentence)


ASK = pd.DataFrame({"v": [12.0, 20.0], "u": [0.25, 1.0], "name": ["one", "two"]}, index=["r1", "r2"])
X = np.array([[0.25, (12 - 10) / 10], [1.0, 1.0]])


def check_predicted(model, moments, chances):
    predicted = predict(STUDY, model, ASK)
    assert list(predicted.columns) == ["v", "u", "name", "mean", "sd", *(f"P({r})" for r in STUDY.responses)]
    assert all(is_reserved(name, STUDY.responses, False) for name in predicted.columns.drop([*ASK]))
    assert list(predicted.index) == ["r1", "r2"] and list(ASK.columns) == ["v", "u", "name"]
    np.testing.assert_allclose(predicted["mean"], moments[0], rtol=1e-12)
    np.testing.assert_allclose(predicted["sd"] ** 2, moments[1], rtol=1e-12)
    np.testing.assert_allclose(predicted.iloc[:, 5:], chances, rtol=1e-12)


def test_predictions_in_physical_units_are_those_of_the_unit_cube(one):
    check_predicted(one, one.predict(X), one.class_probabilities(X))


@pytest.mark.deep
def test_predictions_are_by_the_likelihood_that_was_fitted(aggregate, table):
    """Not by that of the study file, which a rule that learns does not use."""
    fitted = aggregate.posteriors.gp.likelihood.thresholds
    learnt = eqx.tree_at(lambda a: a.posteriors.gp.likelihood.thresholds, aggregate, fitted + 1.5)
    likelihood = eqx.tree_at(lambda one: one.thresholds, STUDY.gp.likelihood, STUDY.gp.likelihood.thresholds + 1.5)
    check_predicted(learnt, learnt.surface(X), learnt.class_probabilities(likelihood, X))
    constants = groups(STUDY, learnt.cohort, learnt.posteriors, 2)["constant_data"]
    np.testing.assert_allclose(constants["thresholds"], likelihood.thresholds, rtol=1e-12)


@pytest.mark.deep
def test_predictions_of_the_population_are_those_of_a_new_participant(aggregate):
    chances = aggregate.class_probabilities(STUDY.gp.likelihood, X)
    check_predicted(aggregate, aggregate.surface(X), chances)
    axes = Figure().subplots(1, 2)
    assert plot_map(STUDY, aggregate, ("v", "u"), ax=axes[0]) is axes[0]
    assert axes[0].get_xlabel() == "v" and axes[0].get_xlim() == (10, 20) and not axes[1].collections
    best = np.asarray(STUDY.space.to_physical(aggregate.optimum.x))
    np.testing.assert_allclose(axes[0].lines[0].get_xydata()[0], best[::-1])


@pytest.mark.deep
def test_a_persons_map_is_drawn_and_arviz_has_what_the_file_of_the_command_line_has(cohort, people, one):
    assert plot_map(STUDY, one).get_xlabel() == "u"
    with pytest.raises(InputError, match="give two of u, v"):
        plot_map(STUDY, one, ("u", "w"))
    data = inference_data(STUDY, cohort, people, draws=3)
    assert data.groups() == ["posterior", "posterior_predictive", "log_likelihood", "observed_data", "constant_data"]
    assert data.observed_data["response"].sizes == {"obs_id": int(cohort.counts().sum())}


def test_what_cannot_be_predicted_is_one_sentence(one, people):
    ask = ASK[["u", "v"]]
    for model, table, words in (
        (one, ask.assign(v=9.0), 'DataFrame: row 1: v is "9.0"; it must be a number from 10 to 20'),
        (one, ask[["u"]], 'DataFrame: column "v" is missing; a rendering of this study has u, v.'),
        (people, ask, "predict: the posterior is of several participants"),
    ):
        with pytest.raises(InputError) as refused:
            predict(STUDY, model, table)
        assert str(refused.value).startswith(words)
