"""Protocols of a session as data: presentations and their durations, questions, and every text for participants.

A trial is a list of steps (the reference, stimulus a, stimulus b, a neutral interval) with their durations, then
questions. Four phases are predefined (paper, "Experimental Protocol" and "Sessions"): `warm-up`, `optimisation`,
`validation` (pairs out of best, mid and worst: two classes and a preference) and `aggregate-best` (a preference). The
study file's optional table [session] changes them:

    [session]
    protocol_number = "2025-17"            # of the ethics approval
    language = "de"                        # hilbo/data/texts has the texts of each
    [session.optimisation]
    steps = [{show = "reference", seconds = 4}, {show = "a", seconds = 4}]
    [session.texts]
    question = "…"                         # any key of hilbo/data/texts/en.toml
    [session.labels]
    close = "…"                            # button text of a response
    [session.definitions]
    close = "…"                            # explanation of a response

Stimuli are changed out of contact only: while the participant feels the reference, or during a neutral interval.
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
    """A part of a trial: the stimulus or interval presented, and its duration in seconds."""

    show: Show
    seconds: Annotated[float, msgspec.Meta(gt=0, le=600)]


class Protocol(msgspec.Struct, frozen=True):
    """A phase: the steps of each trial, its questions, and the number of trials.

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
    """[session]: what a study changes of its live sessions: texts, language and phases."""

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
        """Raise `InputError` for unknown keys of texts, labels and definitions, and for steps that do not suit a
        phase's questions."""
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
        """Text for participants by its key: the study's own, otherwise that of its language. Raises KeyError for an
        unknown key."""
        return self.texts.get(key, language(self.language).texts[key])

    def untranslated(self, responses: Sequence[str]) -> list[str]:
        """Responses whose button text is neither in the study's [session.labels] nor in its language; empty for
        English."""
        known = {**language(self.language).labels, **self.labels}
        return [] if self.language == "en" else [response for response in responses if response not in known]

    def label(self, response: str) -> str:
        """Button text of a response: the study's own, that of its language, or the response with a capital."""
        return self.labels.get(response, language(self.language).labels.get(response, response.capitalize()))

    def definition(self, response: str) -> str:
        """Explanation of a response: the study's own, that of its language, or ""."""
        return self.definitions.get(response, language(self.language).definitions.get(response, ""))


def protocol(session: SessionTable, phase: Phase) -> Protocol:
    """Protocol of a phase: the paper's, with the study's changes of steps, count and rest."""
    table: PhaseTable = getattr(session, phase.replace("-", "_"))
    changes = {key: value for key in ("steps", "count", "rest") if (value := getattr(table, key)) is not None}
    return msgspec.structs.replace(_PRESETS[phase], **changes)


def _check_steps(phase: Phase, changed: Protocol) -> None:
    """Raise InputError unless the steps show "a", show "b" only in a phase that asks for a preference, and have
    "neutral" or "reference" between them."""
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
