"""`hilbo aggregate` and `hilbo report` fit each model to each data set once; a prefix of the trials is other data.

Deep: a program that counts cannot be kept in the compile cache."""

import pytest
from fits import count_fits
from studies import answered, plain_study

from hilbo.report.results import write_results
from hilbo.report.study.report import write_study
from hilbo.study.analysis import analysis
from hilbo.study.analysis.cohort_results import analyse_cohort
from hilbo.study.folder import Material, StudyFolder
from hilbo.study.robustness.optimised import fixed_and_optimised

pytestmark = [pytest.mark.deep, pytest.mark.empties_caches]
PEOPLE, TRIALS = 3, 6


def test_aggregate_fits_each_model_to_each_data_once(tmp_path):
    study = plain_study(2)
    with count_fits() as fits:
        write_results(analyse_cohort(study, answered(study, PEOPLE, TRIALS)), tmp_path)
    assert {key: count for key, count in fits.items() if count > 1} == {}
    for trials in (TRIALS, TRIALS - 1):  # everybody's own, in each prefix
        assert sum(key.startswith(f"{trials} answers, laplace") for key in fits) == PEOPLE
    assert sum(key.startswith(f"{TRIALS} answers, ep") for key in fits) == PEOPLE


def test_report_fits_each_model_to_each_data_once(tmp_path, monkeypatch):
    """With every rule compared, each person left out in turn; and the search for hyperparameters, which differentiates
    its fits, by itself."""
    study = plain_study(2)
    cohort = answered(study, PEOPLE, TRIALS)
    with count_fits() as searched:
        both = fixed_and_optimised(study, cohort)
    assert searched and set(searched.values()) == {1}
    monkeypatch.setattr(analysis, "fixed_and_optimised", lambda study, cohort: both)
    material = Material("", study, cohort, None, None)
    with count_fits() as fits:
        write_study(StudyFolder(study, [material], None, ()), tmp_path)
    assert {key: count for key, count in fits.items() if count > 1} == {}
    # the hierarchical fit without each person; the pooled one is made from counts of answers, which are not seen here
    assert sum(key.startswith(f"{(PEOPLE - 1) * TRIALS} answers, laplace") for key in fits) == PEOPLE
