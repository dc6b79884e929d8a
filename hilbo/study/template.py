"""A commented study file to begin with, made of a few words; what is written is read again and checked."""

import json
import re
import tomllib
from collections.abc import Sequence
from typing import Literal, NamedTuple

from hilbo.errors import InputError
from hilbo.population.rules.registry import DEFAULT, RECOMMENDED
from hilbo.search.box import Constraint, Parameter
from hilbo.study.file.constraint_words import constraint_of
from hilbo.study.file.reading import StudyFile, checked
from hilbo.study.formats.parsing import UNREADABLE

__all__ = ["NewStudy", "parameter_of", "study_text"]

_MODEL = """
[renderer]                           # our device renders the FO-SLS; K1, B1 and alpha are its parameters
K_eff = 0.44                         # N/mm, of the reference: measure yours (hilbo device characterise)
damping = 0.95                       # N.s/m, of the device: measure yours (hilbo device measure-damping)
# delay = 0.0003                     # s, from a position to its force: that of your device (hilbo device hello)
"""
_STIMULUS = """
[stimulus]                           # a program of yours presents (docs/guides/stimulus.md)
within = 1.0                         # s until it has confirmed what is presented; later voids the trial
silence = 1.0                        # s without a word until the program counts as gone
# How far what is really presented may be off; else a millionth of the range. Answers count for what was confirmed.
# tolerance = {tolerance}
"""
_PERSON = """
[stimulus]                           # a person presents by hand (docs/guides/stimulus.md)
by = "person"
within = 120.0                       # s until they have confirmed what is presented; later voids the trial
silence = 10.0                       # s without a word from their page until they count as gone
# How far what is really presented may be off. Answers count for what was confirmed.
tolerance = {tolerance}
# experimenter_sees = true           # the experimenter's page shows parameters; else the preparer alone knows them
"""
_TEXTS = """
[session.texts]                      # what participants read; docs/guides/sessions.md has all of them
title = "Compare"
hello = "One after the other is presented. Then say how similar they were. There is no right or wrong answer."
feel_reference = "The reference"
feel_test = "The test"
feel_a = "Test A"
feel_b = "Test B"
neutral = "A short break"
trouble = "One moment, please. The experimenter is looking after it."
let_go = "Let go, please"
question = "How similar is the test to the reference?"
question_a = "How similar is test A to the reference?"
question_b = "How similar is test B to the reference?"
a = "Test A"
b = "Test B"
question_preferred = "Which test was more similar to the reference?"
ready = "That was the warm-up. Would you like another one, or shall we begin?"
again = "Let us do this one again."
"""
_ATTRIBUTE = "perceived realism"
_DEFINITIONS = {
    "different": "The test is clearly different from the reference.",
    "similar": "The test is somewhat like the reference.",
    "close": "The test is the same as the reference, or nearly.",
}
_DEVICE = (
    Parameter("K1", 1.0, 32.0, "N/mm"),
    Parameter("B1", 0.001, 32.0, "N.s^alpha/mm"),
    Parameter("alpha", 0.01, 0.99),
)
_FORM = "NAME=LOW:HIGH, NAME=LOW:HIGH:UNIT, NAME=LOW:HIGH:UNIT:log (or :integer) or NAME=LEVEL,LEVEL"


class NewStudy(NamedTuple):
    """What is known of a study before it has a file. `device`: our device renders; else `by` presents, a program or a
    person."""

    name: str
    parameters: tuple[Parameter, ...]
    responses: tuple[str, ...] = ("different", "similar", "close")
    trials: int = 25
    device: bool = False
    by: Literal["program", "person"] = "program"
    constraints: tuple[str, ...] = ()
    """Such as `a + 2*b <= 3`, in the parameters' units."""


def parameter_of(text: str) -> Parameter:
    """A parameter as it is written on the command line. Raises InputError."""
    name, equals, rest = text.partition("=")
    if equals and name.strip() and name.isprintable() and ":" not in rest and "," in rest:
        return Parameter.of_levels(name.strip(), tuple(level.strip() for level in rest.split(",")))
    low, *others = rest.split(":")
    try:
        ends = float(low), float(others[0])
    except (ValueError, IndexError):
        ends = None
    scale = others[2] if len(others) > 2 else "linear"
    named = bool(equals and name.strip()) and name.isprintable()
    if not named or ends is None or len(others) > 3 or scale not in ("linear", "log", "integer"):
        raise InputError(f"--parameter is {_quoted(text)}; write {_FORM}, for example hue=140:260:deg.")
    unit = others[1].strip() if len(others) > 1 else ""
    if scale == "integer":
        return Parameter(name.strip(), *ends, unit, integer=True)
    return Parameter(name.strip(), *ends, unit, scale)


def study_text(new: NewStudy) -> str:
    """The file's text. Raises InputError for what no study file may say."""
    parameters = _parameters(new)
    constraints = [constraint_of(words, [p.name for p in parameters]) for words in new.constraints]
    text = "\n".join(
        [
            "# A study of hilbo. Change what you like; hilbo doctor FILE says what is missing.",
            "schema = 1",
            "",
            "[study]",
            f"name = {_quoted(new.name)}",
            _line(f"responses = [{', '.join(map(_quoted, new.responses))}]", "what people may answer, lowest first"),
            _line(f"attribute = {_quoted(_ATTRIBUTE)}", "what is judged: labels of axes and captions"),
            *(line for p in parameters for line in _table(p)),
            *(line for constraint in constraints for line in _wall(constraint)),
            _presenting(new, parameters),
            *_rule(new),
            "",
            "[selection]",
            _line(f"space_filling = {min(5, new.trials)}", "trials spread over the ranges, before any is chosen"),
            f"trials = {new.trials}",
            "",
            "[session]",
            _line('protocol_number = ""', "of the ethics approval: consent is compared with it"),
            "",
            *_phases(new.device),
            "",
        ]
    )
    text += "" if new.device else _TEXTS + _definitions(new.responses)
    try:
        file = tomllib.loads(text)
    except UNREADABLE as error:
        raise InputError(f"a name or an answer has what no file can hold ({error}); leave it out.") from error
    try:
        checked(file, "", _computed if constraints else _checked)
    except InputError as error:
        raise InputError(_as_written(str(error), new.constraints)) from None
    return text


def _computed(file: StudyFile) -> None:
    """Refuses constraints that leave nothing."""
    from hilbo.study.config import Study  # loads what computes, which a file without constraints does not need

    Study.of(file)


def _as_written(sentence: str, constraints: Sequence[str]) -> str:
    """A sentence on the tables of constraints, on what stands on the command line for them."""
    return re.sub(
        r"constraints\.(\d+)(\.terms)?", lambda m: f"--constraint {_quoted(constraints[int(m[1]) - 1])}", sentence
    )


def _line(text: str, comment: str) -> str:
    """A line with what is to be said of it, in one column where it fits."""
    return f"{text:<36} # {comment}"


def _checked(_file: StudyFile) -> None:
    """Nothing more than that it is one."""


def _parameters(new: NewStudy) -> Sequence[Parameter]:
    if new.device:
        if new.parameters:
            raise InputError("--parameter: the device renders K1, B1 and alpha; leave it out, or --device.")
        return _DEVICE
    if not new.parameters:
        raise InputError(f"--parameter: a study needs at least one; write {_FORM}, for example hue=140:260:deg.")
    names = [p.name for p in new.parameters]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"--parameter: {twice} is given twice; give each name once.")
    return new.parameters


def _table(p: Parameter) -> list[str]:
    key = _key(p.name)
    if p.levels:
        levels = _line(f"levels = [{', '.join(map(_quoted, p.levels))}]", "without an order")
        alike = _line(f"correlation = {p.correlation}", "how alike two of them are taken to be before any answer")
        return ["", f"[parameters.{key}]", levels, alike]
    scale = ['scale = "log"                        # steps are ratios'] if p.scale == "log" else []
    steps = ["integer = true                       # only whole numbers may be presented"] if p.integer else []
    return [
        "",
        f"[parameters.{key}]",
        f"low = {p.low}",
        f"high = {p.high}",
        f"unit = {_quoted(p.unit)}",
        *scale,
        *steps,
    ]


def _wall(constraint: Constraint) -> list[str]:
    terms = ", ".join(f"{_key(name)} = {weight}" for name, weight in constraint.terms)
    ends = [("least", constraint.least), ("most", constraint.most)]
    return [
        "",
        _line("[[constraints]]", f"{constraint.words}; nothing else is ever presented"),
        f"terms = {{{terms}}}",
        *(f"{key} = {end}" for key, end in ends if end is not None),
    ]


def _presenting(new: NewStudy, parameters: Sequence[Parameter]) -> str:
    """The table of what presents. The tolerance for a person is a hundredth of each range, or of the value."""
    if new.device:
        return _MODEL
    text, part = (_PERSON, 100) if new.by == "person" else (_STIMULUS, 1000)
    return text.replace("{tolerance}", _tolerance(parameters, part))


def _tolerance(parameters: Sequence[Parameter], part: int) -> str:
    tolerances = {p.name: (1 if p.scale == "log" else p.high - p.low) / part for p in parameters if not p.levels}
    logs = " and ".join(_quoted(p.name) for p in parameters if p.scale == "log")
    shares = f"  # of {logs} a share of the value, the scale is logarithmic" if logs else ""
    return "{" + ", ".join(f"{_quoted(name)} = {value:.2g}" for name, value in tolerances.items()) + "}" + shares


def _rule(new: NewStudy) -> list[str]:
    """The recommended rule; the paper's stands beside it, because it wants numbers that nobody knows before answers."""
    return [
        _line("[aggregation]", "everybody's answers -> one population map"),
        _line(
            f'rule = "{RECOMMENDED}"',
            "recommended; its model is learnt from the answers (docs/methods/which_method.md)",
        ),
        "",
        "# To use the paper's rule, replace the two lines above by these, whose numbers you state before any answer.",
        "# [aggregation]",
        f'# rule = "{DEFAULT}"',
        "# [gp]",
        _line(f"# length = {0.13 if new.device else 0.22}", "over what part of a range answers change"),
        "# variance = 1.0",
        _line(f"# thresholds = {_thresholds(len(new.responses))}", "between one answer and the next"),
        _line("# noise = 0.5", "how much one answer to the same thing differs from another"),
    ]


def _thresholds(count: int) -> list[float]:
    """One between each pair of neighbouring answers, 1 apart, as many below 0 as above."""
    return [k - (count - 2) / 2 for k in range(count - 1)]


def _phases(device: bool) -> list[str]:
    seconds = 4 if device else 2
    steps = f'[{{show = "reference", seconds = {seconds}}}, {{show = "a", seconds = {seconds}}}]'
    return [
        "[session.warm_up]                    # the first trials, which are not counted",
        f"steps = {steps}",
        f"count = {12 if device else 3}",
        "",
        "[session.optimisation]               # what is shown in a trial, and for how long",
        f"steps = {steps}",
    ]


def _definitions(responses: Sequence[str]) -> str:
    """What the usual answers mean; of others only their authors know that."""
    known = [f"{_quoted(name)} = {_quoted(_DEFINITIONS[name])}" for name in responses if name in _DEFINITIONS]
    return "\n".join(["", "[session.definitions]                # what each answer means", *known, ""])


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _quoted(name)


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)
