"""Trial tables, cohorts, and aggregation of prefixes and subsets, against one person at a time."""

import dataclasses
import tomllib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

from hilbo import bcm
from hilbo.errors import InputError
from hilbo.ordinal_gp import Trials, fit
from hilbo.search.apart import nrmse
from hilbo.session.choose.ask_tell import physical_trials
from hilbo.study.analysis.progress import follow
from hilbo.study.cohort import cohort_of, read_trials
from hilbo.study.config import Study
from hilbo.study.estimate import aggregate
from hilbo.study.estimate.aggregate import aggregate_cohort, fit_cohort
from hilbo.study.estimate.optimum import predict_people
from hilbo.study.tables.trials import write_trials

STUDY = Study.load("hilbo/data/paper.toml")


def table(people=3, trials=6, seed=0):
    rng = np.random.default_rng(seed)
    x = STUDY.space.to_physical(STUDY.space.candidates(people * trials, seed))
    frame = pd.DataFrame(np.asarray(x), columns=list(STUDY.space.names))
    frame.insert(0, "response", rng.choice(STUDY.responses, people * trials))
    frame.insert(0, "trial", np.tile(np.arange(1, trials + 1), people))
    frame.insert(0, "participant", np.repeat([f"P{j}" for j in range(people)], trials))
    return frame


def written(tmp_path, frame, name="trials.csv") -> Path:
    path = tmp_path / name
    write_trials(frame, path)
    return path


@pytest.mark.parametrize("name", ["trials.csv", "trials.parquet"])
def test_a_table_comes_back_bit_for_bit(tmp_path, name):
    frame = table()
    back = read_trials(written(tmp_path, frame, name), STUDY)
    for column in STUDY.space.names:
        np.testing.assert_array_equal(back[column].to_numpy(), frame[column].to_numpy())
    assert list(back["category"]) == [STUDY.responses.index(r) for r in frame["response"]]


def test_warm_up_and_voided_rows_are_not_fitted(tmp_path):
    frame = table()
    frame["phase"] = ["warm-up", "optimisation"] * 9
    frame["trial"] = frame["trial"]
    frame["voided"] = [0] * 17 + [1]
    assert len(read_trials(written(tmp_path, frame), STUDY)) == 8


def test_ranks_are_allowed_where_no_label_reads_as_a_number(tmp_path):
    frame = table()
    frame["response"] = [STUDY.responses.index(r) + 1 for r in frame["response"]]
    assert read_trials(written(tmp_path, frame), STUDY)["category"].tolist() == (frame["response"] - 1).tolist()


def spoiled(column, row, value):
    def spoil(frame):
        frame = frame.astype(object)
        frame.loc[row, column] = value
        return frame

    return spoil


BAD = {
    "response not in the list": (spoiled("response", 3, "closer"), 'csv:5: response is "closer"'),
    "text in a parameter": (spoiled("K1", 0, "soft"), 'csv:2: K1 is "soft"'),
    "NaN in a parameter": (spoiled("K1", 2, "nan"), 'csv:4: K1 is "nan"'),
    "value outside its bounds": (spoiled("alpha", 4, 1.5), 'csv:6: alpha is "1.5".*from 0.01 to 0.99'),
    "trial that is no count": (spoiled("trial", 4, 0), 'csv:6: trial is "0"'),
    "no participant": (spoiled("participant", 4, ""), "csv:6: participant is empty"),
    "duplicated key": (lambda f: pd.concat([f, f.iloc[[2]]]), "csv:20: participant P0, trial 3 is in line 4"),
    "missing column": (lambda f: f.drop(columns="B1"), 'csv:1: column "B1" is missing'),
    "empty table": (lambda f: f.iloc[:0], "has no rows"),
    "several materials": (lambda f: f.assign(material=["foam"] * 9 + ["silicone"] * 9), "2 materials"),
    "odd flag": (lambda f: f.assign(voided="perhaps"), 'csv:2: voided is "perhaps"'),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_tables_are_refused_in_one_sentence(tmp_path, what):
    spoil, words = BAD[what]
    with pytest.raises(InputError, match=words) as caught:
        read_trials(written(tmp_path, spoil(table())), STUDY)
    assert "\n" not in str(caught.value)


def test_unreadable_files_are_refused(tmp_path):
    (tmp_path / "noise.parquet").write_bytes(b"not a table")
    (tmp_path / "empty.csv").write_text("")
    for name in ("absent.csv", "noise.parquet", "empty.csv"):
        with pytest.raises(InputError, match=name):
            read_trials(tmp_path / name, STUDY)


@pytest.fixture(scope="module")
def cohort(tmp_path_factory):
    frame = table(people=4, trials=9)
    frame = frame[~((frame["participant"] == "P2") & (frame["trial"] > 5))]  # unequal numbers of trials
    return cohort_of(read_trials(written(tmp_path_factory.mktemp("cohort"), frame), STUDY), STUDY)


def test_a_batch_is_its_people(cohort):
    posteriors = fit_cohort(STUDY, cohort)
    each, trials = (jax.tree.map(np.asarray, stacked) for stacked in (posteriors, cohort.trials))
    assert cohort.counts().tolist() == [9, 9, 5, 9]
    x = jnp.asarray(STUDY.space.candidates(20, 5))
    means, variances = [], []
    for j, count in enumerate(cohort.counts()):
        alone = fit(STUDY.gp, Trials.from_arrays(trials.x[j, :count], trials.q[j, :count]))
        mean, variance = alone.predict(x)
        batch = jax.tree.map(lambda leaf, j=j: jnp.asarray(leaf[j]), each)
        np.testing.assert_allclose(batch.predict(x)[0], mean, atol=1e-12)
        np.testing.assert_allclose(batch.predict(x)[1], variance, atol=1e-12)
        means.append(np.asarray(mean))
        variances.append(np.asarray(variance))
    expected = bcm.combine(jnp.asarray(np.stack(means)), jnp.asarray(np.stack(variances)), 1.0)
    moments = predict_people(posteriors, x)
    np.testing.assert_allclose(moments[0], expected[0], atol=1e-11)
    np.testing.assert_allclose(moments[1], expected[1], atol=1e-11)


def test_prefixes_and_subsets(cohort):
    assert cohort.first(6).counts().tolist() == [6, 6, 5, 6]
    assert cohort.of(["P3", "P2"]).counts().tolist() == [9, 5]
    with pytest.raises(InputError, match='"P9" is not in the table'):
        cohort.of(["P9"])


@pytest.mark.deep
def test_the_optimum_is_where_the_map_is_highest(cohort):
    aggregate = aggregate_cohort(STUDY, cohort)
    many = jnp.asarray(STUDY.space.candidates(8192, 9))
    mean, _ = predict_people(aggregate.posteriors, many)
    assert float(aggregate.optimum.mean) >= float(mean.max())
    assert bool(STUDY.space.feasible(aggregate.optimum.x))
    assert set(aggregate.alternatives) == {"average", "hierarchical", "pooled", "ep"}
    assert aggregate.share is not None and 0 < float(aggregate.share.mean) < 1
    progress = follow(STUDY, aggregate, 0, [5, 9])
    np.testing.assert_array_equal(progress.population[-1], aggregate.optimum.x)
    np.testing.assert_array_equal(progress.individual[-1], aggregate.individuals.x)
    after = aggregate_cohort(STUDY, cohort.first(5), alternatives=False)
    np.testing.assert_array_equal(progress.population[0], after.optimum.x)
    np.testing.assert_array_equal(progress.individual[0], after.individuals.x)
    assert progress.moments == [5, 9]


@pytest.mark.parametrize("inference", ["ep", pytest.param("exact", marks=pytest.mark.deep)])
def test_a_study_may_ask_for_another_inference(cohort, inference):
    study = dataclasses.replace(STUDY, inference=inference)
    posteriors = fit_cohort(study, cohort)
    assert bool(jnp.all(posteriors.certificate.converged))
    x = jnp.asarray(STUDY.space.candidates(20, 5))
    others = fit_cohort(STUDY, cohort, inference="ep"), fit_cohort(STUDY, cohort)
    kinds = [[(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(fits)] for fits in others]
    assert kinds[0] == kinds[1]  # so that one program serves both
    here, by_ep, by_laplace = (np.asarray(predict_people(fits, x)[0]) for fits in (posteriors, *others))
    assert np.max(np.abs(here - by_ep)) < 0.1 * np.max(np.abs(here - by_laplace))


def test_nrmse_is_the_root_mean_square():
    assert float(nrmse(jnp.array([0.1, 0.5, 0.4]), jnp.array([0.1, 0.2, 0.8]))) == pytest.approx(np.sqrt(0.25 / 3))


def test_a_cohort_has_the_bits_of_its_sessions():
    """What a person's own session makes of the physical values, on linear and logarithmic scales."""
    content = tomllib.loads(Path("hilbo/data/paper.toml").read_text())
    content["parameters"]["B1"]["scale"] = "log"
    for study in (STUDY, Study.from_dict(content)):
        frame = table(people=5, trials=7)
        frame["category"] = np.arange(35) % 3
        del frame["response"]  # else the two have to agree
        cohort = cohort_of(frame.sample(frac=1, random_state=0).sort_values("trial", kind="stable"), study)
        for j, name in enumerate(cohort.names):
            rows = frame[frame["participant"] == name]
            points = rows[list(study.space.names)].to_numpy()
            alone = physical_trials(study, points, rows["category"].to_numpy(), 25)
            one = jax.tree.map(lambda leaf, j=j: leaf[j], cohort.trials)
            jax.tree.map(np.testing.assert_array_equal, one, alone)
            np.testing.assert_array_equal(cohort.physical[j, :7], points)


def test_a_large_cohort_is_fitted_in_batches_to_the_same_results(monkeypatch):
    """Above `MANY` people, here two of five: the last batch is filled up, and nothing of that is left."""
    cohort, counted = cohort_of(table(5), STUDY), []
    whole = aggregate_cohort(STUDY, cohort, alternatives=False)
    assert whole.asked_variance is not None
    monkeypatch.setattr(aggregate, "MANY", 2)
    parts = aggregate_cohort(STUDY, cohort, alternatives=False, say=lambda *what: counted.append(what[1:]))
    np.testing.assert_allclose(parts.optimum.x, whole.optimum.x, rtol=0, atol=1e-7)
    np.testing.assert_allclose(parts.individuals.x, whole.individuals.x, rtol=0, atol=1e-7)
    assert parts.posteriors.trials.mask.shape == whole.posteriors.trials.mask.shape
    assert counted == [(2, 5), (4, 5), (5, 5)] * 2
    assert parts.asked_variance is None


def test_optima_that_were_not_sought_are_missed_in_a_sentence():
    found = aggregate_cohort(STUDY, cohort_of(table(), STUDY), alternatives=False, individuals=False)
    assert found.own is None
    with pytest.raises(InputError, match="were not computed; aggregate with individuals=True"):
        _ = found.mean_of_optima
