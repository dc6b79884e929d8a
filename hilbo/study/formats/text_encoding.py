"""Encoding of text files that other programs wrote. Loads no JAX, no pandas."""

import re

from hilbo.errors import InputError

__all__ = ["decoded"]

_MARKS = (b"\xff\xfe", b"\xfe\xff")  # byte order marks of UTF-16
_SAMPLE = 2000  # bytes
_CONTROL = re.compile(r"[\x00-\x08\x0e-\x1f]")
_NULL = re.compile("\0")
_PADDED_END = re.compile(r"\x00(?=[\r\n])")  # line ends that a program has written in another encoding than the rest


def decoded(data: bytes, source: str) -> tuple[str, str]:
    """Decode a file: UTF-8, UTF-16 with or without a byte order mark, else Windows-1252. Returns the text, and the name
    of the encoding, "" for UTF-8. Raises `InputError` for bytes that are no text in any of them; `source`: the file."""
    sample = data[:_SAMPLE]
    zeros = [sample[k::2].count(0) for k in (0, 1)]
    likely = ("utf-8-sig", "")
    if data[:2] in _MARKS:
        likely = ("utf-16", "UTF-16")
    elif max(zeros) > len(sample) // 4:
        likely = ("utf-16-le" if zeros[1] > zeros[0] else "utf-16-be", "UTF-16")
    for codec, name in (likely, ("cp1252", "Windows-1252")):
        try:
            text = _PADDED_END.sub("", data.decode(codec))
        except UnicodeDecodeError:
            continue
        if not (_CONTROL if name else _NULL).search(text):
            return text, name
    raise InputError(f"{source}: is no text; export the table from its program as text or CSV.")
