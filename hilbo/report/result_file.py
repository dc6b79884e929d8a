"""Content as JSON: result.json of all commands, and text for `--json`, for any number of participants."""

from collections.abc import Iterator
from pathlib import Path

from hilbo.report.json_text import quoted
from hilbo.report.participants import People
from hilbo.study.formats.json_file import Content
from hilbo.study.formats.json_file import sealed as with_digest

__all__ = ["as_json", "json_lines", "write_result"]


def write_result(content: Content, folder: Path, *, sealed: bool = False) -> None:
    """Write result.json into an existing folder, over an earlier one. `sealed`: with a digest of the text as the last
    key, for files that other commands read. Raises `OSError`.
    """
    lines = json_lines(content)
    with (folder / "result.json").open("w", encoding="utf-8") as file:
        file.writelines(with_digest(lines) if sealed else lines)


def as_json(content: Content) -> str:
    """The text of result.json; numbers that are not finite (after a failed fit) are null. `People` become a list."""
    return "".join(json_lines(content))


def json_lines(content: Content) -> Iterator[str]:
    """The text of result.json in pieces, one key or one participant at a time; `People` are written one entry at a
    time, so that they are never all in memory.
    """
    yield "{"
    for i, (key, value) in enumerate(content.items()):
        yield f"{',' if i else ''}\n  {quoted(key)}: "
        if isinstance(value, People):
            for j, entry in enumerate(value.entries()):
                yield f"{',' if j else '['}\n    {quoted(entry)}"
            yield "\n  ]"
        else:
            yield quoted(value, indent=2).replace("\n", "\n  ")
    yield "\n}\n"
