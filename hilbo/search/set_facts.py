"""What follows from the numbers of a rendering, where a device renders it: its K0 and its passivity margin."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float

from hilbo.numerics.tracing import program
from hilbo.search.space import SearchSpace

__all__ = ["Described", "described", "facts"]


class Described(NamedTuple):
    """A rendering's values by name in physical units, with what follows from them, and its passivity margin."""

    parameters: dict[str, float]
    margin: float | None


def described(space: SearchSpace, values: Mapping[str, float]) -> Described:
    """A planned set, by name in physical units."""
    derived, margin = facts(space, {name: np.asarray(values[name], float) for name in space.names})
    parameters = {name: float(values[name]) for name in space.names}
    parameters |= {name: float(value) for name, value in derived.items()}
    return Described(parameters, None if margin is None or not math.isfinite(margin) else float(margin))


@program
def facts(space: SearchSpace, values: Mapping[str, Any]) -> tuple[dict[str, Float[Array, ""]], Float[Array, ""] | None]:
    """What follows from a rendering's values, by name, and its passivity margin; None without mechanics."""
    return space.derived(values), space.passivity_margin(values)
