"""Blocks of a file: a header with the rows below it, its row of units, and the choice among several blocks."""

import itertools
import re
from collections.abc import Sequence
from typing import NamedTuple

from hilbo.errors import InputError
from hilbo.identification.tables.headings import heading, is_unit, unit_of, without_unit
from hilbo.identification.tables.layout import Layout
from hilbo.study.formats.csv_rows import check_header

__all__ = ["Block", "Rows", "chosen", "completed", "is_filled", "numerals"]

Rows = list[tuple[int, list[str]]]
"""Line on which a row begins, and its cells."""
_NUMERAL = re.compile(r"\s*([-+]?(\d+[.,]?\d*|[.,]\d+)([eE][-+]?\d+)?|[-+]?(nan|inf))\s*", re.IGNORECASE)
_TITLE = 50  # characters
_MOST = 20  # blocks in a message


class Block(NamedTuple):
    """A header and its rows. `title`: the two lines of text before it; `line` of the header; `names` of the columns,
    with the units of the row below them, which is in line `units` (0 without one); `left_out`: number of lines in the
    block that are no samples."""

    title: str
    line: int
    names: list[str]
    units: int
    rows: Rows
    left_out: int

    @property
    def oscillates(self) -> bool:
        """Whether it has a storage or a loss modulus."""
        return any((head := heading(name)) is not None and head.quantity == "oscillation" for name in self.names)


def is_filled(cells: Sequence[str]) -> bool:
    """Whether any cell has text."""
    return any(cell.strip() for cell in cells)


def numerals(cells: Sequence[str], columns: Sequence[int] | None = None) -> int:
    """Number of cells, of the columns at these positions (None: of all), that are numbers."""
    positions = range(len(cells)) if columns is None else columns
    return sum(_NUMERAL.fullmatch(cells[i]) is not None for i in positions if i < len(cells))


def completed(
    before: Rows, line: int, header: list[str], below: Rows, columns: Sequence[int], source: str, *, last: bool
) -> tuple[Block, Rows]:
    """A block and the lines of text after its rows. `before`: lines of text before its header; `below`: the lines after
    it; `columns`: positions of the quantities; `last`: no other block follows.

    Rows end with the last line that has two numbers, or numbers only; after that, text may follow, in the last block
    without a number below a quantity.
    Raises `InputError` for rows that are not as long as the header, and for a column with two different units.
    """
    has_units = bool(below) and _are_units(below[0][1], columns)
    units, below = (below[0], below[1:]) if has_units else ((0, []), below)
    counts = [_row_numerals(cells, columns) for _, cells in below]
    start = next((i for i, count in enumerate(counts) if count), len(below))
    end = max((i + 1 for i, count in enumerate(counts) if count >= (1 if last else 2)), default=start)
    names = _with_units(header, units[1], f"{source}:{line}: ")
    check_header([name for name in names if name], f"{source}:{line}")
    names, rows = _as_long(names, below[start:end], source)
    left_out = start + (len(below) - end if last else 0)
    texts = [" ".join(filter(None, map(str.strip, cells))) for _, cells in before if is_filled(cells)]
    title = ", ".join(texts[-2:])
    title = title if len(title) <= _TITLE else title[: _TITLE - 1] + "…"
    return Block(title, line, names, units[0], rows, left_out), below[end:]


def _row_numerals(cells: Sequence[str], columns: Sequence[int]) -> int:
    """Number of numbers in the quantities' columns; 2 at least for a line of numbers only, which may be a broken
    row."""
    count, filled = numerals(cells, columns), [cell for cell in cells if cell.strip()]
    return max(count, 2) if len(filled) == numerals(filled) else count


def _are_units(cells: Sequence[str], columns: Sequence[int]) -> bool:
    """Whether a row holds units: a known one below at least one quantity, and no number but 1, for a ratio."""
    below = [cells[i].strip() for i in columns if i < len(cells) and cells[i].strip() not in ("", "1")]
    return numerals(below) == 0 and any(map(is_unit, below))


def _with_units(header: Sequence[str], units: Sequence[str], where: str) -> list[str]:
    """Names of the columns with the units of the row below them in brackets. Raises `InputError` for a column with two
    different units."""
    names = []
    for i, name in enumerate(cell.strip() for cell in header):
        unit = units[i].strip() if i < len(units) else ""
        own = without_unit(name)[1]
        if own and unit and unit_of(unit) != own:
            raise InputError(f'{where}column "{name}" has the unit "{unit}" in the row below; delete one of the two.')
        names.append(f"{name} [{unit_of(unit)}]" if name and unit and not own else name)
    return names


def _as_long(names: list[str], rows: Rows, source: str) -> tuple[list[str], Rows]:
    """Names and rows of one length: columns without a name are left out if they are empty.

    One that is not, before the first name, is kept, as a program's index. Raises `InputError` for any other, and for a
    row of another length than the header. A longer row is never cut, since its cells may stand below other names.
    """
    named = len(names) - next((i for i, name in enumerate(reversed(names)) if name), len(names))
    if all(len(cells) == named for _, cells in rows):
        names = names[:named]
    for line, cells in rows:
        if len(cells) != len(names):
            raise InputError(f"{source}:{line}: has {len(cells)} cells, the header has {len(names)}; fix that line.")
    kept = []
    for i, name in enumerate(names):
        full = None if name else next(((line, cells[i]) for line, cells in rows if cells[i].strip()), None)
        if full is not None and any(names[:i]):
            raise InputError(
                f'{source}:{full[0]}: has a cell without a column name ("{full[1]}", the {i + 1}th); name its column,'
                " or write decimals with a point if commas separate the cells."
            )
        kept += [i] if name or full is not None else []
    return [names[i] for i in kept], [(line, [cells[i] for i in kept]) for line, cells in rows]


def chosen(blocks: Sequence[Block], layout: Layout, source: str) -> tuple[Block, str]:
    """The block to read, or the chosen ones as a single one, and a remark on which they are ("" if none was chosen).

    `layout.blocks`: their numbers, from 1, among the blocks that have rows. Raises `InputError` for several blocks
    without a choice, a number without a block, numbers that do not increase, and blocks of different columns.
    """
    filled = [block for block in blocks if block.rows] or list(blocks[:1])
    if not layout.blocks and len(filled) == 1:
        return _in_time(filled[0], source), ""
    listed = "; ".join(_description(i, block) for i, block in enumerate(filled[:_MOST], 1))
    listed += "; …" if len(filled) > _MOST else ""
    missing = next((number for number in layout.blocks if not 1 <= number <= len(filled)), None)
    if missing is not None or not layout.blocks:
        what = f"contains {len(filled)} blocks" if missing is None else f"has no block {missing}"
        raise InputError(
            f"{source}: {what} ({listed}); choose one by --block 1, or several that follow one another by --block 1"
            " --block 2."
        )
    if any(b <= a for a, b in itertools.pairwise(layout.blocks)):
        raise InputError("--block is given twice or not in order; name each block once, in the order of the file.")
    parts = [_in_time(filled[number - 1], source) for number in layout.blocks]
    first, rows = parts[0], [row for part in parts for row in part.rows]
    if other := next((n for n, part in zip(layout.blocks, parts, strict=True) if part.names != first.names), None):
        raise InputError(f"{source}: blocks {layout.blocks[0]} and {other} have different columns; read one alone.")
    words = " and ".join(map(str, layout.blocks))
    note = f"block{'s' if len(parts) > 1 else ''} {words} of {len(filled)} {'were' if len(parts) > 1 else 'was'} read"
    return first._replace(rows=rows, left_out=sum(part.left_out for part in parts)), note


def _description(number: int, block: Block) -> str:
    """A block in a list: number, title, line and rows."""
    title = f'"{block.title}", ' if block.title else ""
    return f"{number}: {title}line {block.line}, {len(block.rows)} rows{', oscillation' if block.oscillates else ''}"


def _in_time(block: Block, source: str) -> Block:
    """The block itself. Raises `InputError` for an oscillatory test."""
    if block.oscillates:
        raise InputError(
            f"{source}:{block.line}: is an oscillatory test (storage and loss modulus); hilbo identify needs a test in"
            " time: creep, relaxation, or G(t) or J(t)."
        )
    return block
