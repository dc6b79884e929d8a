"""A study with a parameter of unordered levels between two of numbers."""

import copy

from hilbo.study.config import Study

__all__ = ["SURFACES", "TEXTURES", "surfaces"]

TEXTURES = ("silk", "wood", "stone")
SURFACES = {
    "schema": 1,
    "study": {"name": "surfaces", "responses": ["different", "similar", "close"]},
    "parameters": {
        "hue": {"low": 0.0, "high": 360.0, "unit": "deg"},
        "texture": {"levels": list(TEXTURES)},
        "light": {"low": 20.0, "high": 80.0, "unit": "%"},
    },
    "gp": {"theta": [10.0, 8.0], "variance": 1.0, "thresholds": [-0.5, 0.5], "noise": 0.5},
    "selection": {"trials": 6, "space_filling": 4},
}


def surfaces(textures=TEXTURES, **tables):
    """The study, with its levels in this order and other tables in place of its own."""
    raw = copy.deepcopy(SURFACES) | tables
    raw["parameters"]["texture"] = {"levels": list(textures)}
    return Study.from_dict(raw)
