"""Session logs as tables and as a Psych-DS folder, made from the logs alone.

`trials_table` is a trial table (every answer to one rendering; voided and undone ones marked so), `validation_table`
and `sets_table` are those of `hilbo.study.validation_table` (voided comparisons left out), `presentations_table` has
every trial that was ever proposed, and what became of it, `sessions_table` the plan that each session was held by.
`read_log_trials` reads a folder of logs as `hilbo.study.trial_table.read_trials` reads the exported table, through the
very same text, so that both give the same bits.
"""

import json
import os
import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from hilbo.errors import InputError
from hilbo.session.confirmed import in_words
from hilbo.session.event_log import log_name, log_paths, read_session
from hilbo.session.records import Trial
from hilbo.session.state import LiveSession
from hilbo.session.table_words import UNWRITTEN, column_words, presented_column
from hilbo.study.set_table import role_of, source_of
from hilbo.study.study_file import AnyStudy
from hilbo.study.text_cells import check_text, runs_in_a_spreadsheet
from hilbo.study.trial_table import read_trials, write_trials

__all__ = [
    "computes_sets",
    "presentations_table",
    "psych_ds",
    "read_log_trials",
    "read_sessions",
    "sessions_table",
    "sets_table",
    "trials_table",
    "validation_table",
]

_SINGLE = ("warm-up", "optimisation", "repeat")


def read_sessions(
    folder: str | os.PathLike, study: AnyStudy, note: Callable[[str], Any] = lambda sentence: None
) -> list[LiveSession]:
    """Every session in a folder but dry runs; `note` is told of those, and of logs that are cut off.

    Raises InputError if there is none, a log is damaged or of another study, or two are of one session.
    """
    paths = log_paths(folder, note)
    if not paths:
        raise InputError(f"{folder}: holds no session logs (*.session.jsonl); check the path.")
    sessions: dict[Path, LiveSession] = {}
    dry = 0
    for path in paths:
        state = read_session(path, study, note)
        dry += state.header.dry_run
        if not state.header.dry_run:
            sessions[path] = state
    if not sessions:
        raise InputError(f"{folder}: holds nothing but dry runs, in which nobody took part.")
    if dry:
        note(f"{folder}: {'1 dry run is' if dry == 1 else f'{dry} dry runs are'} left out.")
    _check_once(sessions)
    return list(sessions.values())


def _check_once(sessions: Mapping[Path, LiveSession]) -> None:
    """Refuse two logs of one session, such as a copy beside its original: their answers would count twice."""
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
    """Every answer to a single rendering, one row each, numbers as they were chosen."""
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
                )
    return _table(rows)


def validation_table(sessions: Sequence[LiveSession]) -> pd.DataFrame:
    """Every comparison that counts. Where a program presents, with what it confirmed of either side, which may be off
    from the sets that were planned."""
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
                )
    return _table(rows)


def _confirmed(study: AnyStudy, trial: Trial) -> dict[str, float | str]:
    """What was presented on either side, in columns that no parameter's own name can be; {} where a device renders."""
    if study.stimulus is None:
        return {}
    shown = {side: in_words(study, values) for side, values in trial.presented.items()}
    return {presented_column(side, p.name): shown[side][p.name] for side in shown for p in study.space.parameters}


def sets_table(sessions: Sequence[LiveSession]) -> pd.DataFrame:
    """The compared parameter sets, as they were planned. Raises InputError if one name stands for two sets."""
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
    """Whether `sets_table` has to compute, with JAX: the K0 of sets that were compared."""
    compared = any(p.b is not None for state in sessions for block in state.header.blocks for p in block.trials)
    return compared and any(state.study.space.mechanics is not None for state in sessions)


def _parameters(box, values: Mapping[str, float]) -> dict[str, Any]:
    """A set's parameters, with the K0 of one that is rendered."""
    if box.mechanics is None:
        return {p.name: p.shown(values[p.name]) if p.levels else float(values[p.name]) for p in box.parameters}
    from hilbo.search.space import SearchSpace
    from hilbo.session.set_facts import described

    return described(SearchSpace(box.parameters, box.mechanics), values).parameters


def _rendered(mechanics) -> dict[str, Any]:
    """How all sets of a study are rendered; `states` only where there are any."""
    if mechanics is None:
        return {}
    facts = {"N": mechanics.N, "T": float(mechanics.T), "memory": mechanics.memory}
    return facts | ({"states": mechanics.states} if mechanics.memory == "full" else {})


def presentations_table(sessions: Sequence[LiveSession]) -> pd.DataFrame:
    """Every trial that was proposed, and what became of it."""
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


def sessions_table(sessions: Sequence[LiveSession]) -> pd.DataFrame:
    """Every session, with the hash of the plan that it was held by; empty where it was held by none."""
    rows = []
    for state in sessions:
        header = state.header
        phases = ", ".join(dict.fromkeys(block.phase for block in header.blocks))
        place = {"participant": header.participant, "session": header.session, "phases": phases}
        rows.append(place | {"plan": _written(header.plan or ""), "seed": header.seed})
    return pd.DataFrame(rows)


def read_log_trials(
    folder: str | os.PathLike,
    study: AnyStudy,
    material: str | None = None,
    *,
    others: bool = True,
    say: Callable[[int], None] = lambda rows: None,
    note: Callable[[str], Any] = lambda sentence: None,
) -> pd.DataFrame:
    """As `hilbo.study.trial_table.read_trials`, from a folder of session logs; `study` is the whole one, of all
    materials."""
    table = trials_table(read_sessions(folder, study, note))
    if table.empty:
        raise InputError(f"{folder}: its sessions hold no answers yet; nothing can be aggregated.")
    chosen = study.material(material) if material and study.materials else study
    with tempfile.TemporaryDirectory() as made:
        path = Path(made) / "trials.csv"
        write_trials(table, path)

        def note_of_logs(sentence: str) -> None:
            note(sentence.replace(str(path), str(folder)))

        try:
            return read_trials(path, chosen, material, others=others, say=say, note=note_of_logs)
        except InputError as error:
            raise InputError(str(error).replace(str(path), str(folder))) from None


def psych_ds(sessions: Sequence[LiveSession], folder: Path, study: AnyStudy) -> list[Path]:
    """Tables with their sidecars and dataset_description.json, in the shape of a Psych-DS data set; the files.
    Raises InputError for an id, label or name of a set that a spreadsheet would run."""
    for state in sessions:
        _check_names(state)
    tables = {
        "trials": trials_table(sessions),
        "validation": validation_table(sessions),
        "sets": sets_table(sessions),
        "presentations": presentations_table(sessions),
        "sessions": sessions_table(sessions),
    }
    data = folder / "data"
    data.mkdir(parents=True, exist_ok=True)
    name = re.sub(r"[^A-Za-z0-9]", "", study.name) or "study"
    written: list[Path] = []
    columns: dict[str, Any] = {}
    for kind, table in tables.items():
        if table.empty:
            continue
        path = data / f"study-{name}_table-{kind}_data.csv"
        write_trials(table, path)
        sidecar = path.with_suffix(".json")
        words = column_words(study, kind)
        here = [_variable(str(column), words) for column in table.columns]
        columns |= {variable["name"]: variable for variable in here if variable["name"] not in columns}
        sidecar.write_text(
            _json({"description": f"{kind} of {study.name}", "variableMeasured": here}), encoding="utf-8"
        )
        written += [path, sidecar]
    description = {
        "@context": "https://schema.org/",
        "@type": "Dataset",
        "name": study.name,
        "description": f"Live sessions of {len(sessions)} logs, study {study.hash}, written by hilbo.",
        "schemaVersion": "Psych-DS 0.4.0",
        "variableMeasured": list(columns.values()),
    }
    path = folder / "dataset_description.json"
    path.write_text(_json(description), encoding="utf-8")
    return [*written, path]


def _written(text: Any) -> Any:
    return UNWRITTEN if isinstance(text, str) and runs_in_a_spreadsheet(text) else text


def _check_names(state: LiveSession) -> None:
    """Names cannot be left out as words can: without them a table does not say whose its rows are."""
    header, place = state.header, log_name(state.header)
    check_text(header.participant, "participant", place)
    check_text(header.session, "the session's label", place)
    for name in header.sets:
        check_text(name, "the name of a set", place)


def _place(state, trial: Trial):
    data, header = trial.data, state.header
    return {
        "participant": header.participant,
        "session": header.session,
        "phase": data["phase"],
        "material": data["material"],
        "trial": trial.number,
    }


def _times(trial: Trial):
    answered = trial.answered or {}
    return {
        "response_time": answered.get("browser", {}).get("response_s"),
        "answered_at": answered.get("time"),
    }


def _table(rows):
    """Without columns that say nothing."""
    table = pd.DataFrame(rows)
    for column in ("material", "response_time", "unblinded"):
        if column in table and table[column].isna().all():
            table = table.drop(columns=column)
    return table


def _variable(column, words):
    return {"@type": "PropertyValue", "name": column, "description": words.get(column, column.replace("_", " "))}


def _json(content):
    return json.dumps(content, indent=2, ensure_ascii=False) + "\n"
