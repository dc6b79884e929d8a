"""Where the results of `hilbo device` go: stdout, and files that are never overwritten unasked."""

import json
import os
from pathlib import Path
from typing import Any

from hilbo.errors import InputError

__all__ = ["check_free", "finish", "write_table"]


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


def finish(content: Any, words: str, as_json: bool) -> None:
    """The result, for a machine or in words, on stdout."""
    if as_json:
        print(json.dumps(content, indent=2, allow_nan=False, default=float))
    elif words:
        print(words)
