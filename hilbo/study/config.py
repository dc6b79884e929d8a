"""The Study record: a checked study file together with its model and its search space."""

import os
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import equinox as eqx

from hilbo.errors import InputError
from hilbo.kernels import Levels
from hilbo.likelihoods import Goal
from hilbo.ordinal_gp import RBF, OrdinalGP, OrdinalProbit
from hilbo.population.learnt.posterior import NOTHING, Stated, every_theta, prior_model
from hilbo.population.learnt.rule import Learnt
from hilbo.population.rules.registry import RULES
from hilbo.search.space import SearchSpace
from hilbo.study.file.reading import StudyFile, checked, read_study
from hilbo.study.file.schema import Inference

__all__ = ["RBF", "OrdinalGP", "OrdinalProbit", "Study"]


class Study(eqx.Module):
    """A checked study file with its search space and its model.

    `gp` has array fields and may be differentiated; all other fields but `learnt` are static.
    """

    gp: OrdinalGP
    space: SearchSpace
    file: StudyFile = eqx.field(static=True)
    """Content of the study file: responses, selection, texts and so on."""
    rule: str = eqx.field(static=True)
    """Name of the aggregation method: the file's, or one to compare with it."""
    inference: Inference = eqx.field(static=True)
    stated: Stated = eqx.field(static=True, repr=False, default=NOTHING)
    """Hyperparameters that the file specifies, for a method that learns the others; levels for any method."""
    learnt: Learnt | None = eqx.field(repr=False, default=None)
    """Result of learning the hyperparameters from the responses, for a method that learns; `gp` is then the learnt
    model, and before that the priors' medians."""

    @staticmethod
    def load(path: str | os.PathLike) -> "Study":
        """Read a study file and build its study; the overrides of every material are checked too. Raises InputError:
        one sentence with the file, the line where known, the mistake and its remedy."""
        if not isinstance(path, str | os.PathLike):
            raise InputError(f"Study: the path is a {type(path).__name__}; give the path of a study file, as text.")
        return read_study(path, Study.of)

    @staticmethod
    def from_dict(raw: Mapping[str, Any], source: str = "") -> "Study":
        """Check the tables of a parsed study file and build its study; numbers and lists may be NumPy's. The overrides
        of every material are checked too. `source`: path for error messages. Raises InputError: one sentence with the
        key, the mistake and its remedy."""
        if not isinstance(raw, Mapping):
            raise InputError(f"Study: this is a {type(raw).__name__}; give a study file's tables, or Study.load(path).")
        return checked(_plain(raw), source, Study.of)

    @staticmethod
    @lru_cache(maxsize=32)
    def of(file: StudyFile) -> "Study":
        """The study of a checked file, without its materials' overrides; the last 32 are cached. Raises InputError if
        the model cannot be built or no point of the search space is feasible."""
        gp, stated = _gp(file)
        space = SearchSpace(file.space.parameters, file.space.mechanics, file.space.constraints)
        return Study(gp, space, file, file.rule, file.gp.inference, stated)

    def __repr__(self) -> str:
        """One line: name, parameter ranges, response labels, aggregation method and hash."""
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

    @property
    def goal(self) -> Goal:
        """The response that is searched for: `goal` of the file, or the highest."""
        return Goal.of(self.file.responses, self.file.goal)

    @property
    def goal_label(self) -> str:
        """Label of the goal."""
        return self.responses[self.goal.category]

    @property
    def one_optimum(self) -> bool:
        """Whether one stimulus is the best. With a goal between other responses and several parameters, those of a
        curve or a surface are.
        """
        return not self.goal.is_between or self.space.dim == 1

    def material(self, name: str) -> "Study":
        """The study of one material: its overrides of [renderer] and [parameters] applied. Raises `InputError` for a
        name that is not in [materials]."""
        return Study.of(self.file.material(name))


def _plain(raw: Any) -> Any:
    """Copy of nested tables in which NumPy scalars and arrays, tuples and other mappings are Python numbers, lists and
    dicts."""
    if isinstance(raw, Mapping):
        return {key: _plain(value) for key, value in raw.items()}
    if isinstance(raw, list | tuple):
        return [_plain(value) for value in raw]
    return raw.tolist() if hasattr(raw, "tolist") else raw


def _gp(file: StudyFile) -> tuple[OrdinalGP, Stated]:
    """The model of [gp] and the hyperparameters that the file specifies. For a method that learns, the model has the
    prior's median for each hyperparameter that is not specified; for other methods only levels are recorded as
    specified."""
    table, parameters = file.gp, file.space.parameters
    numbers = sum(not p.categorical for p in parameters)
    levels = tuple(Levels(p.steps, p.correlation) if p.categorical else None for p in parameters)
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
