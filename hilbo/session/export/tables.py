"""Session logs as tables, made from the logs only.

`trials_table` is a trial table (every answer to a single rendering, voided and undone ones marked), `validation_table`
and `sets_table` are those of `hilbo.study.tables.validation` (without voided comparisons), `presentations_table` has
every proposed trial and its outcome, `sessions_table` each session and its plan. `log_cells` are the cells of
`trials_table` as text, checked like those of a file; both give the same bits.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from hilbo.errors import InputError
from hilbo.session.log.event_log import read_session
from hilbo.session.log.log_files import log_paths
from hilbo.session.log.presented import in_words
from hilbo.session.log.records import Trial
from hilbo.session.log.state import LiveSession
from hilbo.study.file.columns import UNWRITTEN, presented_column
from hilbo.study.file.reading import StudyFile
from hilbo.study.file.trial_flags import COLUMN, COLUMN_OF_SAMPLES, SAMPLES, flag_words
from hilbo.study.formats.cell_text import runs_in_a_spreadsheet
from hilbo.study.formats.csv_file import cells_of
from hilbo.study.tables.parameter_sets import role_of, source_of
from hilbo.study.tables.trials import TrialTable, trial_table

__all__ = [
    "computes_sets",
    "log_cells",
    "presentations_table",
    "read_log_trials",
    "read_sessions",
    "sessions_table",
    "sets_table",
    "trials_table",
    "validation_table",
]

_SINGLE = ("warm-up", "optimisation", "repeat")


def read_sessions(
    folder: str | os.PathLike, study: StudyFile, note: Callable[[str], object] = lambda sentence: None
) -> list[LiveSession]:
    """Read every session in a folder except dry runs, every event checked. `note` is called with sentences on dry runs,
    on logs that are incomplete or left out, and on sessions with another version of the study file.

    Raises InputError if there is none, a log is damaged or of another study, or two are of one session.
    """
    paths = log_paths(folder, note)
    if not paths:
        raise InputError(f"{folder}: contains no session logs (*.session.jsonl); check the path.")
    sessions: dict[Path, LiveSession] = {}
    dry = 0
    for path in paths:
        state = read_session(path, study, note)
        dry += state.header.dry_run
        if not state.header.dry_run:
            sessions[path] = state
    if not sessions:
        raise InputError(f"{folder}: contains only dry runs, without a participant.")
    if dry:
        note(f"{folder}: {'1 dry run is' if dry == 1 else f'{dry} dry runs are'} left out.")
    _check_once(sessions)
    changed = {state.study.hash: state.study for state in sessions.values() if state.study.hash != study.hash}
    for other in changed.values():
        count = sum(state.study.hash == other.hash for state in sessions.values())
        note(
            f"{folder}: {'1 session was' if count == 1 else f'{count} sessions were'} begun with another version of the"
            f" study file, which differs in {', '.join(study.changes(other))}."
        )
    return list(sessions.values())


def _check_once(sessions: Mapping[Path, LiveSession]) -> None:
    """Raise InputError for two logs of one session, such as a copy next to its original: answers would count twice."""
    first: dict[tuple[str, str], Path] = {}
    for path, state in sessions.items():
        header = state.header
        other = first.setdefault((header.participant, header.session), path)
        if other != path:
            raise InputError(
                f'{path.parent}: "{other.name}" and "{path.name}" are both logs of session {header.session} of'
                f" participant {header.participant}, whose answers would count twice; keep one of them here."
            )


def trials_table(sessions: Sequence[LiveSession]) -> pd.DataFrame:
    """Table of all answers to single renderings, one row each, also warm-up, repetitions, voided and undone ones
    (`voided` 1)."""
    rows = []
    for state in sessions:
        for trial in state.trials:
            if trial.data["phase"] in _SINGLE and trial.values is not None and "b" not in trial.renderings:
                rows.append(
                    _place(state, trial)
                    | {"response": trial.values["class_a"]}
                    | in_words(state.study, trial.presented["a"])
                    | {"voided": int(trial.status != "answered"), "status": trial.status}
                    | {"unblinded": state.header.unblinded or None}
                    | _times(trial)
                    | _telemetry(trial)
                )
    return _table(rows)


def validation_table(sessions: Sequence[LiveSession]) -> pd.DataFrame:
    """Table of all comparisons that count, one row each, without repetitions; with a stimulus program also the values
    that it confirmed, which may differ from the planned sets."""
    rows = []
    for state in sessions:
        for trial in state.trials:
            if trial.values is not None and trial.status == "answered" and "b" in trial.renderings:
                sets, values = trial.sets, trial.values
                place = _place(state, trial)
                if trial.data["phase"] == "repeat":
                    continue
                rows.append(
                    {key: place[key] for key in ("participant", "material", "session", "phase", "trial")}
                    | {"set_a": sets["a"], "set_b": sets["b"], "first": sets[trial.first]}
                    | {"class_a": values.get("class_a", ""), "class_b": values.get("class_b", "")}
                    | {"preferred": sets[values["preferred"]]}
                    | _confirmed(state.study, trial)
                    | _times(trial)
                    | {"shortest_time": (trial.answered or {}).get("browser", {}).get("shortest_s")}
                    | _telemetry(trial)
                )
    return _table(rows)


def _confirmed(study: StudyFile, trial: Trial) -> dict[str, float | str]:
    """Columns with the values presented on either side, under names that no parameter has; {} if a device renders."""
    if study.stimulus is None:
        return {}
    shown = {side: in_words(study, values) for side, values in trial.presented.items()}
    return {presented_column(side, p.name): shown[side][p.name] for side in shown for p in study.space.parameters}


def sets_table(sessions: Sequence[LiveSession]) -> pd.DataFrame:
    """Table of the planned sets of comparisons, one row each; with mechanics JAX is loaded to compute K0. Raises
    InputError if two different sets have the same name."""
    rows: dict[str, dict[str, Any]] = {}
    for state in sessions:
        for block in state.header.blocks:
            study = state.study if block.material is None else state.study.material(block.material)
            rendered = _rendered(study.space.mechanics)
            for name in dict.fromkeys(n for p in block.trials if p.b is not None for n in (p.a, p.b)):
                is_what = {"source": source_of(name, block.material), "role": role_of(name), "material": block.material}
                values = _parameters(study.space, state.header.sets[name])
                row = {"set_id": name, **is_what, **values, **rendered}
                if rows.setdefault(name, row) != row:
                    raise InputError(
                        f'the set "{name}" of participant {state.header.participant} is not the one that others felt'
                        " under this name; export the logs of one plan at a time."
                    )
    return _table(list(rows.values()))


def computes_sets(sessions: Sequence[LiveSession]) -> bool:
    """Whether `sets_table` has to load JAX: to compute the K0 of sets that are compared."""
    compared = any(p.b is not None for state in sessions for block in state.header.blocks for p in block.trials)
    return compared and any(state.study.space.mechanics is not None for state in sessions)


def _parameters(box, values: Mapping[str, float]) -> dict[str, Any]:
    """Columns of a set's parameters, levels by name; with mechanics also its K0, for which JAX is loaded."""
    if box.mechanics is None:
        return {p.name: p.shown(values[p.name]) if p.levels else float(values[p.name]) for p in box.parameters}
    from hilbo.search.rendering import Rendering
    from hilbo.search.space import SearchSpace

    return Rendering.of(SearchSpace(box.parameters, box.mechanics), values).parameters


def _rendered(mechanics) -> dict[str, Any]:
    """Columns N, T and memory of the study's mechanics, and `states` for full memory; {} without mechanics."""
    if mechanics is None:
        return {}
    facts = {"N": mechanics.N, "T": float(mechanics.T), "memory": mechanics.memory}
    return facts | ({"states": mechanics.states} if mechanics.memory == "full" else {})


def presentations_table(sessions: Sequence[LiveSession]) -> pd.DataFrame:
    """Table of all proposed trials, one row each, with status, number of presentations, times, and why and by whom it
    was voided. Without trials it has no columns; `material` and `response_time` are missing where no row has one."""
    rows = []
    for state in sessions:
        for trial in state.trials:
            rows.append(
                _place(state, trial)
                | {"status": trial.status, "presentations": trial.presentation, "proposed_at": trial.proposed}
                | {f"voided_{key}": _written((trial.voided or {}).get(key, "")) for key in ("by", "reason")}
                | _times(trial)
            )
    return _table(rows)


def sessions_table(sessions: Sequence[LiveSession], study: StudyFile) -> pd.DataFrame:
    """Table of sessions, one row each: participant, session, phases, hash of the plan (empty without a plan), seed,
    number and longest (s) of the pauses, times of the first and the last event (s since the epoch), hash of the
    session's own study file, and the keys in which it differs from `study`."""
    rows = []
    for state in sessions:
        header = state.header
        phases = ", ".join(dict.fromkeys(block.phase for block in header.blocks))
        place = {"participant": header.participant, "session": header.session, "phases": phases}
        pauses = [pause.seconds for pause in state.pauses]
        away = {"pauses": len(pauses), "longest_pause": max(pauses, default=0.0)}
        file = {"study": header.study, "differs_in": ", ".join(study.changes(state.study))}
        plan = {"plan": _written(header.plan or ""), "seed": header.seed}
        rows.append(place | plan | away | {"began_at": state.began, "ended_at": state.last} | file)
    return pd.DataFrame(rows)


def log_cells(
    folder: str | os.PathLike, study: StudyFile, note: Callable[[str], object] = lambda sentence: None
) -> list[pd.DataFrame]:
    """The trial table of a folder of session logs as one frame of text cells, in a list. `study` has all materials.

    `note` is called with sentences on logs and dry runs that are left out. Raises InputError for logs that are damaged
    or of another study, and if there are no answers.
    """
    table = trials_table(read_sessions(folder, study, note))
    if table.empty:
        raise InputError(f"{folder}: its sessions have no responses yet; nothing can be aggregated.")
    return [cells_of(table)]


def read_log_trials(
    folder: str | os.PathLike,
    study: StudyFile,
    material: str | None = None,
    *,
    note: Callable[[str], object] = lambda sentence: None,
) -> TrialTable:
    """The trial table of a folder of session logs, of one `material` if it is given. `study` has all materials.

    `note` is called with sentences on omitted sessions. Raises InputError for logs that are damaged or of another
    study, if there are no answers, and for rows that `trial_table` refuses.
    """
    chosen = study.material(material) if material and study.materials else study
    return trial_table(log_cells(folder, study, note), chosen, material, source=str(folder), note=note)


def _written(text: Any) -> Any:
    """Return the value, or `UNWRITTEN` in place of a text that a spreadsheet would run as a formula."""
    return UNWRITTEN if isinstance(text, str) and runs_in_a_spreadsheet(text) else text


def _place(state: LiveSession, trial: Trial) -> dict[str, Any]:
    """Columns that identify a trial: participant, session, phase, material and trial number."""
    data, header = trial.data, state.header
    return {
        "participant": header.participant,
        "session": header.session,
        "phase": data["phase"],
        "material": data["material"],
        "trial": trial.number,
    }


def _times(trial: Trial) -> dict[str, Any]:
    """Columns `response_time` (s) and `answered_at` (s since the epoch); None where they are not known."""
    answered = trial.answered or {}
    return {
        "response_time": answered.get("browser", {}).get("response_s"),
        "answered_at": answered.get("time"),
    }


def _telemetry(trial: Trial) -> dict[str, Any]:
    """Columns with the telemetry flags of a trial (as text) and its number of samples; None if none were recorded."""
    counts = trial.telemetry
    flags = None if counts is None else flag_words(name for name in counts if name != SAMPLES)
    return {COLUMN: flags, COLUMN_OF_SAMPLES: None if counts is None else counts[SAMPLES]}


def _table(rows: list[dict[str, Any]]) -> pd.DataFrame:
    """Data frame of the rows, without optional columns that have no values."""
    table = pd.DataFrame(rows)
    if COLUMN_OF_SAMPLES in table:
        table[COLUMN_OF_SAMPLES] = table[COLUMN_OF_SAMPLES].astype("Int64")  # whole numbers, also where some lack
    for column in ("material", "response_time", "shortest_time", "unblinded", COLUMN, COLUMN_OF_SAMPLES):
        if column in table and table[column].isna().all():
            table = table.drop(columns=column)
    return table
