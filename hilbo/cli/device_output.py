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
    unfinished = out.with_name(f".{out.name}.part")
    try:
        table.to_csv(unfinished, index=False)
        os.replace(unfinished, out)
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}); choose another file.") from error


def said(name, value) -> str:
    """A field of HELLO's answer in words."""
    if name in ("schema", "firmware", "boot_id"):
        return f"{value:08x}"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def set_words(current) -> str:
    """A set in force (`InForce`) in a line, with units."""
    length = f"N = {current.length}" if current.memory == "short" else f"full memory, {current.length} exponentials"
    return (
        f"K0 = {current.K0:.6g}, K1 = {current.K1:.6g} N/mm, B1 = {current.B1:.6g} N.s^alpha/mm,"
        f" alpha = {current.alpha:.6g}, {length}; at most {current.force_limit:.4g} N; needs {current.needs:.4g} N.s/m"
    )


def decoded(row) -> str:
    """A frame of a capture in a line: its byte, its number, its message or what is wrong."""
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
