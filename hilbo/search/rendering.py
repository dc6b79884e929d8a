"""A rendering: values of a search space's parameters, and what the mechanics of the space derive from them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from hilbo.numerics.tracing import OfArrays, prepared
from hilbo.search.space import SearchSpace

__all__ = ["K0_range", "Rendering", "delay_words", "derived_of"]


@dataclass(frozen=True)
class Rendering:
    """A point of a search space in physical units; made by `of` and `at`.

    `values`: parameter -> number in its unit (position in the list for a level), in the order of the space. K0 and the
    passivity margin are computed once, when either is read.
    """

    space: SearchSpace = field(repr=False)
    values: dict[str, float]

    @classmethod
    def of(cls, space: SearchSpace, physical: Mapping[str, float] | Float[Any, " d"]) -> "Rendering":
        """From physical values: (d,) in the order of the space, or by name; other names are ignored."""
        if not isinstance(physical, Mapping):
            physical = dict(zip(space.names, np.asarray(physical).tolist(), strict=True))
        return cls(space, {name: float(physical[name]) for name in space.names})

    @classmethod
    def at(cls, space: SearchSpace, x: ArrayLike) -> "Rendering":
        """From a point (d,) of the unit cube."""
        return cls.of(space, space.to_physical(np.asarray(x)))

    @property
    def point(self) -> Float[np.ndarray, " d"]:
        """The values (d,) in the order of the space."""
        return np.array(list(self.values.values()))

    @property
    def unit(self) -> Float[np.ndarray, " d"]:
        """The point (d,) of the unit cube."""
        return np.asarray(self.space.to_unit(self.point))

    @cached_property
    def _derived(self) -> tuple[dict[str, float], float | None]:
        """K0 (N/mm) by name, and the passivity margin (N·s/m), computed at first use; {} and None without mechanics."""
        if self.space.mechanics is None:
            return {}, None
        K0, margin = np.asarray(_program(self.space)((self.point,))).tolist()
        return {"K0": K0}, margin

    @property
    def parameters(self) -> dict[str, float]:
        """Physical values by name, with K0 (N/mm) if the space has mechanics; as logs store and devices render them."""
        return self.values | self._derived[0]

    @property
    def shown(self) -> dict[str, Any]:
        """K0, if the space has mechanics, and the values as in tables: levels by name, whole numbers as int."""
        return self._derived[0] | {p.name: p.shown(self.values[p.name]) for p in self.space.parameters}

    @property
    def margin(self) -> float | None:
        """Passivity margin, N·s/m; negative where the rendering is not passive. None without mechanics."""
        return self._derived[1]


def derived_of(
    space: SearchSpace, physical: Float[Array, "*batch d"]
) -> tuple[dict[str, Float[Array, "*batch"]], Float[Array, "*batch"] | None]:
    """K0 (N/mm) by name and passivity margin (N·s/m) of physical values (..., d); {} and None without mechanics.

    Can be traced by JAX.
    """
    values = {name: physical[..., i] for i, name in enumerate(space.names)}
    return space.derived(values), space.passivity_margin(values)


def _K0_and_margin(space: SearchSpace, physical: Float[Array, " d"]) -> Float[Array, "2"]:
    """K0 (N/mm) and the passivity margin (N·s/m) of a physical point (d,), as (2,); for a space with mechanics."""
    derived, margin = derived_of(space, physical)
    assert margin is not None  # only used with mechanics
    return jnp.stack([derived["K0"], margin])


@lru_cache(maxsize=16)
def _program(space: SearchSpace) -> OfArrays:
    """`_K0_and_margin` of a space, compiled once, as a function of [point]. Fast, since a live session waits for it."""
    return prepared(_K0_and_margin, space, np.zeros(space.dim))


def delay_words(space: SearchSpace) -> str:
    """Text with the passive percentage of the box at the device's delay and without it; "" without a delay."""
    if space.mechanics is None or not space.mechanics.delay:
        return ""
    late, prompt = (100 * each.volume() for each in (space, space.without_delay()))
    delay = f"{1e6 * space.mechanics.delay:g} µs"
    return f"{late:.1f} % of the box is passive at a delay of {delay}, {prompt:.1f} % without"


def K0_range(space: SearchSpace) -> float:
    """Range of K0 (N/mm), from its value at the box's most elastic corner to K_eff, by which its errors are normalised.

    The corner has the highest K1 and B1 and the lowest alpha. 16.14 for the paper's study: from -15.70 to 0.44 (paper,
    table I). The space must have mechanics.
    """
    ends = {p.name: p.low if p.name == "alpha" else p.high for p in space.parameters}
    assert space.mechanics is not None
    return space.mechanics.K_eff - float(space.derived(ends)["K0"])
