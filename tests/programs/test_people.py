"""Ids of participants are in no words of a program: the cache of programs is read by whoever has the computer."""

import contextlib

import jax.numpy as jnp
import pandas as pd
import pytest
from live import STUDY

from hilbo.numerics.tracing import keep_with
from hilbo.programs.description import NotKeptError, describe
from hilbo.study.analysis.tolerance import best_mid_worst
from hilbo.study.cohort import cohort_of
from hilbo.study.estimate.aggregate import aggregate_cohort


@pytest.fixture
def words():
    """The words of every program that is called."""
    listed = []

    def describing(function, args, kwargs):
        with contextlib.suppress(NotKeptError):
            listed.append(describe(function, args, kwargs))

    keep_with(describing)
    yield listed
    keep_with(None)


@pytest.mark.deep
def test_no_program_of_an_analysis_names_participants(words):
    rows = [(f"zq{i}", t, STUDY.responses[t % 3], 0.1 * t + 0.05 * i, 0.5) for i in (1, 2) for t in (1, 2, 3)]
    table = pd.DataFrame(rows, columns=["participant", "trial", "response", "u", "v"])
    aggregate = aggregate_cohort(STUDY, cohort_of(table, STUDY), alternatives=False)
    points = jnp.asarray(STUDY.space.latin_hypercube(32, 0))
    best_mid_worst(STUDY, aggregate.surface, points, known=2.0, prior=aggregate.map.map_prior)
    assert len(words) > 5 and not [text for text in words if "zq" in text]
