"""Estimate of one parameter: its value, interval, and whether the data identify it."""

from typing import NamedTuple

__all__ = ["Estimate"]


class Estimate(NamedTuple):
    """A parameter: the value of the best curve, its 95 % interval (an open end is None), and what it is worth."""

    value: float
    lower: float | None
    upper: float | None
    status: str

    @property
    def known(self) -> bool:
        """Whether the digits of `value` mean something."""
        return self.status == "identified"
