"""result.json of every command, and other content as JSON: how it is written, however many participants it has."""

from collections.abc import Iterator
from pathlib import Path

from hilbo.report.json_text import quoted
from hilbo.report.participants import People
from hilbo.study.formats.json_file import Content
from hilbo.study.formats.json_file import sealed as with_digest

__all__ = ["as_json", "json_lines", "write_result"]


def write_result(content: Content, folder: Path, *, sealed: bool = False) -> None:
    """Write result.json into a results folder. `sealed`: with a digest, for what other commands read."""
    lines = json_lines(content)
    with (folder / "result.json").open("w", encoding="utf-8") as file:
        file.writelines(with_digest(lines) if sealed else lines)


def as_json(content: Content) -> str:
    """The text of result.json; a number that is not finite (after a failed fit) is null."""
    return "".join(json_lines(content))


def json_lines(content: Content) -> Iterator[str]:
    """The text of result.json piece by piece; `People` are written one entry at a time."""
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
