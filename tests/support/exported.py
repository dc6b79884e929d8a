"""One table of answers as the exports of many programs, for tests of `hilbo import`.

The layouts of exports are those of public samples and documentation of each program; those in `export_samples` were
written by the programs themselves.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from hilbo.study.file.reading import StudyFile, checked

SAMPLES = Path(__file__).with_name("export_samples")
RESPONSES = ("different", "similar", "close")
PEOPLE, TRIALS = 6, 8
SECRETS = ("203.0.113.7", "anna@example.org", "Anna Muster", "48.137", "5f1e9c0b2d3a4f5e6a7b8c9d")
"""Texts of columns that no output of an import may hold."""
STUDY = """
schema = 1
[study]
name = "colour"
responses = ["different", "similar", "close"]
[parameters.hue]
low = 140.0
high = 260.0
unit = "deg"
[parameters.light]
low = 20.0
high = 80.0
unit = "%"
[gp]
theta = 10.0
variance = 1.0
thresholds = [-0.4, 0.4]
noise = 0.5
[stimulus]
"""


class Export(NamedTuple):
    """One export of the clean table."""

    name: str
    write: Callable[[Path], list[Path]]
    """Writes the files to a folder; returns them."""
    complete: Callable[[str], str] | None = None
    """Completes the text of the proposed mapping, if the import asks for it; None: nothing is asked."""


def study() -> StudyFile:
    """The study of the clean table."""
    import tomllib

    return checked(tomllib.loads(STUDY), "", lambda file: file)


def clean(seed: int = 0) -> pd.DataFrame:
    """The clean trial table: 6 participants with 8 trials each."""
    rng = np.random.default_rng(seed)
    count = PEOPLE * TRIALS
    hue, light = rng.uniform(140, 260, count).round(1), rng.uniform(20, 80, count).round(2)
    score = 1.2 - ((hue - 190) / 40) ** 2 - ((light - 45) / 25) ** 2 + rng.normal(0, 0.4, count)
    return pd.DataFrame(
        {
            "participant": np.repeat([f"P{number:02d}" for number in range(1, PEOPLE + 1)], TRIALS),
            "trial": np.tile(np.arange(1, TRIALS + 1), PEOPLE),
            "response": np.array(RESPONSES)[np.digitize(score, [-0.4, 0.6])],
            "hue": hue,
            "light": light,
        }
    )


def _text(frame: pd.DataFrame) -> pd.DataFrame:
    """All cells as text."""
    return frame.map(lambda value: value if isinstance(value, str) else repr(value)).astype(object)


def _csv(name: str, change: Callable[[pd.DataFrame], pd.DataFrame], **options: object) -> Export:
    """A CSV file of the changed clean table; `options` of `DataFrame.to_csv`."""

    def write(folder: Path) -> list[Path]:
        path = folder / "export.csv"
        change(clean()).to_csv(path, **({"index": False} | options))
        return [path]

    return Export(name, write)


def _renamed(**names: str) -> Callable[[pd.DataFrame], pd.DataFrame]:
    """A change of column names."""
    return lambda frame: frame.rename(columns=names)


def _cells(column: str, change: Callable[[object], object]) -> Callable[[pd.DataFrame], pd.DataFrame]:
    """A change of each cell of a column."""
    return lambda frame: frame.assign(**{column: frame[column].map(change)})


def _ranks(first: int) -> Callable[[pd.DataFrame], pd.DataFrame]:
    """Responses as ranks from `first`."""
    return _cells("response", lambda label: RESPONSES.index(label) + first)


def _chain(*changes: Callable[[pd.DataFrame], pd.DataFrame]) -> Callable[[pd.DataFrame], pd.DataFrame]:
    """Several changes, one after the other."""

    def change(frame: pd.DataFrame) -> pd.DataFrame:
        for each in changes:
            frame = each(frame)
        return frame

    return change


def _commas(frame: pd.DataFrame) -> pd.DataFrame:
    """Numbers with decimal commas."""
    return _text(frame).assign(**{name: [repr(v).replace(".", ",") for v in frame[name]] for name in ("hue", "light")})


def _personal(frame: pd.DataFrame) -> pd.DataFrame:
    """Columns on persons beside the table."""
    return frame.assign(
        IPAddress=SECRETS[0],
        RecipientEmail=SECRETS[1],
        Name=SECRETS[2],
        LocationLatitude=SECRETS[3],
        PROLIFIC_PID=SECRETS[4],
        duration_s=312,
    )


# Programs that have a row for each trial.


def _rows_between(frame: pd.DataFrame, before: dict[str, object], after: dict[str, object]) -> pd.DataFrame:
    """Rows without a trial before and after those of each participant."""
    parts = []
    for name, rows in frame.groupby("participant", sort=False):
        ends = (pd.DataFrame([{"participant": name} | cells]) for cells in (before, after))
        first, last = ends
        parts += [first, rows.astype(object), last]
    return pd.concat(parts, ignore_index=True)


def _jspsych(frame: pd.DataFrame) -> pd.DataFrame:
    """As jsPsych's data().csv(): events of all plugins, choices counted from 0."""
    rows = _rows_between(
        _ranks(0)(frame), {"trial_type": "instructions", "response": "null"}, {"trial_type": "survey-text"}
    )
    rows["trial_type"] = rows["trial_type"].fillna("html-button-response")
    rows = rows.rename(columns={"trial": "trial_number"})
    return rows.assign(
        trial_index=rows.groupby("participant").cumcount(),
        time_elapsed=range(len(rows)),
        rt=812,
        stimulus="<div>x</div>",
    ).drop(columns="trial_number")


def _psychopy(frame: pd.DataFrame) -> pd.DataFrame:
    """As the wide text of PsychoPy's experiment handler: trials from 0, a last row without a trial."""
    rows = _rows_between(_ranks(1)(frame), {}, {}).rename(columns={"response": "slider.response"})
    return rows.assign(
        **{"trials.thisN": rows["trial"].map(lambda n: "" if pd.isna(n) else str(int(n) - 1))},
        expName="colour",
        psychopyVersion="2024.2.1",
        date="2026-05-04_10h12.33.104",
    ).drop(columns="trial")


def _gorilla(frame: pd.DataFrame) -> pd.DataFrame:
    """As Gorilla's task data: events, a public and a private id, the mark of the end."""
    rows = _rows_between(frame, {"Event Index": 1}, {}).rename(
        columns={"participant": "Participant Private ID", "response": "Response", "trial": "Trial Number"}
    )
    rows = rows.assign(**{"Event Index": range(1, len(rows) + 1), "Participant Public ID": SECRETS[4]})
    return pd.concat([rows, pd.DataFrame([{"Event Index": "END OF FILE"}])])


def _opensesame(frame: pd.DataFrame) -> pd.DataFrame:
    """As OpenSesame's logger."""
    frame = frame.rename(columns={"participant": "subject_nr", "trial": "count_trial_sequence"})
    return frame.assign(experiment_file="colour.osexp", count_trial_sequence=frame["count_trial_sequence"] - 1)


def _eprime(frame: pd.DataFrame) -> pd.DataFrame:
    """As E-Prime's merged export."""
    names = {"participant": "Subject", "trial": "Trial", "response": "Rating.RESP"}
    return _ranks(1)(frame).rename(columns=names).assign(ExperimentName="colour", Session=1)


# Programs that have a row for each participant.


def _wide(frame: pd.DataFrame, name: Callable[[pd.Series], str], columns: tuple[str, ...] = ()) -> pd.DataFrame:
    """One row for each participant, a column of the response, and of `columns`, for each trial. `name`: of the column
    of a row."""
    rows = []
    for person, trials in frame.groupby("participant", sort=False):
        cells: dict[str, object] = {"participant": person}
        for _, trial in trials.iterrows():
            cells |= {f"{column}_{trial['trial']}": trial[column] for column in columns}
            cells[name(trial)] = trial["response"]
        rows.append(cells)
    return pd.DataFrame(rows)


def _same_stimuli() -> pd.DataFrame:
    """The clean table in which all participants have the stimuli of the first one, as surveys do."""
    frame = clean()
    first = frame[:TRIALS]
    return frame.assign(**{name: np.tile(first[name], PEOPLE) for name in ("hue", "light")})


def _qualtrics(folder: Path, frame: pd.DataFrame) -> list[Path]:
    """As Qualtrics' CSV: three header rows, a preview, a column for each question."""
    wide = _wide(frame, lambda trial: f"Q{trial['trial']}").rename(columns={"participant": "ResponseId"})
    wide["ResponseId"] = [f"R_{number:015d}" for number in range(len(wide))]
    before = {"StartDate": "2026-05-04 10:12:33", "EndDate": "2026-05-04 10:30:01", "Status": "IP Address"}
    before |= {"IPAddress": SECRETS[0], "RecordedDate": "2026-05-04 10:30:02", "RecipientEmail": SECRETS[1]}
    wide = pd.DataFrame([before] * len(wide)).join(wide).astype(object)
    preview = wide.iloc[:1].assign(Status="Survey Preview", ResponseId="R_999999999999999")
    questions = pd.DataFrame([{name: f"How close is it,\nin your opinion? ({name})" for name in wide}])
    ids = pd.DataFrame([{name: json.dumps({"ImportId": name}) for name in wide}])
    path = folder / "export.csv"
    pd.concat([questions, ids, preview, wide]).to_csv(path, index=False)
    return [path]


def _limesurvey(frame: pd.DataFrame) -> pd.DataFrame:
    """As LimeSurvey's CSV with the codes of questions: an array of the stimuli."""
    wide = _wide(_ranks(1)(frame), lambda trial: f"Q1[SQ{trial['trial']:03d}]")
    wide = wide.rename(columns={"participant": "id"})
    wide["id"] = range(1, len(wide) + 1)
    return wide.assign(submitdate="2026-05-04 10:12:33", lastpage=3, startlanguage="de", ipaddr=SECRETS[0])


def stimuli_of(pattern: str = "{trial}", number: str = ".") -> Callable[[str], str]:
    """Completion of a mapping's [stimuli] by the first participant's trials; `pattern`: of the stimuli's names."""

    def complete(text: str) -> str:
        head = text.partition("[stimuli]")[0]
        rows = [
            f'"{pattern.format(trial=row.trial)}" = {{hue = {row.hue!r}, light = {row.light!r}}}'
            for row in clean()[:TRIALS].itertuples()
        ]
        return head + "[stimuli]\n" + "\n".join(rows) + "\n"

    return complete


# The corpus.


def _frame(name: str, frame: Callable[[], pd.DataFrame], complete: Callable[[str], str] | None = None) -> Export:
    """A CSV file of a frame."""

    def write(folder: Path) -> list[Path]:
        path = folder / "export.csv"
        frame().to_csv(path, index=False)
        return [path]

    return Export(name, write, complete)


def _file(name: str, file: str, write: Callable[[Path, pd.DataFrame], object]) -> Export:
    """A file of another format than CSV."""

    def written(folder: Path) -> list[Path]:
        write(folder / file, clean())
        return [folder / file]

    return Export(name, written)


def _sample(name: str, *files: str) -> Export:
    """Files that the program has written itself."""
    return Export(name, lambda folder: [SAMPLES / file for file in files])


def _records(frame: pd.DataFrame) -> list[dict[str, object]]:
    """The rows as objects for JSON."""
    return json.loads(frame.to_json(orient="records", double_precision=15))


def _one_file_each(folder: Path) -> list[Path]:
    """As PsychoPy: a file for each participant, whose id is in the name only."""
    paths = []
    for name, rows in _psychopy(clean()).groupby("participant"):
        paths.append(folder / f"{name}.csv")
        rows.drop(columns="participant").to_csv(paths[-1], index=False)
    return paths


def _with_missing(frame: pd.DataFrame) -> pd.DataFrame:
    """More rows, with missing responses in several spellings."""
    marks = ["", "NA", "-1", "don't know", "-1.0", "N/A"]
    more = frame[frame["trial"] <= 1].assign(trial=99, response=marks)
    return pd.concat([frame, more]).sort_values(["participant", "trial"])


def _stimuli_by_name(frame: pd.DataFrame) -> pd.DataFrame:
    """A column that names the stimulus in place of the parameters."""
    return frame.assign(stimulus=[f"S{trial}" for trial in frame["trial"]]).drop(columns=["hue", "light"])


def _fractions(frame: pd.DataFrame) -> pd.DataFrame:
    """The parameter light as a fraction under another name."""
    exact = [format(round(value * 100) / 10000, ".4f") for value in frame["light"]]
    return frame.assign(luminance=exact).drop(columns="light")


def _in_names(frame: pd.DataFrame) -> pd.DataFrame:
    """Parameters in the names of columns."""
    return _wide(frame, lambda trial: f"hue{trial['hue']}_light{trial['light']}")


def _luminance(text: str) -> str:
    """Completion for `_fractions`."""
    return text.replace('light = ""', 'light = "luminance"') + "\n[factors]\nlight = 100\n"


_HEADERS = {
    "participant": "Subject ID",
    "trial": "Trial Nr.",
    "response": "Rating",
    "hue": "Hue (deg)",
    "light": "Light [%]",
}
_SHUFFLED = np.random.default_rng(1).permutation(PEOPLE * TRIALS)

SAME = (
    _csv("clean", lambda frame: frame),
    _csv("semicolons and decimal commas", _commas, sep=";"),
    _csv("tabs", lambda frame: frame, sep="\t"),
    _csv("bars", lambda frame: frame, sep="|"),
    _csv("tabs and decimal commas", _commas, sep="\t"),
    _csv("UTF-16, as Excel's Unicode text", lambda frame: frame, sep="\t", encoding="utf-16"),
    _csv("UTF-8 with a byte order mark", lambda frame: frame, encoding="utf-8-sig"),
    _csv("Windows-1252", lambda frame: frame.assign(Größe="groß"), encoding="cp1252"),
    _csv("all cells quoted", lambda frame: frame, quoting=1),
    _csv("line breaks of Windows", lambda frame: frame, lineterminator="\r\n"),
    _file(
        "sep= line",
        "export.csv",
        lambda path, frame: path.write_text("sep=;\n" + _commas(frame).to_csv(index=False, sep=";")),
    ),
    _file("xlsx", "export.xlsx", lambda path, frame: frame.to_excel(path, index=False)),
    _file("Parquet", "export.parquet", lambda path, frame: frame.to_parquet(path, index=False)),
    _file("JSON records", "export.json", lambda path, frame: path.write_text(json.dumps(_records(frame)))),
    _file(
        "JSON Lines",
        "export.jsonl",
        lambda path, frame: frame.to_json(path, orient="records", lines=True, double_precision=15),
    ),
    _file(
        "JATOS, a list on each line",
        "export.txt",
        lambda path, frame: path.write_text(
            "\n".join(json.dumps(_records(rows)) for _, rows in _jspsych(frame).groupby("participant"))
        ),
    ),
    _csv("R's write.csv with row names", lambda frame: frame, index=True),
    _csv("shuffled rows", lambda frame: frame.iloc[_SHUFFLED]),
    _csv("other names, with units", _renamed(**_HEADERS)),
    _csv(
        "MATLAB's writetable",
        _renamed(participant="Participant", trial="TrialNumber", response="Response", hue="Hue", light="Light"),
    ),
    _csv("units in the cells", _cells("hue", lambda value: f"{value} deg")),
    _csv("ids as floats", _cells("participant", lambda name: float(name[1:]))),
    _csv("ids without zeros", _cells("participant", lambda name: int(name[1:]))),
    _csv("ids of Prolific", _cells("participant", lambda name: f"5f1e9c0b2d3a4f5e6a7b8c{name[1:]}")),
    _csv("addresses as ids", _cells("participant", lambda name: f"{name}@example.org")),
    _csv("UUIDs as ids", _cells("participant", lambda name: f"6f1b0c6e-1d2c-4b7a-9e3f-0000000000{name[1:]}")),
    _csv("labels in capitals with blanks", _cells("response", lambda label: f" {label.title()} ")),
    _csv("no-break blanks", _cells("response", lambda label: f"{label}\u00a0")),
    _csv("ranks from 1", _ranks(1)),
    _csv("ranks from 0", _ranks(0)),
    _csv("ranks as floats", _cells("response", lambda label: float(RESPONSES.index(label) + 1))),
    _csv("missing responses", _with_missing),
    _csv("trials from 0", _cells("trial", lambda number: number - 1)),
    _csv("no trials", lambda frame: frame.drop(columns="trial")),
    _csv("columns on persons", _personal),
    _csv("fractions", _fractions)._replace(complete=_luminance),
    _csv("jsPsych, from its documentation", _jspsych),
    _sample("jsPsych 8.3, CSV", "jspsych.csv"),
    _sample("jsPsych 8.3, JSON", "jspsych.json"),
    _csv("PsychoPy, from its documentation", _psychopy),
    _sample("PsychoPy 2026.2", "psychopy.csv"),
    Export("PsychoPy, a file for each participant", _one_file_each),
    _csv("Gorilla", _gorilla),
    _csv("OpenSesame", _opensesame),
    _csv("E-Prime", _eprime, sep="\t", encoding="utf-16"),
    _csv(
        "wide, with parameters",
        lambda frame: _wide(frame, lambda trial: f"response_{trial['trial']}", ("hue", "light")),
    ),
)
"""Exports from which the clean table follows."""
SAME_STIMULI = (
    Export("Qualtrics", lambda folder: _qualtrics(folder, _same_stimuli()), stimuli_of()),
    _frame("LimeSurvey", lambda: _limesurvey(_same_stimuli()), stimuli_of("{trial:03d}")),
    _frame("stimuli by name", lambda: _stimuli_by_name(_same_stimuli()), stimuli_of("S{trial}")),
    _frame("wide, parameters in names", lambda: _in_names(_same_stimuli())),
)
"""Exports from which the clean table follows in which all participants have the same stimuli."""
