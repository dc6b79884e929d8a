"""Hyperparameters of a pilot: the jackknife over participants, and what is refused."""

import dataclasses

import numpy as np
import pytest
from scipy import stats
from studies import answered, plain_study

from hilbo.errors import InputError
from hilbo.study.robustness.pilot import _interval, check_pilot


def test_the_jackknife_of_a_mean_is_its_t_interval():
    sample = np.random.default_rng(0).normal(3.0, 2.0, (7, 2))
    without = np.stack([np.delete(sample, i, axis=0).mean(axis=0) for i in range(len(sample))])
    expected = stats.t.interval(0.95, 6, sample.mean(axis=0), stats.sem(sample))
    np.testing.assert_allclose(_interval(sample.mean(axis=0), without), np.transpose(expected), rtol=1e-12)


def test_two_people_are_no_pilot():
    study = plain_study(2)
    with pytest.raises(InputError, match="2 participants gave responses; 3 or more are needed"):
        check_pilot(study, answered(study, people=2))
    check_pilot(study, answered(study, people=3))


def test_a_rule_that_learns_needs_no_pilot():
    study = plain_study(2)
    with pytest.raises(InputError, match="learns its hyperparameters from the study and needs no"):
        check_pilot(dataclasses.replace(study, rule="learnt-2"), answered(study, people=3))
