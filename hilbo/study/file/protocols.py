"""Protocols of a session as data: what is felt and for how long, what is asked, and every text a participant sees.

A trial is a list of steps (the reference, rendering a, rendering b, a neutral interval) with their durations, then
questions. Four phases are ready (paper, "Experimental Protocol" and "Sessions"): `warm-up`, `optimisation`,
`validation` (pairs out of best, mid and worst: two classes and a preference) and `aggregate-best` (a preference).
The study file's optional table [session] changes them:

    [session]
    protocol_number = "2025-17"            # of the ethics approval
    language = "de"                        # hilbo/data/texts has the texts of each
    [session.optimisation]
    steps = [{show = "reference", seconds = 4}, {show = "a", seconds = 4}]
    [session.texts]
    question = "…"                         # any key of hilbo/data/texts/en.toml
    [session.labels]
    close = "…"                            # how an answer is written on its button
    [session.definitions]
    close = "…"                            # what it means

Renderings are changed out of contact only: while the participant feels the reference, or during a neutral interval.
"""

from collections.abc import Sequence
from typing import Annotated, Literal

import msgspec

from hilbo.errors import InputError
from hilbo.study.file.fields import Positive, Table, shown, words
from hilbo.study.file.languages import LANGUAGES, LanguageName, language

__all__ = ["PHASES", "Ask", "Phase", "PhaseTable", "Protocol", "SessionTable", "Show", "Step", "protocol"]

Show = Literal["reference", "a", "b", "neutral"]
Phase = Literal["warm-up", "optimisation", "validation", "aggregate-best"]
Ask = Literal["class_a", "class_b", "preferred"]
PHASES: tuple[Phase, ...] = ("warm-up", "optimisation", "validation", "aggregate-best")


class Step(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A part of a trial: what is felt, for how many seconds."""

    show: Show
    seconds: Annotated[float, msgspec.Meta(gt=0, le=600)]


class Protocol(msgspec.Struct, frozen=True):
    """A phase: the steps of each trial, what is asked after them, and how many trials there are.

    `count`: the least number of renderings (warm-up), how often each pair is shown (validation) or each individual's
    best (aggregate-best); 0 where the study's [selection] says it (optimisation). `rest`: seconds between materials.
    """

    phase: Phase
    steps: tuple[Step, ...]
    asks: tuple[Ask, ...]
    count: int
    rest: float = 0.0

    @property
    def seconds(self) -> float:
        """Duration of a trial's steps, in s."""
        return sum(step.seconds for step in self.steps)

    @property
    def sides(self) -> tuple[str, ...]:
        """The renderings of a trial: ("a",) or ("a", "b")."""
        return ("a", "b") if any(step.show == "b" for step in self.steps) else ("a",)


_Steps = Annotated[
    tuple[Step, ...] | None,
    words(
        'a list of steps, each with show = "reference", "a", "b" or "neutral" and seconds up to 600',
        '[{show = "reference", seconds = 4}, {show = "a", seconds = 4}]',
    ),
]
_Texts = Annotated[dict[str, str], words("a table of texts", '{question = "…"}')]
_Count = Annotated[Annotated[int, msgspec.Meta(ge=1, le=1000)] | None, words("a whole number from 1 to 1000", "12")]
_Pause = Annotated[
    Annotated[float, msgspec.Meta(ge=60.0, le=1e9)] | None, words("a number of seconds, at least 60", "3600")
]


class PhaseTable(Table, frozen=True):
    """[session.PHASE]: what a study changes of a phase; see `Protocol`."""

    steps: _Steps = None
    count: _Count = None
    rest: Annotated[Positive | None, words("a number of seconds", "600")] = None


class SessionTable(Table, frozen=True):
    """[session]: what a study says of its live sessions."""

    protocol_number: Annotated[str, words("a text", '"2025-17"')] = ""
    language: Annotated[LanguageName, words("one of " + ", ".join(f'"{name}"' for name in LANGUAGES), '"de"')] = "en"
    texts: _Texts = msgspec.field(default_factory=dict)
    labels: _Texts = msgspec.field(default_factory=dict)
    definitions: _Texts = msgspec.field(default_factory=dict)
    warm_up_after_pause: _Pause = None
    warm_up: PhaseTable = PhaseTable()
    optimisation: PhaseTable = PhaseTable()
    validation: PhaseTable = PhaseTable()
    aggregate_best: PhaseTable = PhaseTable()

    def check(self, responses: Sequence[str]) -> None:
        """Refuse texts that nobody asks for, and steps that do not show what is asked about. Raises `InputError`."""
        for name, table, allowed in (
            ("texts", self.texts, tuple(language("en").texts)),
            ("labels", self.labels, tuple(responses)),
            ("definitions", self.definitions, tuple(responses)),
        ):
            for key in table:
                if key not in allowed:
                    raise InputError(f"session.{name}.{key} is no text of a session, those are {', '.join(allowed)}.")
        for phase in PHASES:
            _check_steps(phase, protocol(self, phase))

    def text(self, key: str) -> str:
        """A text that participants see, in the study's words or the shipped ones of its language."""
        return self.texts.get(key, language(self.language).texts[key])

    def untranslated(self, responses: Sequence[str]) -> list[str]:
        """The answers whose words on the buttons are in no language but the study file's."""
        known = {**language(self.language).labels, **self.labels}
        return [] if self.language == "en" else [response for response in responses if response not in known]

    def label(self, response: str) -> str:
        """How an answer is written on its button."""
        return self.labels.get(response, language(self.language).labels.get(response, response.capitalize()))

    def definition(self, response: str) -> str:
        """What an answer means."""
        return self.definitions.get(response, language(self.language).definitions.get(response, ""))


def protocol(session: SessionTable, phase: Phase) -> Protocol:
    """A phase as the paper has it, with the study's changes."""
    table: PhaseTable = getattr(session, phase.replace("-", "_"))
    changes = {key: value for key in ("steps", "count", "rest") if (value := getattr(table, key)) is not None}
    return msgspec.structs.replace(_PRESETS[phase], **changes)


def _check_steps(phase: Phase, changed: Protocol) -> None:
    """Refuse steps that do not show what is asked about."""
    path = f"session.{phase.replace('-', '_')}.steps"
    shows = [step.show for step in changed.steps]
    if "a" not in shows or ("b" in shows) != ("preferred" in changed.asks):
        needs = '"a" and "b"' if "preferred" in changed.asks else '"a" and not "b"'
        raise InputError(f"{path} is {shown(shows)}; it must show {needs}.")
    felt = ""
    for show in shows:
        if show in ("a", "b") and felt in ("a", "b") and show != felt:
            raise InputError(f'{path} is {shown(shows)}; it must have "neutral" or "reference" between "a" and "b".')
        felt = show


_FELT = (Step("reference", 4.0), Step("a", 4.0))  # 8 s a trial
_COMPARED = (Step("reference", 4.0), Step("a", 4.0), Step("neutral", 1.0), Step("b", 4.0))  # 12 s felt
_PRESETS: dict[Phase, Protocol] = {
    "warm-up": Protocol("warm-up", _FELT, ("class_a",), 12),
    "optimisation": Protocol("optimisation", _FELT, ("class_a",), 0),
    "validation": Protocol("validation", _COMPARED, ("class_a", "class_b", "preferred"), 4),
    "aggregate-best": Protocol("aggregate-best", _COMPARED, ("preferred",), 2, rest=600.0),
}
