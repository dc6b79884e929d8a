"""Content as JSON text in which numbers that are not finite are null, since JSON cannot represent them."""

import json
import math
from typing import Any

__all__ = ["quoted"]


def quoted(value: Any, indent: int | None = None) -> str:
    """A value as JSON text, with null for floats that are not finite; `indent`: spaces per level, None: one line.

    Raises `TypeError` for objects that JSON does not have, such as arrays.
    """
    return json.dumps(_clean(value), indent=indent, allow_nan=False)


def _clean(value):
    """Copy of a value in which floats that are not finite are None, at any depth of dictionaries and lists."""
    if isinstance(value, dict):
        return {key: _clean(v) for key, v in value.items()}
    if isinstance(value, list):
        return [_clean(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
