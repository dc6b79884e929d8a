"""Keys and strings as TOML text. Loads no JAX, no pandas."""

import json
import re

__all__ = ["toml_key", "toml_string"]


def toml_key(name: str) -> str:
    """A TOML key, quoted unless it is a bare key."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else toml_string(name)


def toml_string(text: str) -> str:
    """A TOML basic string."""
    return json.dumps(text, ensure_ascii=False)
