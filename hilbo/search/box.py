"""Definition of a search space: named parameters with units or levels, linear constraints, and the renderer.

Numbers only, checked against each other; imports no JAX. `space` searches in it and knows its passive part. A parameter
is continuous, integer, or has ordered or unordered levels. In physical numbers a level is its position in the list,
from 0; `Parameter.shown` and `Parameter.number` convert to its text and back.
"""

import math
from dataclasses import dataclass
from typing import Any, Literal

from jaxtyping import Float, Real

from hilbo.errors import InputError
from hilbo.mechanics.span import STATES, Memory
from hilbo.numerics.host import namespace_of
from hilbo.search.levels import check_levels, index_at, position_of

__all__ = ["MOST_PARAMETERS", "Box", "Constraint", "End", "Mechanics", "Parameter"]


MOST_PARAMETERS = 8
End = Literal["low", "high"]
"""An end of a parameter's range."""
_SMALLEST = 2.0**-1022  # of the normal floating-point numbers: those below lose digits, and JAX takes them for 0


@dataclass(frozen=True)
class Parameter:
    """Named parameter, from `low` to `high` in `unit`; `scale` defines its mapping to [0, 1].

    `integer`: only whole numbers are allowed. `levels`: names of levels; the parameter then ranges from 0 to their
    number minus 1. Of unordered ones `correlation` is the prior correlation of the latent score between two of them;
    `ordered` ones lie on the unit scale, equally spaced or at the positions `at`.
    `natural_ends`: ends of the range ("low", "high") beyond which nothing exists.
    """

    name: str
    low: float
    high: float
    unit: str = ""
    scale: Literal["linear", "log"] = "linear"
    integer: bool = False
    levels: tuple[str, ...] = ()
    correlation: float = 0.5
    natural_ends: tuple[End, ...] = ()
    ordered: bool = False
    at: tuple[float, ...] = ()

    def __post_init__(self):
        """Raise `InputError` for invalid levels, a range that is empty, not finite or too narrow, another scale, a log
        scale from 0 or below, and ends of an integer that are no whole numbers."""
        path = f"parameters.{self.name}"
        if self.levels:
            check_levels(path, self.levels, self.correlation, self.ordered, self.at)
        if not (math.isfinite(self.low) and math.isfinite(self.high)):
            raise InputError(f"{path} runs from {self.low} to {self.high}, both ends must be finite numbers.")
        if not self.low < self.high:
            raise InputError(f"{path}.low is {self.low}; it must be below high = {self.high}.")
        if self.scale not in ("linear", "log"):
            raise InputError(f'{path}.scale is "{self.scale}"; it must be linear or log.')
        if self.scale == "log" and self.low <= 0:
            raise InputError(f'{path}.low is {self.low}; it must be above 0 on a scale = "log".')
        ratio = self.scale == "log"
        span = self.high / self.low if ratio else self.high - self.low
        if not _SMALLEST <= span < math.inf:
            words = f"high {'/' if ratio else '-'} low is {span}"
            raise InputError(f"{path} runs from {self.low} to {self.high}, so that {words}; choose another unit.")
        for key, end in (("low", self.low), ("high", self.high)):
            if self.integer and end != round(end):
                raise InputError(f"{path}.{key} is {end}; it must be a whole number where integer = true.")

    @classmethod
    def of_levels(
        cls,
        name: str,
        levels: tuple[str, ...],
        correlation: float = 0.5,
        ordered: bool = False,
        at: tuple[float, ...] = (),
        natural_ends: tuple[End, ...] = (),
    ) -> "Parameter":
        """Parameter with levels, by default unordered. Raises `InputError` for invalid fields."""
        last = len(levels) - 1.0
        return cls(name, 0.0, last, "", "linear", False, levels, correlation, natural_ends, ordered, at)

    @property
    def categorical(self) -> bool:
        """Whether the parameter has levels without an order, so that its unit scale has no distances."""
        return bool(self.levels) and not self.ordered

    @property
    def discrete(self) -> bool:
        """Whether only some values are allowed: whole numbers or levels."""
        return self.integer or bool(self.levels)

    @property
    def middle(self) -> float:
        """Middle of the range, in physical units; finite where low + high is not."""
        return 0.5 * self.low + 0.5 * self.high

    @property
    def steps(self) -> int:
        """Number of allowed values of a discrete parameter; without meaning for a continuous one."""
        return round(self.high - self.low) + 1

    def shown(self, value: float) -> float | int | str:
        """Physical number as shown in tables: name of the level, whole number (int), or the number itself."""
        if self.levels:
            return self.levels[round(value)]
        return round(value) if self.integer else float(value)

    def column(self, values: Float[Any, " n"]) -> Any:
        """Physical numbers as a table column: a list of level names, or `values` itself for a numeric parameter."""
        return [self.shown(value) for value in values] if self.levels else values

    def words(self, value: float) -> str:
        """Physical number as text, without its unit: name of the level, whole number, or four significant digits."""
        return str(self.shown(value)) if self.discrete else f"{value:.4g}"

    def number(self, value: float | str) -> float:
        """Physical number of a value as `shown` returns it: a level's position, or the number as a float.

        NaN for an unknown level and for a numeric parameter's text or boolean; the range is not checked.
        """
        if self.levels:
            return float(self.levels.index(value)) if value in self.levels else math.nan
        return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan

    def holds(self, value: float) -> bool:
        """Whether a physical number is an allowed value: within the range, and whole if the parameter is discrete."""
        return self.low <= value <= self.high and (not self.discrete or value == round(value))

    @property
    def range_words(self) -> str:
        """Text of the allowed values, such as "a number from 0 to 5 mm" or "one of red, green"."""
        if self.levels:
            return "one of " + (" < " if self.ordered else ", ").join(self.levels)
        kind = "a whole number" if self.integer else "a number"
        return f"{kind} from {self.low:g} to {self.high:g} {self.unit}".rstrip()

    def axis(self, cells: int) -> Float[Any, " k"]:
        """Values on [0, 1] along an axis of a figure: `cells` uniform ones, or up to that many discrete values."""
        import numpy as np

        even = np.linspace(0.0, 1.0, cells)
        if not self.discrete:
            return even
        step = np.linspace(self.low, self.high, min(cells, self.steps)).round()
        return np.asarray(self.to_unit(step))

    def to_unit(self, value: Real[Any, "..."]) -> Float[Any, "..."]:
        """Map physical values (array) to [0, 1] on the parameter's scale; exact at both ends, not clipped."""
        if self.at:
            return position_of(self.at, value)
        xp = namespace_of(value)
        if self.scale == "log":
            above, below = xp.log1p((value - self.low) / self.low), xp.log1p((self.high - value) / value)
            width = math.log(self.high / self.low)
        else:
            above, below, width = value - self.low, self.high - value, self.high - self.low
        return xp.where(above < below, above / width, 1 - below / width)

    def to_physical(self, unit: Real[Any, "..."]) -> Float[Any, "..."]:
        """Map values of [0, 1] (array) to physical ones, on the parameter's scale; never outside [low, high] for those.

        A discrete parameter is rounded to its nearest value.
        """
        if self.at:
            return index_at(self.at, unit)
        xp = namespace_of(unit)
        if self.scale == "log":
            ratio = self.high / self.low
            upwards, downwards = self.low * ratio**unit, self.high * ratio ** (unit - 1)
        else:
            width = self.high - self.low
            upwards, downwards = self.low + width * unit, self.high - width * (1 - unit)
        value = xp.where(unit < 0.5, upwards, downwards)
        return xp.round(value) if self.discrete else value


@dataclass(frozen=True)
class Constraint:
    """Linear constraint `least` <= sum of weight·parameter over `terms` <= `most`, in physical units.

    Either may be None; equal ones make an equality, as of the shares of a mixture.
    """

    terms: tuple[tuple[str, float], ...]
    least: float | None = None
    most: float | None = None

    @property
    def equality(self) -> bool:
        """Whether the sum must have one value."""
        return self.least is not None and self.least == self.most

    @property
    def sum_words(self) -> str:
        """Text of the sum, such as `gain + 2 grains`."""
        parts = [
            f"{'-' if w < 0 else '+'} {'' if abs(w) == 1 else f'{abs(w):g} '}{name}" for name, w in self.terms if w
        ]
        return " ".join(parts).removeprefix("+ ")

    @property
    def words(self) -> str:
        """Text of the constraint, such as `0 <= gain + 2 grains <= 24` or `a + b = 1`."""
        total = self.sum_words
        if self.equality:
            return f"{total} = {self.least:g}"
        low = "" if self.least is None else f"{self.least:g} <= "
        return low + total + ("" if self.most is None else f" <= {self.most:g}")


@dataclass(frozen=True)
class Mechanics:
    """Model of the renderer: the FO-SLS's effective stiffness, memory, rate and delay, and the device's damping.

    `K_eff`: effective stiffness H(1), N/mm. `damping`: physical damping b of the device, N·s/m. `effective_damping`:
    optional range of dH/ds at s = 0, N·s/m. `N`: taps (odd) of short memory; `states`: exponentials of full memory,
    which affect only the effective damping, not the largest K1; `T`: s. `delay`: from the sample of the position to its
    force, s, 0 to T.
    """

    K_eff: float
    damping: float
    N: int = 101
    T: float = 1e-3
    memory: Memory = "short"
    states: int = 10
    effective_damping: tuple[float, float] | None = None
    delay: float = 0.0

    def __post_init__(self):
        """Raise `InputError` for a number out of its range, an even N, an unknown memory, and an effective damping
        whose ends do not increase."""
        for key, least in (("damping", 0.0), ("T", 0.0), ("K_eff", -math.ulp(0.0))):
            value = getattr(self, key)
            if not least < value < math.inf:
                raise InputError(f"renderer.{key} is {value}; it must be {'0 or' if least else 'a number'} above 0.")
        if not 0 <= self.delay <= self.T:
            raise InputError(f"renderer.delay is {self.delay} s; it must be from 0 to T = {self.T} s.")
        if self.memory not in ("short", "full"):
            raise InputError(f'renderer.memory is "{self.memory}"; it must be short or full.')
        if self.memory == "full" and self.states not in STATES:
            raise InputError(f"renderer.states is {self.states}; it must be one of {', '.join(map(str, STATES))}.")
        if self.memory == "short" and (self.N < 1 or self.N % 2 == 0):
            raise InputError(f"renderer.N is {self.N}; it must be odd and at least 1; write for example N = 101.")
        if self.effective_damping is not None and not 0 <= self.effective_damping[0] < self.effective_damping[1]:
            raise InputError(
                f"renderer.effective_damping is {list(self.effective_damping)}; it must be a lower end, 0 or above, "
                "and a higher one; write for example effective_damping = [10, 80]."
            )


@dataclass(frozen=True)
class Box:
    """Named parameters, optional `mechanics` of the renderer, and linear constraints.

    With `mechanics` the parameters must include K1 (N/mm), B1 (N·s^α/mm) and alpha, in any order. `constraints` may not
    involve parameters with levels. Raises `InputError` for invalid definitions.
    """

    parameters: tuple[Parameter, ...]
    mechanics: Mechanics | None = None
    constraints: tuple[Constraint, ...] = ()

    def __post_init__(self):
        if not self.parameters:
            raise InputError("parameters is empty, a search space needs at least one.")
        if self.dim > MOST_PARAMETERS:
            raise InputError(
                f"parameters are {self.dim}, {', '.join(self.names)}; a study has {MOST_PARAMETERS} at most."
            )
        if len(set(self.names)) < self.dim:
            raise InputError(f"parameters has one name twice: {', '.join(self.names)}.")
        if self.mechanics is not None:
            self._check_model()
        for number, constraint in enumerate(self.constraints, 1):
            self._check_constraint(constraint, f"constraints.{number}")

    def _check_constraint(self, constraint: Constraint, path: str) -> None:
        """Raise `InputError` for an invalid constraint, or one on a parameter with levels. `path` begins the text."""
        for name, weight in constraint.terms:
            if name not in self.names:
                raise InputError(
                    f"{path}.terms names {name}, which is no parameter of the study; those are {', '.join(self.names)}."
                )
            if self.parameters[self.names.index(name)].levels:
                raise InputError(f"{path}.terms names {name}, whose levels are no numbers; leave it out.")
            if not math.isfinite(weight):
                raise InputError(f"{path}.terms.{name} is {weight}; it must be a finite number.")
        if not any(weight for _, weight in constraint.terms):
            raise InputError(f"{path}.terms has no weight but 0; write for example terms = {{a = 1, b = 2}}.")
        if constraint.least is None and constraint.most is None:
            raise InputError(f"{path} has no least and no most; it must have one of them, or both.")
        least, most = constraint.least, constraint.most
        for key, end in (("least", least), ("most", most)):
            if end is not None and not math.isfinite(end):
                raise InputError(f"{path}.{key} is {end}; it must be a finite number, or be left out.")
        if least is not None and most is not None and not least <= most:
            raise InputError(f"{path}.least is {least}; it must be below most = {most}.")
        if constraint.equality and self.mechanics is not None:
            raise InputError(
                f"{path} is an equality, which is not possible where there is a [renderer]; write a least below most."
            )
        self._check_size(constraint, path)

    def _check_size(self, constraint: Constraint, path: str) -> None:
        """Raise `InputError` for a constraint whose sums are too large, or too small, for a floating-point number."""
        terms = [(weight, self.parameters[self.names.index(name)]) for name, weight in constraint.terms]
        spans = [weight * (p.high - p.low) for weight, p in terms]
        size = sum(span * span for span in spans)  # its root is divided by
        reach = sum(abs(weight) * max(abs(p.low), abs(p.high)) for weight, p in terms)
        ends = [abs(end) for end in (constraint.least, constraint.most) if end is not None]
        if not _SMALLEST <= size < math.inf or not sum(ends, reach) < math.inf:
            raise InputError(
                f"{path}.terms has a sum too large or too small for a computer; choose other units of the parameters,"
                " or divide the weights, least and most by one number."
            )

    def _check_model(self) -> None:
        """Raise `InputError` unless K1, B1 and alpha are there, continuous, above 0, and alpha below 1."""
        missing = [name for name in ("K1", "B1", "alpha") if name not in self.names]
        if missing:
            raise InputError(f"parameters.{missing[0]} is missing, the renderer's model needs K1, B1 and alpha.")
        for name in ("K1", "B1", "alpha"):
            parameter = self.parameters[self.names.index(name)]
            if parameter.discrete:
                raise InputError(f"parameters.{name} has steps; it must be continuous for the FO-SLS.")
            if parameter.low <= 0:
                raise InputError(f"parameters.{name}.low is {parameter.low}; it must be above 0 for the FO-SLS.")
        alpha = self.parameters[self.names.index("alpha")]
        if alpha.high >= 1:
            raise InputError(f"parameters.alpha.high is {alpha.high}; it must be below 1 for the FO-SLS.")

    @property
    def dim(self) -> int:
        """Number of parameters."""
        return len(self.parameters)

    @property
    def names(self) -> tuple[str, ...]:
        """Names in the order of the coordinates."""
        return tuple(parameter.name for parameter in self.parameters)
