"""A new file of a command: written whole or not at all, and never over another file without `--force`."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

from hilbo.errors import InputError
from hilbo.study.disk import new_file as disk

__all__ = ["check_free", "new_file", "write_new"]


def check_free(out: Path, force: bool) -> None:
    """Raise `InputError` if `out` cannot be written, or would be overwritten without `force`."""
    if out.exists() and not out.is_file():
        raise InputError(f"{out}: is no file; choose another one.")
    if out.exists() and not force:
        raise InputError(_exists(out))
    folder = out.resolve().parent
    if not folder.is_dir():
        wrong = "is a file" if folder.exists() else "does not exist"
        raise InputError(f"{out}: cannot be written ({folder} {wrong}); make that folder, or choose another file.")


@contextlib.contextmanager
def new_file(out: Path, force: bool) -> Iterator[Path]:
    """A path beside `out` to write to, which is renamed to `out` when the block ends well, and removed otherwise.
    Raises `InputError` if that fails, also where `out` exists by then and `force` is not given."""
    try:
        with disk.new_file(out, replace=force) as unfinished:
            yield unfinished
    except FileExistsError as error:
        raise InputError(_exists(out)) from error
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}); choose another file.") from error


def write_new(out: Path, text: str, force: bool) -> None:
    """Write a whole UTF-8 file, as `new_file` does. Raises `InputError`."""
    with new_file(out, force) as path:
        path.write_text(text, encoding="utf-8")


def _exists(out: Path) -> str:
    """The error sentence for a file that exists."""
    return f"{out}: exists already; choose another file, or add --force to replace it."
