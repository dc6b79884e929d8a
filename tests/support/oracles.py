"""Numbers that tests compare with and that take long to compute: stored in tests/vectors, made by make_oracles.py."""

import json
from functools import cache
from pathlib import Path

import numpy as np

__all__ = ["FOLDER", "oracle"]

FOLDER = Path(__file__).parents[1] / "vectors"


@cache
def oracle(name: str) -> dict:
    """The stored numbers of this name: a tree of dictionaries, whose lists are arrays."""
    return _arrays(json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8")))


def _arrays(node):
    if isinstance(node, dict):
        return {key: _arrays(child) for key, child in node.items()}
    return np.array(node) if isinstance(node, list) else node
