"""The data dictionary has every column of every table of a report."""

import numpy as np
import pandas as pd
import pytest
from studies import PLAIN, paper_counts, plain

from hilbo.report.study.comparison import _COLUMNS
from hilbo.report.study.dictionary import dictionary
from hilbo.report.validation import validate, validation_csv
from hilbo.study.config import Study


def test_every_column_has_a_unit_and_a_meaning():
    tables = {"confusion": pd.DataFrame(columns=["set", "different", "similar", "close"])}
    tables["comparison"] = pd.DataFrame(columns=["rule", *_COLUMNS, "u", "most_influential", "refused"])
    shown = dictionary(tables, plain())
    assert len(shown) == sum(len(table.columns) for table in tables.values())
    assert (shown["meaning"].str.len() > 3).all() and set(shown["table"]) == {"comparison.csv", "confusion.csv"}
    assert shown[shown["column"] == "close"]["meaning"].iloc[0] == 'in which the response was "close"'


def test_what_may_end_an_interval_is_what_the_study_has():
    def said(study):
        tables = {"tolerance": pd.DataFrame(columns=["low_end"]), "optima": pd.DataFrame(columns=["location"])}
        return dictionary(tables, study)["meaning"].tolist()

    between = Study.from_dict(PLAIN | {"constraints": [{"terms": {"u": 10.0, "v": 1.0}, "most": 20.0}]})
    assert said(plain())[0] == "reason of the lower end: another response or the range"
    assert said(between)[0] == "reason of the lower end: another response, the range or a constraint"
    assert "constraint boundary" in said(between)[1] and "constraint" not in said(plain())[1]
    assert said(Study.load("hilbo/data/paper.toml"))[0].endswith("the range or the passive boundary")


@pytest.mark.deep
def test_the_tables_of_validation_sessions_are_explained():
    tables = validation_csv(validate(paper_counts(np.random.default_rng(4), ties=20)))
    assert (dictionary(tables, plain())["meaning"].str.len() > 3).all() and "table_IV" in tables


def test_a_column_that_nobody_explains_is_an_error():
    with pytest.raises(KeyError):
        dictionary({"people": pd.DataFrame(columns=["mood"])}, plain())
