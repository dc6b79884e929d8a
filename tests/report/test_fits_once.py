"""`hilbo aggregate` and `hilbo report` fit each model to each data set once; a prefix of the trials is other data."""

import pytest
from fits import count_fits
from studies import answered, plain_study

from hilbo.report.comparison import write_comparison
from hilbo.report.results import write_results
from hilbo.report.study import write_study
from hilbo.study.analysis import analyse_population
from hilbo.study.folder import Material, StudyFolder

PEOPLE, TRIALS = 3, 6


@pytest.fixture(scope="module")
def study():
    return plain_study(2)


def once(fits):
    """Everybody's own answers, everybody's by the other inference, all answers, and prefixes were fitted; once each."""
    assert len(fits) > 2 * PEOPLE
    again = {key: count for key, count in fits.items() if count > 1}
    assert again == {}


def test_aggregate_fits_each_model_to_each_data_once(study, tmp_path):
    with count_fits() as fits:
        write_results(analyse_population(study, answered(study, PEOPLE, TRIALS)), tmp_path)
    once(fits)
    assert sum(key.startswith(f"{TRIALS} answers, laplace") for key in fits) == PEOPLE
    assert sum(key.startswith(f"{TRIALS - 1} answers, laplace") for key in fits) == PEOPLE


@pytest.mark.deep
def test_compare_and_report_fit_each_model_to_each_data_once(study, tmp_path):
    cohort = answered(study, PEOPLE, TRIALS)
    with count_fits() as fits:
        population = analyse_population(study, cohort)
        write_comparison(study, population.aggregate, tmp_path)
    once(fits)
    material = Material("", study, cohort, None, None, "")
    with count_fits() as fits:
        write_study(StudyFolder(study, [material], None, ()), tmp_path)
    once(fits)
