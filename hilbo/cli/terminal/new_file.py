"""A file that a command makes: never over another one unasked, and whole or not at all."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from hilbo.errors import InputError

__all__ = ["check_free", "new_file"]


def check_free(out: Path, force: bool) -> None:
    """Raises `InputError` where `out` cannot be written, or would be overwritten without `force`."""
    if out.exists() and not out.is_file():
        raise InputError(f"{out}: is no file; choose another one.")
    if out.exists() and not force:
        raise InputError(f"{out}: exists already; choose another file, or add --force to replace it.")
    folder = out.resolve().parent
    if not folder.is_dir():
        wrong = "is a file" if folder.exists() else "does not exist"
        raise InputError(f"{out}: cannot be written ({folder} {wrong}); make that folder, or choose another file.")


@contextlib.contextmanager
def new_file(out: Path) -> Iterator[Path]:
    """A path beside `out` to write to, which takes its place when the block ends well. Raises `InputError`."""
    unfinished = out.with_name(f".{out.name}.part")
    try:
        yield unfinished
        os.replace(unfinished, out)
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}); choose another file.") from error
    finally:
        with contextlib.suppress(OSError):
            unfinished.unlink(missing_ok=True)
