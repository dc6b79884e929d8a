"""A point of the unit cube as what is rendered: its parameter set with the derived K0, and its passivity margin."""

from typing import Any

import numpy as np
from jax.typing import ArrayLike

from hilbo.search.space import SearchSpace

__all__ = ["K0_range", "delay_words", "margin_of", "set_of"]


def set_of(space: SearchSpace, x: ArrayLike) -> dict[str, Any]:
    """A point of the unit cube as a parameter set in physical units, derived K0 included."""
    physical = np.asarray(space.to_physical(np.asarray(x)))
    values = dict(zip(space.names, physical.tolist(), strict=True))
    shown = {p.name: p.shown(values[p.name]) for p in space.parameters}
    return {name: float(value) for name, value in space.derived(values).items()} | shown


def margin_of(space: SearchSpace, x: ArrayLike) -> float | None:
    """Passivity margin (N.s/m) of a point, None without mechanics; negative means not passive."""
    values = set_of(space, x)
    margin = space.passivity_margin({name: values[name] for name in space.names})
    return None if margin is None else float(margin)


def delay_words(space: SearchSpace) -> str:
    """The passive share of the box with and without the delay of the device's force; empty without a delay."""
    if space.mechanics is None or not space.mechanics.delay:
        return ""
    late, prompt = (100 * each.volume() for each in (space, space.without_delay()))
    delay = f"{1e6 * space.mechanics.delay:g} µs"
    return f"{late:.1f} % of the box is passive at a delay of {delay}, {prompt:.1f} % without"


def K0_range(space: SearchSpace) -> float:
    """N/mm, from the K0 at the box's most elastic corner to K_eff, by which errors of K0 are normalised.

    16.14 for the paper's study: from -15.70 to 0.44 (paper, table I).
    """
    ends = {p.name: p.low if p.name == "alpha" else p.high for p in space.parameters}
    assert space.mechanics is not None
    return space.mechanics.K_eff - float(space.derived(ends)["K0"])
