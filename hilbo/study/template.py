"""Text of a new, commented study file from a few settings; the text is parsed and checked before it is returned."""

import re
import tomllib
from collections.abc import Sequence
from typing import Literal, NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined, Template

from hilbo.errors import InputError
from hilbo.population.rules.registry import DEFAULT, RECOMMENDED
from hilbo.search.box import Parameter
from hilbo.study.file.constraint_words import constraint_of
from hilbo.study.file.reading import StudyFile, checked
from hilbo.study.formats.parsing import UNREADABLE
from hilbo.study.formats.toml_text import toml_key, toml_string

__all__ = ["NewStudy", "parameter_of", "study_text"]

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
_FORM = "NAME=LOW:HIGH, NAME=LOW:HIGH:UNIT, NAME=LOW:HIGH:UNIT:log (or :integer), NAME=LEVEL,LEVEL or NAME=LEVEL<LEVEL"


class NewStudy(NamedTuple):
    """Settings of a study before it has a file. `device`: stimuli are rendered by the hilbo haptic device, with its
    fixed parameters; otherwise they are presented `by` a program or a person."""

    name: str
    parameters: tuple[Parameter, ...]
    responses: tuple[str, ...] = ("different", "similar", "close")
    trials: int = 25
    device: bool = False
    by: Literal["program", "person"] = "program"
    goal: str = ""
    """The response that is searched for; empty for the highest."""
    constraints: tuple[str, ...] = ()
    """Such as `a + 2*b <= 3`, in the parameters' units."""


def parameter_of(text: str) -> Parameter:
    """Parse a parameter of the command line: NAME=LOW:HIGH[:UNIT[:linear|log|integer]], NAME=LEVEL,LEVEL,… for
    unordered levels, or NAME=LEVEL<LEVEL<… for ordered ones. Raises InputError."""
    name, equals, rest = text.partition("=")
    between = "<" if "<" in rest else ","
    if equals and name.strip() and name.isprintable() and ":" not in rest and between in rest:
        levels = tuple(level.strip() for level in rest.split(between))
        return Parameter.of_levels(name.strip(), levels, ordered=between == "<")
    low, *others = rest.split(":")
    try:
        ends = float(low), float(others[0])
    except (ValueError, IndexError):
        ends = None
    scale = others[2] if len(others) > 2 else "linear"
    named = bool(equals and name.strip()) and name.isprintable()
    if not named or ends is None or len(others) > 3 or scale not in ("linear", "log", "integer"):
        raise InputError(f"--parameter is {toml_string(text)}; write {_FORM}, for example hue=140:260:deg.")
    unit = others[1].strip() if len(others) > 1 else ""
    if scale == "integer":
        return Parameter(name.strip(), *ends, unit, integer=True)
    return Parameter(name.strip(), *ends, unit, scale)


def study_text(new: NewStudy) -> str:
    """Text of the study file, in TOML; nothing is written to disk. Raises InputError for settings that make no valid
    study."""
    parameters = _parameters(new)
    constraints = [constraint_of(words, [p.name for p in parameters]) for words in new.constraints]
    text = _template().render(
        new=new,
        parameters=parameters,
        constraints=constraints,
        responses=", ".join(map(toml_string, new.responses)),
        definitions=[(name, _DEFINITIONS[name]) for name in new.responses if name in _DEFINITIONS],
        attribute=_attribute(new),
        recommended=RECOMMENDED,
        default=DEFAULT,
        thresholds=[k - (len(new.responses) - 2) / 2 for k in range(len(new.responses) - 1)],
    )
    try:
        file = tomllib.loads(text)
    except UNREADABLE as error:
        raise InputError(
            f"a name or a response has characters that a file cannot contain ({error}); leave them out."
        ) from error
    try:
        checked(file, "", _build if constraints else _accept)
    except InputError as error:
        raise InputError(_as_written(str(error), new.constraints)) from None
    return text


def _build(file: StudyFile) -> None:
    """Build the study, to raise InputError if the constraints leave no feasible point."""
    from hilbo.study.config import Study  # loads what computes, which a file without constraints does not need

    Study.of(file)


def _as_written(sentence: str, constraints: Sequence[str]) -> str:
    """An error sentence in which each key `constraints.N` is replaced by the --constraint option that it came from."""
    return re.sub(
        r"constraints\.(\d+)(\.terms)?", lambda m: f"--constraint {toml_string(constraints[int(m[1]) - 1])}", sentence
    )


def _template() -> Template:
    """The Jinja template `study.toml` of hilbo.study, with its filters."""
    environment = Environment(
        loader=PackageLoader("hilbo.study"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"quoted": toml_string, "key": toml_key, "noted": _noted, "tolerances": _tolerances}
    return environment.get_template("study.toml")


def _noted(text: str, comment: str) -> str:
    """A line of TOML followed by a comment, which starts at column 37 where the line is short enough."""
    return f"{text:<36} # {comment}"


def _accept(_file: StudyFile) -> None:
    """Accept any file: `reading.checked` has done the checks that need no model."""


def _parameters(new: NewStudy) -> Sequence[Parameter]:
    """The parameters of the new study; the device's own for `device`. Raises InputError if `device` is combined with
    parameters, if there are none, or if a name is repeated."""
    if new.device:
        if new.parameters:
            raise InputError("--parameter: the device renders K1, B1 and alpha; leave it out, or --by device.")
        return _DEVICE
    if not new.parameters:
        raise InputError(f"--parameter: a study needs at least one; write {_FORM}, for example hue=140:260:deg.")
    names = [p.name for p in new.parameters]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"--parameter: {twice} is given twice; give each name once.")
    return new.parameters


def _attribute(new: NewStudy) -> str:
    """The judged attribute: that of the paper for its device, similarity for the default responses, else a rating."""
    if new.device:
        return "perceived realism"
    return "similarity to the reference" if new.responses == NewStudy._field_defaults["responses"] else "rating"


def _tolerances(parameters: Sequence[Parameter], part: int) -> str:
    """Inline TOML table of the presentation tolerance of each numeric parameter: range / `part`, and 1 / `part`
    (relative) on a logarithmic scale, which a comment says."""
    tolerances = {p.name: (1 if p.scale == "log" else p.high - p.low) / part for p in parameters if not p.levels}
    logs = " and ".join(toml_string(p.name) for p in parameters if p.scale == "log")
    shares = f"  # of {logs} a share of the value, the scale is logarithmic" if logs else ""
    return "{" + ", ".join(f"{toml_string(name)} = {value:.2g}" for name, value in tolerances.items()) + "}" + shares
