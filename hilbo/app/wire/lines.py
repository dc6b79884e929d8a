"""The stimulus program's messages for clients without a JSON parser: a form as request, lines of text as response.

    order=5&state=presented&value.hue=211.0     a request, application/x-www-form-urlencoded
    status TAB 200, order TAB 6, do TAB neutral its answer, text/plain: a line each, fields between tabs

HTTP's own status is 200 in every such answer, and the first line has the real one: libraries that post forms often
withhold the text of an answer with another status. docs/guides/stimulus.md has every line.
"""

from collections.abc import Iterator, Mapping
from typing import Any
from urllib.parse import parse_qsl

from hilbo.errors import InputError

__all__ = ["FORM", "fields_of", "lines_of", "number_or_name"]

FORM = "application/x-www-form-urlencoded"
_VALUE = "value."  # before a parameter's name
_MOST = 64  # fields of a form


def fields_of(body: bytes) -> dict[str, Any]:
    """The fields of a form as name -> text; those named "value.NAME" are together in `values`, NAME -> text. Raises
    `InputError` for text that is not a form, has a field twice, or too many."""
    try:
        pairs = parse_qsl(
            body.decode(), keep_blank_values=True, strict_parsing=bool(body), errors="strict", max_num_fields=_MOST
        )
    except ValueError as error:
        raise InputError(f"The form is not understood: {error}.") from None
    fields: dict[str, Any] = {}
    values: dict[str, str] = {}
    for key, text in pairs:
        name = key.removeprefix(_VALUE)
        place = fields if name == key else values
        if name in place:
            raise InputError(f"The form has {key} twice.")
        place[name] = text
    return fields | ({"values": values} if values else {})


def lines_of(status: int, content: Mapping[str, Any]) -> str:
    """The content of a response, a dict as for JSON, as lines of fields between tabs; the first has the status."""
    return "".join("\t".join(map(_field, line)) + "\n" for line in (("status", status), *_lines(content)))


def _lines(content: Mapping[str, Any]) -> Iterator[tuple[Any, ...]]:
    """Yield the fields of each line but the first: (key, value) for each key of a response's content, and lines of
    their own for each entry of `values` and each of `parameters`."""
    for key, value in content.items():
        if key == "values":
            yield from (("value", name, number) for name, number in value.items())
        elif key == "parameters":
            yield from map(_parameter, value)
        else:
            yield key, value


def number_or_name(text: str) -> float | str:
    """A value of a form: a number, or the text itself, the name of a level, if it is no number."""
    try:
        return float(text)
    except ValueError:
        return text


def _parameter(p: Mapping[str, Any]) -> tuple[Any, ...]:
    """The fields of a parameter's line; `p` as in `orders.parameters_of`."""
    if "levels" in p:
        return "levels", p["name"], *p["levels"]
    return "parameter", p["name"], p["low"], p["high"], p["tolerance"], p["unit"]


def _field(value: Any) -> str:
    """A field of a line: numbers as their shortest decimals; in a text each run of white space is one space."""
    if isinstance(value, bool):
        return "true" if value else "false"
    return " ".join(str(value).split()) if isinstance(value, str) else repr(value)
