"""Estimate of one parameter: its value, interval, and whether the data identify it."""

from typing import NamedTuple

__all__ = ["Estimate"]


class Estimate(NamedTuple):
    """Estimate of a parameter: fitted value, 95 % interval (None for an open end) and identifiability status."""

    value: float
    lower: float | None
    upper: float | None
    status: str

    @property
    def known(self) -> bool:
        """Whether the parameter is identified, so that its digits are meaningful."""
        return self.status == "identified"
