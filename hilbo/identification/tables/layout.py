"""What a table of an instrument does not say itself: kind of test, blocks to read, columns by hand, and geometry."""

from collections.abc import Sequence
from typing import NamedTuple

from hilbo.errors import InputError
from hilbo.identification.tables.headings import UNITS, Heading, heading, unit_of, without_unit

__all__ = ["Layout", "Renamed", "quoted", "renamed"]

_EXAMPLE = 'write it as QUANTITY=COLUMN, such as --column "force_N=Load"'


class Layout(NamedTuple):
    """What the user states about a table. `test`: relaxation or creep, for a table without a column `test`; `blocks`:
    numbers (from 1) of the blocks to read, one after the other; `columns`: texts QUANTITY=COLUMN, the column with a
    minus sign before it to turn its sign; `area` (mm²) and `gap` (mm): the sample's, for stress and strain."""

    test: str | None = None
    blocks: tuple[int, ...] = ()
    columns: tuple[str, ...] = ()
    area: float | None = None
    gap: float | None = None


class Renamed(NamedTuple):
    """A column that the user names: the quantity, its unit ("" for the column's own), the column's name or its name
    without unit, and whether its sign is turned."""

    quantity: str
    unit: str
    column: str
    turned: bool

    def among(self, names: Sequence[str]) -> str | None:
        """The one of the `names` that is meant: the same text, or the only one with that name before its unit; None if
        there is none."""
        if self.column in names:
            return self.column
        alike = [name for name in names if self.column == without_unit(name)[0]]
        return alike[0] if len(alike) == 1 else None

    def heading(self, column: str, where: str) -> Heading:
        """The column as a heading. Raises `InputError`, which begins with `where`, for two different units."""
        own = without_unit(column)[1]
        if self.unit and own and self.unit != own:
            raise InputError(
                f'{where}column "{column}" has the unit "{own}", and --column gives it the unit "{self.unit}"; leave'
                " one of them out."
            )
        return Heading(column, self.column, self.quantity, self.unit or own, -1.0 if self.turned else 1.0)


def renamed(layout: Layout, names: Sequence[str] = ()) -> list[Renamed]:
    """The columns of `Layout.columns`; a minus sign turns the sign unless one of the `names` begins with it. Raises
    `InputError` for a text of another form, and for a quantity twice."""
    result: list[Renamed] = []
    for text in layout.columns:
        left, equals, column = text.partition("=")
        head, column = heading(left), column.strip()
        if head is None or not equals or not column:
            raise InputError(f'--column is "{text}"; {_EXAMPLE}, with one of {", ".join(_NAMED)}.')
        if head.unit and not head.usable:
            allowed = ", ".join(UNITS[head.quantity])
            raise InputError(f'--column is "{text}", with the unit "{head.unit}"; write one of {allowed}.')
        if head.quantity in (one.quantity for one in result):
            raise InputError(f"--column names the {head.quantity} twice; keep one.")
        turned = column.startswith("-") and column not in names
        result.append(
            Renamed(head.quantity, unit_of(head.unit), column.removeprefix("-") if turned else column, turned)
        )
    return result


def quoted(names: Sequence[str], most: int = 12) -> str:
    """Names in quotation marks, at most so many."""
    return ", ".join(f'"{name}"' for name in names[:most]) + (", …" if len(names) > most else "")


_NAMED = ("time", "position", "force", "strain", "stress", "modulus", "compliance")
