"""[stimulus]: how a program, or a person, presents the stimuli of a study that uses no hilbo device."""

import math
from collections.abc import Sequence
from typing import Annotated, Literal

import msgspec

from hilbo.errors import InputError
from hilbo.search.box import Parameter
from hilbo.study.file.fields import Table, shown, words

__all__ = ["StimulusTable"]

_EXACT = 1e-6  # of a parameter's range, or of the value on a logarithmic scale: more than 32 bits are off by
_PATIENCE = {"within": 5.0, "silence": 3.0}  # s that a person who presents needs at least, and a tablet that slumbers
_Seconds = Annotated[float, msgspec.Meta(ge=0.1, le=600), words("a number of seconds from 0.1 to 600", "1.0")]


class StimulusTable(Table, frozen=True):
    """[stimulus]: presentation by a program or a person.

    `within`: s until a stimulus must be confirmed as presented. `silence`: s without a message until the program counts
    as disconnected. `tolerance`: parameter -> allowed difference of the confirmed value, in physical units, on a
    logarithmic scale as a fraction of the value; by default a millionth of the range, or of the value. `unblinded`:
    stimuli are presented by the participant's own page, which knows the parameters; such responses are not aggregated
    with blinded ones of other studies. `by`: a program, or a person by hand with the preparer's page.
    `experimenter_sees`: whether the experimenter is shown the parameters; None: only if a program presents.
    """

    within: _Seconds = 1.0
    silence: _Seconds = 1.0
    tolerance: Annotated[dict[str, float], words("a table of numbers, 0 or above", "{height_px = 0.5}")] = (
        msgspec.field(default_factory=dict)
    )
    unblinded: Annotated[bool, words("true or false", "false")] = False
    by: Annotated[Literal["program", "person"], words('"program" or "person"', '"program"')] = "program"
    experimenter_sees: Annotated[bool | None, words("true or false", "true")] = None

    def check(self, parameters: Sequence[Parameter]) -> None:
        """Raise `InputError` for a tolerance of an unknown or categorical parameter or of an invalid size, and for
        times too short for a person who presents."""
        names, levels = [p.name for p in parameters], [p.name for p in parameters if p.levels]
        shares = [p.name for p in parameters if p.scale == "log"]
        for name, value in self.tolerance.items():
            path = f"stimulus.tolerance.{name}"
            if name not in names:
                raise InputError(f"{path} is of no parameter of the study, those are {', '.join(names)}.")
            if name in levels:
                raise InputError(f"{path} is of levels, which have no tolerance; leave it out.")
            if not 0 <= value < math.inf:
                raise InputError(f"{path} is {shown(value)}; it must be a number, 0 or above.")
            if name in shares and value >= 1:
                raise InputError(
                    f"{path} is {shown(value)}; on a logarithmic scale it is a share of the value and must be below 1,"
                    " such as 0.01."
                )
        for key, least in _PATIENCE.items() if self.by == "person" else ():
            if getattr(self, key) < least:
                raise InputError(
                    f"stimulus.{key} is {getattr(self, key):g} s, and a person presents; give them {least:g} s or more."
                )

    @property
    def role(self) -> Literal["stimulus", "preparer"]:
        """Session role of the presenter: "stimulus" for a program, "preparer" for a person."""
        return "stimulus" if self.by == "program" else "preparer"

    @property
    def shown_to(self) -> tuple[str, ...]:
        """Session roles to which the parameters are shown: the presenter, and the experimenter unless
        `experimenter_sees` is false (by default false if a person presents)."""
        sees = self.by == "program" if self.experimenter_sees is None else self.experimenter_sees
        return (self.role, "experimenter") if sees else (self.role,)

    def tolerance_of(self, parameter: Parameter) -> float:
        """Allowed difference of a confirmed value: in the parameter's unit, on a logarithmic scale as a fraction of the
        value; 0 for levels."""
        if parameter.levels:
            return 0.0
        exact = _EXACT if parameter.scale == "log" else _EXACT * (parameter.high - parameter.low)
        return self.tolerance.get(parameter.name, exact)

    def off_by(self, parameter: Parameter, wanted: float) -> float:
        """Allowed difference of the confirmed value from `wanted`, always in the parameter's unit."""
        return self.tolerance_of(parameter) * (wanted if parameter.scale == "log" else 1.0)

    def tolerance_words(self, parameter: Parameter) -> str:
        """`tolerance_of` as text, such as "0.5 deg", or "1 %" on a logarithmic scale."""
        if parameter.scale == "log":
            return f"{100 * self.tolerance_of(parameter):.3g} %"
        return f"{self.tolerance_of(parameter):.3g} {parameter.unit}".rstrip()
