"""hilbo/data/columns.csv as a page: `python docs/site/columns.py` writes it."""

from pathlib import Path

from hilbo.study.file.columns import COLUMNS, EXPORTED, Meaning

PAGE = Path(__file__).parents[1] / "guides" / "columns.md"
HEAD = """\
# Data dictionary

Every column of the tables that `hilbo export` and `hilbo report` write. Sidecars of an export and `dictionary.csv` of a
report have the same words. Tables about renderings also have a column for each parameter, in its unit (of levels: their
names), with a renderer `K0` too; a validation table has `presented_a_NAME` and `presented_b_NAME` where a program or a
person presents; `confusion.csv` has a column for each response.

This page is made by `python docs/site/columns.py`; a test compares it.
"""


def page() -> str:
    """The page as Markdown."""
    parts = [HEAD]
    for head, tables in (
        ("Tables of `hilbo export`, `data/study-NAME_table-TABLE_data.csv`", EXPORTED),
        ("Tables of `hilbo report`, `TABLE.csv`", [name for name in COLUMNS if name not in EXPORTED]),
    ):
        parts.append(f"## {head}\n")
        parts += [f"### {name}\n\n{rows(COLUMNS[name])}" for name in tables]
    return "\n".join(parts)


def rows(columns: dict[str, Meaning]) -> str:
    """A row for each column of a table."""
    lines = ["| column | unit | meaning |", "|---|---|---|"]
    lines += [f"| `{name}` | {unit} | {words} |" for name, (unit, words) in columns.items()]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
