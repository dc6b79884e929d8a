"""What the exports of known programs look like: names of columns by which one is recognised, and their meaning. Loads
no JAX, no pandas."""

import re
import unicodedata
from collections.abc import Collection, Iterable, Sequence
from typing import NamedTuple

__all__ = ["PARTICIPANT", "RESPONSE", "TRIAL", "Tool", "key", "named", "other_unit", "personal", "tool_of"]


class Tool(NamedTuple):
    """A program that exports tables of responses."""

    name: str
    signs: tuple[str, ...]
    """Columns that together occur in its exports only."""
    participant: tuple[str, ...] = ()
    """Its columns of the participant, the best one first."""
    rows: tuple[tuple[str, tuple[str, ...]], ...] = ()
    """Columns, and the cells that a row of a participant has there."""
    header_rows: int = 1
    counts_from_zero: bool = False
    """Whether choices count from 0."""


_TOOLS = (
    Tool("Qualtrics", ("StartDate", "RecordedDate", "ResponseId"), ("ResponseId",), (("Status", ("0", "IP Address")),)),
    Tool("jsPsych", ("trial_type", "trial_index", "time_elapsed"), counts_from_zero=True),
    Tool("PsychoPy", ("expName", "psychopyVersion")),
    Tool("PsychoPy", ("expName", "frameRate")),
    Tool("Gorilla", ("Event Index", "Participant Private ID"), ("Participant Private ID",)),
    Tool("LimeSurvey", ("submitdate", "lastpage", "startlanguage"), ("id", "Response ID")),
    Tool("SoSci Survey", ("CASE", "QUESTNNR", "STARTED"), ("CASE",)),
    Tool("SurveyMonkey", ("Respondent ID", "Collector ID"), ("Respondent ID",), header_rows=2),
    Tool("Microsoft Forms", ("ID", "Start time", "Completion time", "Email"), ("ID",)),
    Tool("REDCap", ("record_id", "redcap_event_name"), ("record_id",)),
    Tool("OpenSesame", ("subject_nr", "experiment_file"), ("subject_nr",)),
    Tool("E-Prime", ("ExperimentName", "Subject", "Session"), ("Subject",)),
    Tool("Labvanced", ("Exp_Subject_Id", "Rec_Session_Id"), ("Exp_Subject_Id",)),
)  # fmt: skip
PARTICIPANT = (
    *("participant", "participantid", "participantcode", "participantnumber", "subject", "subjectid", "subjectnr"),
    *("subjectnumber", "subj", "sub", "ppt", "ppid", "pid", "vp", "vpn", "vpcode", "proband", "versuchsperson"),
    *("observer", "rater", "judge", "assessor", "panelist", "person", "user", "userid", "code", "prolificpid"),
    *("prolificid", "workerid", "responseid", "respondentid", "runid", "id"),
)
"""Keys of columns that name the participant, the most usual first."""
TRIAL = (
    *("trial", "trialnumber", "trialnr", "trialno", "trialnum", "trialindex", "thisn", "thistrialn", "trialcount"),
    *("presentationorder", "trialorder", "order", "repetition"),
)
"""Keys of columns that number the trials, the most usual first."""
RESPONSE = (
    *("response", "rating", "answer", "judgement", "judgment", "choice", "score", "category", "resp", "keys"),
    *("urteil", "antwort", "bewertung"),
)
"""Keys of columns with the response, the most usual first."""
_BRACKET = re.compile(r"[(\[](.*)[)\]]")
_PERSONAL = {
    *("ipaddress", "ip", "email", "emailaddress", "recipientemail", "name", "firstname", "lastname", "surname"),
    *("recipientfirstname", "recipientlastname", "username", "address", "street", "city", "place", "zip", "postcode"),
    *("country", "region", "locationlatitude", "locationlongitude", "latitude", "longitude", "phone", "telephone"),
    *("birthday", "dateofbirth", "birthdate", "prolificpid", "prolificid", "workerid", "assignmentid", "hitid"),
    *("participantpublicid", "participantprivateid", "token", "externaldatareference", "externalreference"),
    *("responseid", "respondentid", "collectorid", "useragent", "browser", "ipaddr", "studyid", "sessionid"),
    *("refurl", "serial", "ref", "customdata1", "srresultid", "batchid", "fullname", "vorname", "nachname", "ort"),
}


def key(name: str) -> str:
    """The form in which names of columns are compared: letters and digits only, lower case."""
    return "".join(c for c in unicodedata.normalize("NFKC", name).casefold() if c.isalnum())


def named(columns: Sequence[str], wanted: Iterable[str], unit: str = "") -> list[str]:
    """The columns that have one of the wanted names: those with the name as it stands, else with the same `key`, else
    with a unit behind it, else with a part before a dot. The first wanted name that is found decides."""
    for name in wanted:
        same = {key(name), key(name + unit)}
        if hits := (
            [column for column in columns if column == name]
            or [column for column in columns if key(column) in same]
            or [column for column in columns if key(_BRACKET.sub("", column)) in same]
            or [column for column in columns if key(_called(column)) in same and not personal([column])]
        ):
            return hits
    return []


def other_unit(column: str, unit: str) -> bool:
    """Whether a column's name has a unit in brackets that is not `unit`."""
    bracket = _BRACKET.search(column)
    return bracket is not None and bracket[1].strip().casefold() != unit.casefold()


def _called(column: str) -> str:
    """The part of a dotted name that says what it is: the last one, but "x" of "x.id" and of "x.Q0"; "" for others."""
    *before, last = column.split(".")
    return (before[-1] if re.fullmatch(r"id|Q\d+", last) else last) if before else ""


def personal(columns: Iterable[str]) -> list[str]:
    """The columns that by their name identify a person: address, name, place, id of a platform."""
    return [column for column in columns if key(column.rpartition(".")[2]) in _PERSONAL]


def tool_of(columns: Collection[str]) -> Tool:
    """The program whose export has these columns; one without a name if none is known."""
    return next((tool for tool in _TOOLS if set(tool.signs) <= set(columns)), Tool("", ()))
