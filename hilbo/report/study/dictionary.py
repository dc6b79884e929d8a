"""dictionary.csv: unit and meaning of every column of a report's tables, from `hilbo.study.file.columns`.

A table that has a column without an entry is an error, so that no column is written that nobody explains.
"""

from collections.abc import Mapping

import pandas as pd

from hilbo.study.config import Study
from hilbo.study.file.columns import Meaning, meanings

__all__ = ["dictionary"]


def dictionary(tables: Mapping[str, pd.DataFrame], study: Study) -> pd.DataFrame:
    """A row for each column of the tables: `table`, `column`, `unit`, `meaning`. Raises KeyError for one without."""
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
