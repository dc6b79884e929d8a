"""The Study record: a study file with its model and its search space, ready to be computed with."""

import os
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import equinox as eqx

from hilbo.errors import InputError
from hilbo.kernels import Levels
from hilbo.ordinal_gp import RBF, OrdinalGP, OrdinalProbit
from hilbo.population.learnt.posterior import NOTHING, Stated, every_theta, prior_model
from hilbo.population.learnt.rule import Learnt
from hilbo.population.rules.registry import RULES
from hilbo.search.space import SearchSpace
from hilbo.study.file.reading import StudyFile, checked, read_study
from hilbo.study.file.schema import Inference

__all__ = ["RBF", "OrdinalGP", "OrdinalProbit", "Study"]


class Study(eqx.Module):
    """A study file with its search space and its model, ready to be computed with.

    `gp` holds arrays and may be differentiated; all else but `learnt` is static.
    """

    gp: OrdinalGP
    space: SearchSpace
    file: StudyFile = eqx.field(static=True)
    """All that the study file contains: responses, selection, texts and so on."""
    rule: str = eqx.field(static=True)
    """The method that aggregates participants: the file's, or one to compare with it."""
    inference: Inference = eqx.field(static=True)
    stated: Stated = eqx.field(static=True, repr=False, default=NOTHING)
    """What the file specifies of the model, where the method learns the rest; and of levels, whatever the method."""
    learnt: Learnt | None = eqx.field(repr=False, default=None)
    """What was learnt from the responses, by a method that learns; `gp` is then the learnt model, and before that the
    priors' medians."""

    @staticmethod
    def load(path: str | os.PathLike) -> "Study":
        """Read and check a study file; InputError says in one sentence what is wrong with it, and where."""
        if not isinstance(path, str | os.PathLike):
            raise InputError(f"Study: the path is a {type(path).__name__}; give the path of a study file, as text.")
        return read_study(path, Study.of)

    @staticmethod
    def from_dict(raw: Mapping[str, Any], source: str = "") -> "Study":
        """As `load`, from the parsed tables; numbers and lists may be NumPy's. Raises InputError as `load` does."""
        if not isinstance(raw, Mapping):
            raise InputError(f"Study: this is a {type(raw).__name__}; give a study file's tables, or Study.load(path).")
        return checked(_plain(raw), source, Study.of)

    @staticmethod
    @lru_cache(maxsize=32)
    def of(file: StudyFile) -> "Study":
        """The study of a file. Raises InputError if nothing in its box is passive."""
        gp, stated = _gp(file)
        space = SearchSpace(file.space.parameters, file.space.mechanics, file.space.constraints)
        return Study(gp, space, file, file.rule, file.gp.inference, stated)

    def __repr__(self) -> str:
        ranges = ", ".join(
            f"{p.name} {p.range_words}" if p.levels else f"{p.name} {p.low:g} to {p.high:g} {p.unit}".rstrip()
            for p in self.space.parameters
        )
        labels = ", ".join(self.responses)
        return f'Study("{self.file.name}": {ranges}; {labels}; rule {self.rule}; hash {self.file.hash})'

    @property
    def responses(self) -> tuple[str, ...]:
        """Labels of the responses, lowest first."""
        return self.file.responses

    def material(self, name: str) -> "Study":
        """The study of one material: its overrides of [renderer] and [parameters] applied. Raises `InputError`."""
        return Study.of(self.file.material(name))


def _plain(raw: Any) -> Any:
    """With Python's own numbers, lists and dicts in place of NumPy's and other mappings."""
    if isinstance(raw, Mapping):
        return {key: _plain(value) for key, value in raw.items()}
    if isinstance(raw, list | tuple):
        return [_plain(value) for value in raw]
    return raw.tolist() if hasattr(raw, "tolist") else raw


def _gp(file: StudyFile) -> tuple[OrdinalGP, Stated]:
    """The model of [gp], and what the file states of it; a rule that learns takes the priors' medians for the rest."""
    table, parameters = file.gp, file.space.parameters
    numbers = sum(not p.levels for p in parameters)
    levels = tuple(Levels(p.steps, p.correlation) if p.levels else None for p in parameters)
    levels = levels if numbers < len(parameters) else ()
    theta, variance, thresholds, noise = table.theta, table.variance, table.thresholds, table.noise
    if RULES[file.rule].learns:
        lengths = theta if theta is None or isinstance(theta, tuple) else (theta,) * numbers
        stated = Stated(lengths, variance, thresholds, noise, levels)
        return prior_model(len(parameters), len(file.responses), stated), stated
    assert theta is not None and variance is not None and thresholds is not None and noise is not None
    likelihood = OrdinalProbit(thresholds, noise)
    if not levels:
        return OrdinalGP(RBF(theta, variance), likelihood), NOTHING
    stated, lengths = Stated(levels=levels), theta if isinstance(theta, tuple) else (theta,) * numbers
    return OrdinalGP(RBF(every_theta(RBF, lengths, levels), variance, stated.counts), likelihood), stated
