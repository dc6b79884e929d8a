"""What the columns of exported tables mean, in words; and what one is called that holds a parameter of one side."""

from hilbo.study.file.reading import StudyFile
from hilbo.study.file.trial_flags import FLAGS

__all__ = ["UNWRITTEN", "column_words", "presented_column"]

UNWRITTEN = "see the log"
"""What stands in the place of words that a spreadsheet would run; the log has them."""
_WORDS = {
    "participant": "Pseudonymous id",
    "session": "Label of the session",
    "phase": "warm-up, optimisation, repeat, validation or aggregate-best",
    "material": "Reference material",
    "trial": "Number of the trial, counted within participant, session, phase and material",
    "response": "The participant's answer",
    "voided": "1 if the answer does not count",
    "unblinded": "What showed the participant the parameters; empty where nothing did",
    "status": "answered, undone, void, dropped, left out (by a person, after the device stopped it twice) or pending",
    "response_time": "Time from the question to the answer, s, by the browser's clock",
    "answered_at": "Time of the answer, s since 1970, by the server's clock",
    "flags": f"Flags of the device's telemetry during the trial ({', '.join(FLAGS)}), separated by spaces; empty: none",
    "telemetry_samples": "Telemetry samples from the first step to the answer; empty where none were recorded",
    "set_a": "Parameter set on side a",
    "set_b": "Parameter set on side b",
    "first": "The set that was felt first",
    "class_a": "Answer about set_a",
    "class_b": "Answer about set_b",
    "preferred": "The set that was preferred",
    "set_id": "Name of the parameter set",
    "source": "aggregate, sysid or individual:PARTICIPANT",
    "role": "best, mid or worst of the map that the set was read from; empty for others",
    "memory": "short or full: how the past is rendered",
    "states": "Number of exponentials of full memory",
    "voided_reason": f"Why the trial does not count; '{UNWRITTEN}' for words that a spreadsheet would run",
    "phases": "What the session was made of, in its order",
    "plan": "Hash of the plan that the session was held by; empty where it was held by none",
    "seed": "Seed of the session's choices",
    "N": "Number of past samples that are rendered",
    "T": "Time between two samples, s",
}


def column_words(study: StudyFile, kind: str) -> dict[str, str]:
    """What the columns of a table of this kind mean. In tables without parameters no column is one, whatever the study
    calls its own."""
    words = dict(_WORDS)
    for p in study.space.parameters:
        unit = p.range_words if p.levels else p.unit or "no unit"
        words |= {p.name: f"Parameter, {unit}"} if kind in ("trials", "sets") else {}
        for side in "ab":
            words[presented_column(side, p.name)] = f"What was confirmed as presented on side {side}, {unit}"
    return words


def presented_column(side: str, name: str) -> str:
    """The column of what was presented on side a or b; no parameter's own column, and no other, is called so."""
    return f"presented_{side}_{name}"
