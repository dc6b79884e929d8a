"""The schema of a study file: each table as a record, whose annotations carry the type, the range and the words for
both. Loads no JAX."""

from typing import Annotated, Any, Literal, get_args

import msgspec

from hilbo.mechanics.span import Memory
from hilbo.population.rules.registry import DEFAULT, RULES, RuleName
from hilbo.search.box import End
from hilbo.study.file.fields import NotNegative as _NotNegative
from hilbo.study.file.fields import Number as _Number
from hilbo.study.file.fields import Positive as _Positive
from hilbo.study.file.fields import Table as _Table
from hilbo.study.file.fields import words as _text
from hilbo.study.file.protocols import SessionTable
from hilbo.study.file.simulated_people import SimulationTable
from hilbo.study.file.stimuli import StimulusTable
from hilbo.study.file.trial_flags import FLAGS, TrialFlag

__all__ = [
    "KEY_NUMBERS",
    "NO_DELAY",
    "TABLES",
    "ConstraintTable",
    "GPTable",
    "Inference",
    "LevelsTable",
    "ParameterTable",
    "PlanTable",
    "RendererTable",
    "ReportTable",
    "Selection",
    "StudyTable",
    "Tables",
    "ValidationTable",
]

Inference = Literal["laplace", "ep", "ep_corrected", "exact"]
Acquisition = Literal["ucb", "log_ei", "thompson", "top_category"]


class StudyTable(_Table, frozen=True):
    """[study]: name, response labels (lowest first), the one that is the goal (by default the highest), rated
    attribute, cells that stand for a missing response, and exclusion rules."""

    name: Annotated[str, msgspec.Meta(min_length=1), _text("a text", '"memory foam"')]
    responses: Annotated[
        tuple[str, ...],
        msgspec.Meta(min_length=2),
        _text("a list of two or more texts, lowest first", '["different", "similar", "close"]'),
    ]
    goal: Annotated[str, _text("one of the responses", '"close"')] = ""
    attribute: Annotated[str, msgspec.Meta(min_length=1), _text("a text", '"perceived realism"')] = "perceived realism"
    missing: Annotated[tuple[str, ...], _text("a list of texts", '["NA", "-1"]')] = ()
    exclude: Annotated[str, _text("a rule, or nothing", '"trials < 10 or lapse_low > 0.3"')] = ""
    exclude_flags: Annotated[
        tuple[TrialFlag, ...], _text("a list of some of " + ", ".join(FLAGS), '["saturated", "slewed"]')
    ] = ()


_Ends = Annotated[tuple[End, ...], msgspec.Meta(max_length=2), _text('a list of "low", "high" or both', '["low"]')]


class ParameterTable(_Table, frozen=True):
    """[parameters.NAME]: a numeric parameter. `natural_ends`: ends of the range beyond which nothing exists."""

    low: _Number
    high: _Number
    unit: Annotated[str, _text("a text", '"N/mm"')] = ""
    scale: Annotated[Literal["linear", "log"], _text('"linear" or "log"', '"linear"')] = "linear"
    integer: Annotated[bool, _text("true or false", "true")] = False
    natural_ends: _Ends = ()


class LevelsTable(_Table, frozen=True):
    """[parameters.NAME]: a parameter of levels. `correlation`: prior correlation of the latent score between two
    unordered levels. `ordered`: the levels are listed in their order, equally spaced or at the positions `at`."""

    levels: Annotated[
        tuple[Annotated[str, msgspec.Meta(min_length=1)], ...],
        msgspec.Meta(min_length=2),
        _text("a list of two or more texts", '["silk", "wood", "stone"]'),
    ]
    correlation: Annotated[float, msgspec.Meta(gt=0, lt=1), _text("a number above 0 and below 1", "0.5")] = 0.5
    ordered: Annotated[bool, _text("true or false", "true")] = False
    at: Annotated[tuple[float, ...], _text("a list of rising numbers, one per level", "[0, 1, 4]")] = ()
    natural_ends: _Ends = ()


class ConstraintTable(_Table, frozen=True):
    """`least` <= the sum of weight times parameter <= `most`, in physical units."""

    terms: Annotated[
        dict[str, float], msgspec.Meta(min_length=1), _text("a table of weights", "{gain = 1, delay = 0.5}")
    ]
    least: _Number | None = None
    most: _Number | None = None


NO_DELAY = 0.0
"""msgspec leaves a number out of the content where it is this very object."""


class RendererTable(_Table, frozen=True):
    """[renderer]: mechanical model of the rendering, by hilbo's device or, beside [stimulus], by a program."""

    K_eff: Annotated[_NotNegative, msgspec.Meta(examples=["0.44"])]
    damping: Annotated[_Positive, msgspec.Meta(examples=["0.95"])]
    model: Annotated[Literal["fosls"], _text('"fosls"', '"fosls"')] = "fosls"
    memory: Annotated[Memory, _text('"short" or "full"', '"short"')] = "short"
    N: Annotated[int, msgspec.Meta(ge=1), _text("an odd whole number, 1 or above", "101")] = 101
    states: Annotated[int, _text("a number of exponentials, for full memory", "10")] = 10
    T: Annotated[_Positive, msgspec.Meta(examples=["0.001"])] = 1e-3
    effective_damping: Annotated[tuple[float, float] | None, _text("a list of two numbers", "[10, 80]")] = None
    delay: Annotated[_NotNegative, msgspec.Meta(examples=["0.0003"])] = NO_DELAY


_Length = Annotated[float, msgspec.Meta(ge=1e-3, le=1e3)]


class GPTable(_Table, frozen=True):
    """[gp]: hyperparameters of the model. Methods that learn take those left out from the data; other methods require
    all of them, but one of theta and length.

    `length`: length scale as a fraction of a parameter's range; theta = 1/(2 length^2).
    """

    theta: Annotated[
        _Positive | Annotated[tuple[_Positive, ...], msgspec.Meta(min_length=1)] | None,
        _text("a number above 0, or a list of one for each parameter", "30.0"),
    ] = None
    length: Annotated[
        _Length | Annotated[tuple[_Length, ...], msgspec.Meta(min_length=1)] | None,
        _text("a number from 0.001 to 1000, or a list of one for each parameter", "0.3"),
    ] = None
    variance: Annotated[_Positive | None, _text("a number above 0", "1.0")] = None
    thresholds: Annotated[tuple[float, ...] | None, _text("a list of rising numbers", "[-0.5, 0.5]")] = None
    noise: Annotated[_Positive | None, _text("a number above 0", "0.5")] = None
    inference: Annotated[Inference, _text('"laplace", "ep", "ep_corrected" or "exact"', '"laplace"')] = "laplace"


class Selection(_Table, frozen=True):
    """How trials are chosen: first `space_filling` of them by a Latin hypercube, then by the acquisition function.

    `weight`: of the standard deviation in UCB. `minimum_distance`: to earlier trials, in the unit cube.
    """

    space_filling: Annotated[int, msgspec.Meta(ge=0), _text("a whole number, 0 or above", "5")] = 5
    trials: Annotated[int, msgspec.Meta(ge=1), _text("a whole number, 1 or above", "25")] = 25
    acquisition: Annotated[
        Acquisition, _text("one of " + ", ".join(f'"{name}"' for name in get_args(Acquisition)), '"ucb"')
    ] = "ucb"
    weight: Annotated[_NotNegative, msgspec.Meta(examples=["0.7"])] = 0.7
    minimum_distance: Annotated[_NotNegative | None, _text("a number, 0 or above", "0.05")] = None


class AggregationTable(_Table, frozen=True):
    """[aggregation]: name of the aggregation method."""

    rule: Annotated[RuleName, _text("one of " + ", ".join(f'"{name}"' for name in RULES), f'"{DEFAULT}"')] = DEFAULT


class RandomEffectTable(_Table, frozen=True):
    """[random_effect]. `column`: of the trial table, such as the clip, whose levels have a random effect."""

    column: Annotated[str, msgspec.Meta(min_length=1), _text("the name of a column", '"clip"')]


KEY_NUMBERS = (
    "population_error",
    "individual_error",
    "mean_of_optima_error",
    "hyperparameter_shift",
    "goal_answers",
    "best_called",
    "mid_called",
    "worst_called",
    "preferred",
)
"""Names of the key results of a study (`hilbo.report.study.key_numbers`), which other results may be put beside."""


class ReportTable(_Table, frozen=True):
    """[report]: additions to `hilbo report`. `hypotheses`: evaluate the paper's hypotheses H1 to H4, and name the
    paper's figure that each figure corresponds to. `compare_with`: key result -> what another study found."""

    hypotheses: Annotated[bool, _text("true or false", "true")] = False
    compare_with: Annotated[
        dict[str, str | float],
        _text("a table of numbers or texts", '{population_error = 4, individual_error = "24 (13 to 41)"}'),
    ] = msgspec.field(default_factory=dict)


class ValidationTable(_Table, frozen=True):
    """`[validation]`: conditions on the sets mid and worst of a validation.

    `known`: largest standard deviation of the map there, over that without responses; `apart`: least distance of mid
    from best and worst, in the unit cube.
    """

    known: Annotated[float, msgspec.Meta(gt=0, le=1), _text("a number above 0, at most 1", "0.8")] = 0.8
    apart: Annotated[_NotNegative, msgspec.Meta(examples=["0.2"])] = 0.2


class PlanTable(_Table, frozen=True):
    """[plan]. `people`: material -> number of participants who optimise it; each is assigned to one of them at random.
    Without it every participant has all materials."""

    people: Annotated[
        dict[str, Annotated[int, msgspec.Meta(ge=1, le=100_000)]],
        _text("a table of materials and numbers of participants", "{foam = 24, medium = 8, stiff = 8}"),
    ] = msgspec.field(default_factory=dict)


class Tables(_Table, frozen=True):
    """The whole study file as records; its hash is computed from them."""

    study: StudyTable
    parameters: dict[str, ParameterTable | LevelsTable]
    gp: GPTable = GPTable()
    renderer: RendererTable | None = None
    selection: Selection = Selection()
    aggregation: AggregationTable = AggregationTable()
    materials: dict[str, dict[str, Any]] = msgspec.field(default_factory=dict)
    session: SessionTable = SessionTable()
    report: ReportTable = ReportTable()
    stimulus: StimulusTable | None = None
    simulation: SimulationTable | None = None
    random_effect: RandomEffectTable | None = None
    validation: ValidationTable = ValidationTable()
    plan: PlanTable = PlanTable()
    constraints: tuple[ConstraintTable, ...] = ()


TABLES = {
    "study": StudyTable,
    "gp": GPTable,
    "selection": Selection,
    "aggregation": AggregationTable,
    "session": SessionTable,
    "report": ReportTable,
    "stimulus": StimulusTable,
    "simulation": SimulationTable,
    "random_effect": RandomEffectTable,
    "validation": ValidationTable,
    "plan": PlanTable,
}
