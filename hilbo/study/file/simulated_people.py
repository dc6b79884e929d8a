"""[simulation]: the participants that `hilbo simulate` and `hilbo power` draw for a study if no preset is chosen."""

import itertools
from collections.abc import Sequence
from typing import Annotated

import msgspec

from hilbo.errors import InputError
from hilbo.search.box import Parameter
from hilbo.study.file.fields import NotNegative, Positive, Table, shown, words

__all__ = ["SimulationTable", "each"]

_Part = Annotated[float, msgspec.Meta(gt=0, le=1)]
_Parts = Annotated[
    _Part | Annotated[tuple[_Part, ...], msgspec.Meta(min_length=1)],
    words("a number above 0, up to 1, or a list of one for each parameter", "0.15"),
]


class SimulationTable(Table, frozen=True):
    """[simulation]: distribution of the simulated participants, each of whom prefers one stimulus;
    `hilbo.simulation.simulate` has the model.

    `truth`: parameter -> centre of their optima, in physical units; drawn from the feasible set if left out. `spread`:
    between-participant sd of optima (for levels the proportion who prefer another one), and `tolerance`: the distance
    at which the highest response ends, both as fractions of the ranges. `criteria`: C - 1 falling distances in
    tolerances, below the last of which the response is the highest; for a goal other than the highest response, those
    above it are negative. `noise`: sd of the perceived dissimilarity, in
    tolerances. `lapse`: proportion of random responses.
    """

    truth: Annotated[dict[str, float | str], words("a table of numbers or levels", "{hue = 120}")] = msgspec.field(
        default_factory=dict
    )
    spread: _Parts = 0.12
    tolerance: _Parts = 0.2
    tolerance_sd: NotNegative = 0.4
    criteria: Annotated[tuple[float, ...], words("a list of falling numbers", "[2.5, 1]")] = ()
    noise: Annotated[Positive, msgspec.Meta(examples=["0.7"])] = 0.7
    lapse: Annotated[float, msgspec.Meta(ge=0, le=1), words("a number from 0 to 1", "0.05")] = 0.05
    drift_sd: NotNegative = 0.2

    def check(self, parameters: Sequence[Parameter], count: int, below: int) -> None:
        """Raise `InputError` if the table does not fit these parameters and `count` responses, of which so many are
        `below` the goal."""
        names = [p.name for p in parameters]
        if self.truth and set(self.truth) != set(names):
            raise InputError(f"simulation.truth names {', '.join(self.truth)}; it must name {', '.join(names)}.")
        for p in parameters if self.truth else ():
            if not p.low <= p.number(self.truth[p.name]) <= p.high:
                value = shown(self.truth[p.name])
                raise InputError(f"simulation.truth.{p.name} is {value}; it must be {p.range_words}.")
        for name, values in (("spread", self.spread), ("tolerance", self.tolerance)):
            if isinstance(values, tuple) and len(values) != len(names):
                raise InputError(
                    f"simulation.{name} has {len(values)} numbers; it must be one number or {len(names)}, one per"
                    " parameter."
                )
        if self.criteria and len(self.criteria) != count - 1:
            given = shown(self.criteria)
            raise InputError(
                f"simulation.criteria is {given}; it must have one number fewer than the {count} responses."
            )
        if any(high <= low for high, low in itertools.pairwise(self.criteria)):
            raise InputError(
                f"simulation.criteria is {shown(self.criteria)}; it must fall from each number to the next."
            )
        if 0 in self.criteria or (self.criteria and sum(value > 0 for value in self.criteria) != below):
            signs = (
                "above 0"
                if below == count - 1
                else f"{below} above 0 and {count - 1 - below} below, one for each answer"
            )
            raise InputError(f"simulation.criteria is {shown(self.criteria)}; its numbers must be {signs}.")


def each(values: float | tuple[float, ...], dim: int) -> tuple[float, ...]:
    """A tuple of `dim` numbers, one per parameter; a single number is repeated."""
    return values if isinstance(values, tuple) else (values,) * dim
