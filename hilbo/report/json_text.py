"""Numbers as JSON, which has no word for those that are not finite."""

import json
import math
from typing import Any

__all__ = ["quoted"]


def quoted(value: Any, indent: int | None = None) -> str:
    """JSON, with null for what is not finite."""
    return json.dumps(_clean(value), indent=indent, allow_nan=False)


def _clean(value):
    if isinstance(value, dict):
        return {key: _clean(v) for key, v in value.items()}
    if isinstance(value, list):
        return [_clean(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
