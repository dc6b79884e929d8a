"""Ids of participants are in no words of a program: the cache of programs is read by whoever has the computer."""

import contextlib

import pandas as pd
import pytest
from live import STUDY

from hilbo.numerics.tracing import keep_with
from hilbo.programs.description import NotKeptError, describe
from hilbo.study.analysis.analysis import analyse
from hilbo.study.cohort import cohort_of


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
    rows = [(f"zq{i}", t, STUDY.responses[t % 3], 0.1 * t + 0.05 * i, 0.5) for i in (1, 2, 3) for t in (1, 2, 3)]
    table = pd.DataFrame(rows, columns=["participant", "trial", "response", "u", "v"])
    analysis = analyse(STUDY, cohort_of(table, STUDY), comparison=True)
    assert len(analysis.progress.counts) == 3  # the thread of the optima after fewer trials has ended
    assert len(words) > 20 and not [text for text in words if "zq" in text]
