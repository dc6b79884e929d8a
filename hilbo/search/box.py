"""What a study file says of its search space: named bounded parameters with units, and the renderer that shows them.

Numbers alone, checked against each other; loads no JAX. `space` searches in it, and knows which part of it is passive.
"""

import math
from dataclasses import dataclass
from typing import Any, Literal

from jaxtyping import Float, Real

from hilbo.errors import InputError
from hilbo.mechanics.span import STATES, Memory

__all__ = ["Box", "Mechanics", "Parameter"]


@dataclass(frozen=True)
class Parameter:
    """One named parameter, `low` to `high` in `unit`; `scale` says how it lies on [0, 1]."""

    name: str
    low: float
    high: float
    unit: str = ""
    scale: Literal["linear", "log"] = "linear"

    def __post_init__(self):
        path = f"parameters.{self.name}"
        if not (math.isfinite(self.low) and math.isfinite(self.high)):
            raise InputError(f"{path} runs from {self.low} to {self.high}, both ends must be finite numbers.")
        if not self.low < self.high:
            raise InputError(f"{path}.low is {self.low}, it must be below high = {self.high}.")
        if self.scale == "log" and self.low <= 0:
            raise InputError(f'{path}.low is {self.low}, it must be above 0 on a scale = "log".')

    def to_unit(self, value: Real[Any, "..."]) -> Float[Any, "..."]:
        """Physical value, an array, to [0, 1]; measured from the nearer end, so that both ends are met exactly."""
        import jax.numpy as jnp

        if self.scale == "log":
            above, below = jnp.log1p((value - self.low) / self.low), jnp.log1p((self.high - value) / value)
            width = math.log(self.high / self.low)
        else:
            above, below, width = value - self.low, self.high - value, self.high - self.low
        return jnp.where(above < below, above / width, 1 - below / width)

    def to_physical(self, unit: Real[Any, "..."]) -> Float[Any, "..."]:
        """Inverse of `to_unit`; never leaves [low, high] for a `unit` in [0, 1]."""
        import jax.numpy as jnp

        if self.scale == "log":
            ratio = self.high / self.low
            upwards, downwards = self.low * ratio**unit, self.high * ratio ** (unit - 1)
        else:
            width = self.high - self.low
            upwards, downwards = self.low + width * unit, self.high - width * (1 - unit)
        return jnp.where(unit < 0.5, upwards, downwards)


@dataclass(frozen=True)
class Mechanics:
    """What the renderer adds to the box: the FO-SLS, its memory and rate, and the device's damping.

    `K_eff`: effective stiffness H(1), N/mm. `damping`: physical damping b of the device, N·s/m. `effective_damping`:
    optional range of dH/ds at s = 0, N·s/m. `N`: taps (odd) of short memory; `states`: exponentials of full memory,
    for which alone the effective damping depends on them, and not on K1; `T`: s.
    """

    K_eff: float
    damping: float
    N: int = 101
    T: float = 1e-3
    memory: Memory = "short"
    states: int = 10
    effective_damping: tuple[float, float] | None = None

    def __post_init__(self):
        for key, least in (("damping", 0.0), ("T", 0.0), ("K_eff", -math.ulp(0.0))):
            value = getattr(self, key)
            if not least < value < math.inf:
                raise InputError(f"renderer.{key} is {value}, it must be {'0 or' if least else 'a number'} above 0.")
        if self.memory == "full" and self.states not in STATES:
            raise InputError(f"renderer.states is {self.states}, it must be one of {', '.join(map(str, STATES))}.")
        if self.memory == "short" and (self.N < 1 or self.N % 2 == 0):
            raise InputError(f"renderer.N is {self.N}, it must be odd and at least 1; write for example N = 101.")
        if self.effective_damping is not None and not 0 <= self.effective_damping[0] < self.effective_damping[1]:
            raise InputError(
                f"renderer.effective_damping is {list(self.effective_damping)}, it must be a lower end, 0 or above, "
                "and a higher one; write for example effective_damping = [10, 80]."
            )


@dataclass(frozen=True)
class Box:
    """Named parameters, and with `mechanics` what renders them; these must then include K1 (N/mm), B1 (N·s^α/mm) and
    alpha, in any order."""

    parameters: tuple[Parameter, ...]
    mechanics: Mechanics | None = None

    def __post_init__(self):
        if not self.parameters:
            raise InputError("parameters is empty, a search space needs at least one.")
        if len(set(self.names)) < self.dim:
            raise InputError(f"parameters has one name twice: {', '.join(self.names)}.")
        if self.mechanics is not None:
            self._check_model()

    def _check_model(self) -> None:
        """What the FO-SLS asks of its parameters."""
        missing = [name for name in ("K1", "B1", "alpha") if name not in self.names]
        if missing:
            raise InputError(f"parameters.{missing[0]} is missing, the renderer's model needs K1, B1 and alpha.")
        for name in ("K1", "B1", "alpha"):
            parameter = self.parameters[self.names.index(name)]
            if parameter.low <= 0:
                raise InputError(f"parameters.{name}.low is {parameter.low}, it must be above 0 for the FO-SLS.")
        alpha = self.parameters[self.names.index("alpha")]
        if alpha.high >= 1:
            raise InputError(f"parameters.alpha.high is {alpha.high}, it must be below 1 for the FO-SLS.")

    @property
    def dim(self) -> int:
        """Number of parameters."""
        return len(self.parameters)

    @property
    def names(self) -> tuple[str, ...]:
        """Names in the order of the coordinates."""
        return tuple(parameter.name for parameter in self.parameters)
