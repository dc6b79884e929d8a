"""The Study record: a study file with its model and its search space, ready to be computed with."""

import os
from collections.abc import Mapping
from typing import Any

import equinox as eqx

from hilbo.errors import InputError
from hilbo.kernels import Levels
from hilbo.ordinal_gp import RBF, OrdinalGP, OrdinalProbit
from hilbo.population.learnt.posterior import NOTHING, Stated, every_theta, prior_model
from hilbo.population.learnt.rule import Learnt
from hilbo.population.rules.registry import RULES
from hilbo.search.space import SearchSpace
from hilbo.study.file.protocols import SessionTable
from hilbo.study.file.reading import StudyFile, checked, hash_of, made_of_material, materials_in, read_study
from hilbo.study.file.schema import Inference, ReportTable, Selection
from hilbo.study.file.simulated_people import SimulationTable
from hilbo.study.file.stimuli import StimulusTable

__all__ = ["RBF", "OrdinalGP", "OrdinalProbit", "Study"]


class Study(eqx.Module):
    """What is asked, over which space, with which model: everything but the answers.

    `gp` holds arrays and may be differentiated; all else is static. `source` is the file it came from, `hash`
    identifies its content.
    """

    gp: OrdinalGP
    space: SearchSpace
    name: str = eqx.field(static=True)
    responses: tuple[str, ...] = eqx.field(static=True)
    attribute: str = eqx.field(static=True)
    """What is judged, in words: labels of axes."""
    exclude: str = eqx.field(static=True)
    """The rule by which people are left out (`hilbo.population.judged.response_quality`), empty for nobody."""
    exclude_flags: tuple[str, ...] = eqx.field(static=True)
    """Flags of the device for which an analysis leaves a trial out (`hilbo.study.file.trial_flags`)."""
    selection: Selection = eqx.field(static=True)
    inference: Inference = eqx.field(static=True)
    rule: str = eqx.field(static=True)
    random_effect: str | None = eqx.field(static=True)
    """The column of the answers' table whose levels have an effect of their own, by a rule that learns it."""
    source: str = eqx.field(static=True)
    content: str = eqx.field(static=True, repr=False)  # the parsed file as JSON
    session: SessionTable = eqx.field(static=True, repr=False, default=SessionTable())
    report: ReportTable = eqx.field(static=True, repr=False, default=ReportTable())
    stimulus: StimulusTable | None = eqx.field(static=True, repr=False, default=None)
    """What is asked of the program that presents the renderings; None where a device does."""
    simulation: SimulationTable | None = eqx.field(static=True, repr=False, default=None)
    """Of whom `hilbo simulate` and `hilbo power` draw people, if the file states it."""
    stated: Stated = eqx.field(static=True, repr=False, default=NOTHING)
    """What the file states of the model, where the rule learns the rest; and of levels, whatever the rule."""
    learnt: Learnt | None = eqx.field(repr=False, default=None)
    """What was learnt from the answers, by a rule that learns; `gp` is then the learnt model, and before that the
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
    def of(file: StudyFile) -> "Study":
        """The study of a file. Raises InputError if nothing in its box is passive."""
        gp, stated = _gp(file)
        return Study(
            gp=gp,
            space=SearchSpace(file.space.parameters, file.space.mechanics, file.space.constraints),
            name=file.name,
            responses=file.responses,
            attribute=file.tables.study.attribute,
            exclude=file.tables.study.exclude,
            exclude_flags=file.exclude_flags,
            selection=file.selection,
            inference=file.tables.gp.inference,
            rule=file.tables.aggregation.rule,
            random_effect=file.random_effect,
            source=file.source,
            content=file.content,
            session=file.session,
            report=file.tables.report,
            stimulus=file.stimulus,
            simulation=file.tables.simulation,
            stated=stated,
        )

    def __repr__(self) -> str:
        ranges = ", ".join(
            f"{p.name} {p.range_words}" if p.levels else f"{p.name} {p.low:g} to {p.high:g} {p.unit}".rstrip()
            for p in self.space.parameters
        )
        return f'Study("{self.name}": {ranges}; {", ".join(self.responses)}; rule {self.rule}; hash {self.hash})'

    @property
    def hash(self) -> str:
        """First 16 hex digits of the SHA-256 of the content."""
        return hash_of(self.content)

    @property
    def materials(self) -> tuple[str, ...]:
        """Names of the materials that override the renderer or the parameters."""
        return materials_in(self.content)

    def material(self, name: str) -> "Study":
        """The study of one material: its overrides of [renderer] and [parameters] applied."""
        return made_of_material(self.content, self.source, name, Study.of)


def _plain(raw: Any) -> Any:
    """With Python's own numbers, lists and dicts in place of NumPy's and other mappings."""
    if isinstance(raw, Mapping):
        return {key: _plain(value) for key, value in raw.items()}
    if isinstance(raw, list | tuple):
        return [_plain(value) for value in raw]
    return raw.tolist() if hasattr(raw, "tolist") else raw


def _gp(file: StudyFile) -> tuple[OrdinalGP, Stated]:
    """The model of [gp], and what the file states of it; a rule that learns takes the priors' medians for the rest."""
    table, parameters = file.tables.gp, file.space.parameters
    numbers = sum(not p.levels for p in parameters)
    levels = tuple(Levels(p.steps, p.correlation) if p.levels else None for p in parameters)
    levels = levels if numbers < len(parameters) else ()
    theta, variance, thresholds, noise = table.theta, table.variance, table.thresholds, table.noise
    if RULES[file.tables.aggregation.rule].learns:
        lengths = theta if theta is None or isinstance(theta, tuple) else (theta,) * numbers
        stated = Stated(lengths, variance, thresholds, noise, levels)
        return prior_model(len(parameters), len(file.responses), stated), stated
    assert theta is not None and variance is not None and thresholds is not None and noise is not None
    likelihood = OrdinalProbit(thresholds, noise)
    if not levels:
        return OrdinalGP(RBF(theta, variance), likelihood), NOTHING
    stated, lengths = Stated(levels=levels), theta if isinstance(theta, tuple) else (theta,) * numbers
    return OrdinalGP(RBF(every_theta(RBF, lengths, levels), variance, stated.counts), likelihood), stated
