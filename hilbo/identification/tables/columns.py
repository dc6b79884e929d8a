"""Choice of the columns of a table: which hold time, position and force, stress and strain, or a modulus."""

from collections.abc import Collection, Sequence
from typing import NamedTuple

from hilbo.errors import InputError
from hilbo.identification.tables.headings import AS_FORCE, UNITS, Heading, first_unit, heading
from hilbo.identification.tables.layout import Layout, quoted, renamed

__all__ = ["Columns", "quantity_columns"]

_LETTERS = {"t", "x", "F", "G", "J"}  # the usual symbols of the quantities
_CLOCKS = {"time", "step time"}
_ORDER = ("time", "position", "force", "strain", "stress", "modulus", "compliance")
_MODULI = {"modulus", "compliance"}
_GIVEN = {"time", *_MODULI}  # quantities of a table of moduli


class Columns(NamedTuple):
    """Columns by quantity: time with position and force, strain and stress, or moduli. `note`: which were chosen, ""
    if all have hilbo's own names and no other column could be meant."""

    heads: dict[str, Heading]
    note: str

    def of(self, *quantities: str) -> bool:
        """Whether it has all of these quantities."""
        return set(quantities) <= set(self.heads)


def quantity_columns(names: Sequence[str], layout: Layout, where: str) -> Columns:
    """Choose the columns of a table with these `names`. `where`: place of the header, for messages.

    Columns that the user names go first, then hilbo's own names, then those of instruments. Position and force are
    preferred to moduli, and these to stress and strain, unless the geometry is given. Raises `InputError` for units
    that are missing or unknown, and for columns that are missing or there twice.
    """
    heads = _candidates(names, layout, where)
    group = _group(heads, layout)
    if not group:
        raise InputError(_incomplete(names, heads, where))
    clocks = _CLOCKS & {head.quantity for head in heads}
    # Moduli are counted from their step; a recording may go on over several steps.
    clock = (min if group <= _MODULI else max)(clocks, key=lambda name: name == "time")
    selected: dict[str, Heading] = {}
    for head in heads:
        if head.quantity in group or head.quantity == clock:
            quantity = "time" if head.quantity == clock else head.quantity
            _check(head, selected.get(quantity), where)
            selected[quantity] = head
    return Columns(selected, _note(names, heads, selected))


def _candidates(names: Sequence[str], layout: Layout, where: str) -> list[Heading]:
    """Columns that may be chosen, in their order: at most one way to read each column. Raises `InputError` for a column
    that the user names and that is not there."""
    named: list[Heading] = []
    for one in renamed(layout, names):
        column = one.among(names)
        if column is None:
            raise InputError(f'{where}has no column "{one.column}" for --column; its columns are {quoted(names)}.')
        named.append(one.heading(column, where))
    settled = {head.quantity for head in named}
    settled |= _MODULI if settled & _MODULI else _CLOCKS if settled & _CLOCKS else set()
    taken = {head.column for head in named}
    free = [head for name in names if name not in taken and (head := heading(name)) is not None]
    free = [head for head in free if head.quantity not in settled]
    own = _without_other_letters([*named, *(head for head in free if head.own)])
    if _is_complete({head.quantity for head in own}) and not _has_geometry(layout):
        return [*own, *(head for head in free if head.quantity == "step time")]
    owned = {head.quantity for head in free if head.own and not head.short}
    return _without_other_letters([*named, *(head for head in free if head.own or head.quantity not in owned)])


def _without_other_letters(heads: Sequence[Heading]) -> list[Heading]:
    """The headings without one-letter names that denote another quantity, such as T (degC) or g: if another column has
    the quantity's full name and the letter is not its usual symbol, or if its unit is not a unit of the quantity and
    the table is complete without it."""
    full = {head.quantity for head in heads if not head.short}
    heads = [head for head in heads if not head.short or head.quantity not in full or head.name in _LETTERS]
    usable = {head.quantity for head in heads if head.usable}
    return [head for head in heads if head.usable or not head.short or not _is_complete(usable)]


def _is_complete(quantities: Collection[str]) -> bool:
    """Whether the quantities suffice without stress and strain: time, position and force; or time and moduli without
    position and force."""
    measured, derived = {"position", "force"} & set(quantities), _MODULI & set(quantities)
    return "time" in quantities and (len(measured) == 2 or bool(derived and not measured))


def _group(heads: Sequence[Heading], layout: Layout) -> set[str]:
    """The quantities besides time that are read; none if they do not suffice."""
    present = {head.quantity for head in heads}
    if not present & _CLOCKS:
        return set()
    if {"strain", "stress"} <= present and (_has_geometry(layout) or not present & (_MODULI | {"position"})):
        return {"strain", "stress"}
    if {"position", "force"} <= present:
        return {"position", "force"}
    if present & _MODULI and not any(head.own and head.quantity in ("position", "force") for head in heads):
        return present & _MODULI
    return {"strain", "stress"} if {"strain", "stress"} <= present else set()


def _has_geometry(layout: Layout) -> bool:
    """Whether the user gives the size of the sample, that is, wants stress and strain to be read."""
    return layout.area is not None or layout.gap is not None


def _incomplete(names: Sequence[str], heads: Sequence[Heading], where: str) -> str:
    """Sentence about a table without the quantities that are needed."""
    present = list(dict.fromkeys(head.quantity for head in heads))
    return (
        f"{where}a material table has time, position and force, or time and modulus or compliance, each with its unit"
        f" as in time_s; found {', '.join(present) or 'none of them'} among the columns {quoted(names)}: name the"
        ' others with their units, as by --column "force_N=NAME OF THE COLUMN".'
    )


def _check(head: Heading, other: Heading | None, where: str) -> None:
    """Raise `InputError` for a heading without a known unit, and for a second column of one quantity."""
    if not head.usable:
        allowed = ", ".join(UNITS[head.quantity])
        unit_text = f'has the unit "{head.unit}"' if head.unit else "has no unit"
        unit = first_unit(head.quantity)
        raise InputError(
            f'{where}column "{head.column}" {unit_text}; write it like "{head.name} ({unit})", with one of {allowed},'
            f' or give --column "{head.quantity}_{unit}={head.column}".'
        )
    if other is not None:
        raise InputError(
            f'{where}columns "{other.column}" and "{head.column}" both are a {head.quantity}; keep one, or choose it by'
            f' --column "{head.quantity}={head.column}".'
        )


def _note(names: Sequence[str], heads: Sequence[Heading], selected: dict[str, Heading]) -> str:
    """Remark on the chosen columns, and on those that could be meant and are not read; "" if there is nothing to
    say."""
    columns = {head.column for head in selected.values()}
    others = [head for name in names if name not in columns and (head := heading(name)) is not None]
    quantities = {other.quantity for other in others if not other.short}
    rivals = bool(quantities & set(selected)) or ({"strain", "stress"} <= quantities and not selected.keys() - _GIVEN)
    if not rivals and all(head.own and head.sign > 0 for head in selected.values()):
        return ""
    parts = [
        f'{quantity} from "{head.column}"{" with the other sign" if head.sign < 0 else ""}'
        for quantity in _ORDER
        if (head := selected.get(quantity)) is not None
    ]
    words = f"The table was read with {', '.join(parts)}"
    if unread := [head.column for head in others if not head.short]:
        words += f"; not read: {quoted(unread)}"
    for head in selected.values():
        if head.of_mass:
            words += f"; the unit {head.unit} of a force is {AS_FORCE[head.unit]} ({head.factor:g} N)"
    return f"{words}."
