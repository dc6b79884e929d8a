"""dictionary.csv: unit and meaning of every column of a report's tables, from `hilbo.study.file.columns`.

A column without an entry is an error, so that no table is written with an unexplained column.
"""

from collections.abc import Mapping

import pandas as pd

from hilbo.study.config import Study
from hilbo.study.file.columns import Meaning, meanings

__all__ = ["dictionary"]


def dictionary(tables: Mapping[str, pd.DataFrame], study: Study) -> pd.DataFrame:
    """The rows of dictionary.csv, one for each column of the `tables`: `table`, `column`, `unit`, `meaning`.

    Raises `KeyError` for a column without an entry.
    """
    rows = []
    for name, table in tables.items():
        known = meanings(name, study.file.space)
        if name == "confusion":  # whose first column has another name where a response is called as it
            counts: dict[str, Meaning] = {
                label: ("comparisons", f'in which the response was "{label}"') for label in study.responses
            }
            known = counts | {str(table.columns[0]): known["set"]}
        for column in map(str, table.columns):
            unit, meaning = known[column]
            rows.append({"table": f"{name}.csv", "column": column, "unit": unit, "meaning": meaning})
    return pd.DataFrame(rows)
