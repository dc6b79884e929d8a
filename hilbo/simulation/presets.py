"""Populations by name, from hilbo/data/populations.toml; docs/simulation.md says how they were made.

`paper-01` to `paper-30` agree with the paper's individuals and with its validation as well as could be; `paper` is the
one of them that is nearest to their middle. `paper-individuals` agrees with the individuals alone.
"""

import tomllib
from importlib.resources import files
from typing import Any

from hilbo.errors import InputError
from hilbo.simulation.simulate import Population

__all__ = ["PRESETS", "preset_of"]


def _read() -> dict[str, Population]:
    content = tomllib.loads((files("hilbo") / "data" / "populations.toml").read_text(encoding="utf-8"))
    each = {name: _population(table) for name, table in content["populations"].items()}
    return {"paper": each[content["paper"]]} | each


def _population(table: dict[str, Any]) -> Population:
    values: dict[str, Any] = {key: tuple(v) if isinstance(v, list) else v for key, v in table.items()}
    return Population(**values)


PRESETS: dict[str, Population] = _read()


def preset_of(name: str) -> Population:
    """The population of a name. Raises InputError, which lists the names, if there is none."""
    if name not in PRESETS:
        raise InputError(f'--preset is "{name}"; there are {", ".join(PRESETS)}.')
    return PRESETS[name]
