"""Posterior means by elliptical slice sampling and log evidences by SciPy, with their standard errors."""

from datasets import SIX
from reference_exact import genz, slice_sampled

__all__ = ["make"]


def make() -> dict:
    return {data.name: {"slice_sampled": slice_sampled(data), "genz": genz(data)} for data in (each() for each in SIX)}
