"""Folder of cached programs: complete, verified entries that are private to this user, up to a total size."""

import contextlib
import hashlib
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import msgspec

from hilbo.programs.private import is_private

__all__ = ["Entries", "Entry"]

_SIZE = 256 * 2**20  # bytes in all; an entry has 10,000 to 3,000,000
_SUFFIX = ".program"
_UNFINISHED = ".part"
_HOUR = 3600.0  # s; an entry is written in far less


class Entry(msgspec.Struct, forbid_unknown_fields=True):
    """Cached program: `words`, its key; the pickled structures of its arguments and results; and the compiled code."""

    words: str
    structure: bytes
    compiled: bytes


class Entries:
    """Cached programs in the files of a folder, up to `size` bytes together.

    The folder is created by `write`, private to this user. `remark` is called with a sentence about each problem; no
    problem with the disk is raised by `read` and `write`.
    """

    def __init__(self, folder: Path, remark: Callable[[str], None], size: int = _SIZE):
        self.folder, self._remark, self._size = folder, remark, size

    def read(self, words: str) -> Entry | None:
        """Entry with the key `words`; None if it is missing, damaged or not private to this user.

        Marks the entry as recently used. A remark is made about a damaged entry and about one that another user could
        change.
        """
        path = self._path(words)
        try:
            if not is_private(self.folder) or not is_private(path):
                self._remark(f"{path}: belongs to, or may be changed by, another user; it is not used.")
                return None
            content = path.read_bytes()
        except OSError:
            return None
        digest, body = content[:32], content[32:]
        try:
            entry = msgspec.msgpack.decode(body, type=Entry)
        except (msgspec.MsgspecError, UnicodeDecodeError):
            entry = None
        if entry is None or hashlib.sha256(body).digest() != digest or entry.words != words:
            self._remark(f"{path}: is damaged; the program is made again.")
            return None
        with contextlib.suppress(OSError):
            os.utime(path)
        return entry

    def write(self, entry: Entry) -> None:
        """Write an entry atomically, then delete the least recently used ones beyond the size limit.

        If the folder is not private to this user or cannot be written, a remark is made and nothing is written.
        """
        body = msgspec.msgpack.encode(entry)
        try:
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            if not is_private(self.folder):
                self._remark(f"{self.folder}: belongs to, or may be changed by, another user; nothing is kept there.")
                return
            # Not by hilbo.study.disk: what a power failure loses of a cache is made again, and is known by its digest.
            handle, name = tempfile.mkstemp(suffix=_UNFINISHED, dir=self.folder)
            try:
                with os.fdopen(handle, "wb") as file:
                    file.write(hashlib.sha256(body).digest() + body)
                os.replace(name, self._path(entry.words))
            except BaseException:
                os.unlink(name)
                raise
            self._drop()
        except OSError as error:
            self._remark(f"{self.folder}: programs cannot be kept there ({error.strerror}).")

    def sizes(self) -> dict[Path, int]:
        """Size (bytes) of each entry's file, least recently used first; empty if there is no folder."""
        entries = []
        for path in self.folder.glob(f"*{_SUFFIX}"):
            with contextlib.suppress(FileNotFoundError):  # another process drops it
                entries.append((path.stat().st_mtime_ns, path, path.stat().st_size))
        return {path: size for _, path, size in sorted(entries)}

    def clear(self) -> None:
        """Delete all entries of the folder, unfinished ones too."""
        for path in (*self.sizes(), *self.folder.glob(f"*{_UNFINISHED}")):
            path.unlink(missing_ok=True)

    def _drop(self) -> None:
        """Delete the least recently used entries beyond the size limit, and what killed processes did not finish."""
        for path in self.folder.glob(f"*{_UNFINISHED}"):
            with contextlib.suppress(FileNotFoundError):
                if time.time() - path.stat().st_mtime > _HOUR:
                    path.unlink()
        sizes = self.sizes()
        total = sum(sizes.values())
        for path, size in sizes.items():
            if total <= self._size:
                break
            path.unlink(missing_ok=True)
            total -= size

    def _path(self, words: str) -> Path:
        """File of the entry with this key, whether it exists or not."""
        return self.folder / f"{hashlib.sha256(words.encode()).hexdigest()}{_SUFFIX}"
