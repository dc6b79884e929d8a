"""What the commands of `hilbo device` put out: words about devices and their sets, and files that are never overwritten
unasked."""

import os
from pathlib import Path
from typing import Any

from hilbo.errors import InputError

__all__ = ["check_free", "decoded", "said", "set_words", "write_table"]


def check_free(out: Path, force: bool) -> None:
    """Raises `InputError` where `out` cannot be written, or would be overwritten without `force`."""
    if out.exists() and not (force and out.is_file()):
        raise InputError(f"{out}: exists already; choose another file, or add --force to replace it.")
    if not out.resolve().parent.is_dir():
        raise InputError(f"{out}: there is no folder {out.resolve().parent}; make it, or choose another file.")


def write_table(table: Any, out: Path) -> None:
    """A pandas table as CSV, whole or not at all. Raises `InputError`."""
    part = out.with_name(f".{out.name}.part")
    try:
        table.to_csv(part, index=False)
        os.replace(part, out)
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}); choose another file.") from error


def said(name, value) -> str:
    if name in ("schema", "firmware", "boot_id"):
        return f"{value:08x}"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def set_words(found) -> str:
    length = f"N = {found.length}" if found.memory == "short" else f"full memory, {found.length} exponentials"
    return (
        f"K0 = {found.K0:.6g}, K1 = {found.K1:.6g} N/mm, B1 = {found.B1:.6g} N.s^alpha/mm, alpha = {found.alpha:.6g},"
        f" {length}; at most {found.force_limit:.4g} N; needs {found.needs:.4g} N.s/m"
    )


def decoded(row) -> str:
    seq = "  -" if row["seq"] is None else f"{row['seq']:3}"
    if row["message"] is None:
        return f"{row['byte']:8} {seq}  ?  {row['wrong']}"
    fields = "  ".join(f"{name}={_field(value)}" for name, value in row["fields"].items() if name != "reserved")
    return f"{row['byte']:8} {seq}  {row['message']:12} {fields}"


def _field(value) -> str:
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, float):
        return f"{value:.7g}"
    return (
        " ".join(f"({','.join(map(_field, row))})" for row in value) if isinstance(value, tuple | list) else str(value)
    )
