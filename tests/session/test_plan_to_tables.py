"""From a plan through logs and export to the paper's tables: several materials, everybody's sets and people's own."""

import numpy as np
import pandas as pd
import pytest
from live import CHOOSER, RAW

from hilbo import Study
from hilbo.report.validation import validate, validation_figures
from hilbo.session.export.psych_ds import psych_ds
from hilbo.session.export.tables import read_sessions, sets_table
from hilbo.session.log import actions as live
from hilbo.session.log.event_log import EventLog
from hilbo.session.log.log_files import log_name
from hilbo.session.log.records import Header
from hilbo.session.log.state import LiveSession
from hilbo.session.plan.plan import make_plan, planned_header
from hilbo.statistics.paper_tables import paper_tables
from hilbo.study.file.plan_file import Block, Planned
from hilbo.study.tables.validation import read_validation, sets_frame

MATERIALS = ("foam", "soft")
STUDY = Study.from_dict(RAW | {"materials": {name: {} for name in MATERIALS}})
PEOPLE = tuple(f"P{i:02d}" for i in range(1, 7))
ROLES = ("best", "mid", "worst")


def sets_for(source):
    """Best, mid and worst of each material; each person's own ones, or the population's best and each person's own."""
    rng = np.random.default_rng(7)
    prefixes = [f"{person} " for person in PEOPLE] if source == "individual" else [""]
    names = [prefix + role for prefix in prefixes for role in ROLES]
    if source == "best":
        names = ["aggregate", *(f"individual:{person}" for person in PEOPLE)]
    return {m: {n: dict(zip("uv", rng.uniform(size=2).tolist(), strict=True)) for n in names} for m in MATERIALS}


def answered(header, rng):
    """The events of a session in which the better set is mostly classified and preferred as such."""
    state = LiveSession.start(STUDY.file, header)
    while state.screen != "done":
        if state.screen in ("ready", "rest"):
            event = live.go_on(state, 1.0)
        elif state.need is not None:
            event = live.propose(state, CHOOSER, 1.0)
        else:
            trial = state.pending
            event = live.answer(state, trial.id, f"c{state.seq}", values_of(trial, rng), 1.0, felt=False)
        yield event
        state = state.after(event)


def values_of(trial, rng):
    def grade(side):
        name = trial.sets[side]
        true = 2 if "best" in name or "aggregate" in name else 0 if "worst" in name else 1
        return int(np.clip(true + rng.choice([-1, 0, 0, 0, 1]), 0, 2))

    grades = {side: grade(side) for side in trial.sets}
    classes = {f"class_{side}": STUDY.responses[k] for side, k in grades.items()}
    if len(grades) == 1:
        return classes
    preferred = "a" if grades["a"] + 0.1 * rng.normal() > grades["b"] else "b"
    return {"preferred": preferred} | ({} if "individual:" in " ".join(trial.sets.values()) else classes)


def logged(folder, phase, source):
    plan = make_plan(
        STUDY.file,
        PEOPLE,
        3,
        phase,
        sets=sets_for(source),
        source="individual" if source == "individual" else "aggregate",
        session=phase,
    )
    rng = np.random.default_rng(11)
    for person in PEOPLE:
        header = planned_header(plan, STUDY.file, person)
        with EventLog.create(folder / log_name(header), STUDY.file, header) as log:
            for event in answered(header, rng):
                log.append(event)


@pytest.fixture(scope="module", params=["aggregate", "individual"])
def tables(tmp_path_factory, monkeypatch_module, request):
    """The exported folder of a whole study: validation of the population's or people's own sets, then their bests."""
    folder = tmp_path_factory.mktemp(request.param)
    logged(folder, "validation", request.param)
    logged(folder, "aggregate-best", "best")
    psych_ds(read_sessions(folder, STUDY.file), folder / "out", STUDY.file)
    return folder / "out" / "data"


@pytest.fixture(scope="module")
def monkeypatch_module():
    """Logs of tests need not be forced to the disk."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("os.fsync", lambda file: None)
        yield patch


@pytest.mark.parametrize("material", MATERIALS)
@pytest.mark.parametrize("given", [True, False])
def test_a_planned_study_fills_every_table_of_every_material(tables, material, given):
    compared = read_validation(tables / "study-plain_table-validation_data.csv", STUDY.responses, material)
    sets = sets_frame(tables / "study-plain_table-sets_data.csv", ("u", "v")) if given else None
    validated = validate(compared, sets, STUDY.responses, material)
    assert validated.tables.limits == ()
    assert validated.tables.confusion.to_numpy().sum() == len(PEOPLE) * 12 * 2
    assert [validated.tables.confusion.loc[role, "close"] > 24 for role in ROLES] == [True, False, False]
    assert set(zip(validated.tables.preferences["set"], validated.tables.preferences["over"], strict=True)) == {
        ("best", "mid"),
        ("best", "worst"),
        ("mid", "worst"),
    }
    assert validated.tables.table_4.answers == len(PEOPLE) * len(PEOPLE) * 2
    assert set(validation_figures(validated)) == {"validation", "aggregate-best"}


def test_the_exported_sets_say_what_they_are(tables):
    sets = sets_frame(tables / "study-plain_table-sets_data.csv", ("u", "v"))
    worst = sets[(sets["role"] == "worst") & (sets["material"] == "foam")]
    own = "foam worst" not in worst.index
    assert len(worst) == (len(PEOPLE) if own else 1) and len(set(worst["source"])) == len(worst)
    assert worst["source"].str.startswith("individual:s" if own else "aggregate").all()
    assert sets.loc["soft aggregate", ["source", "role", "material"]].tolist() == ["aggregate", "", "soft"]
    others = [name for name in sets.index if name.startswith("soft individual:")]
    assert len(others) == len(PEOPLE) and not any(person in name for person in PEOPLE for name in sets.index)
    assert [sets.at[name, "source"] for name in others] == [name.removeprefix("soft ") for name in others]
    assert set(sets.loc[others, "role"]) == {""}


def test_sets_of_a_renderer_have_all_that_a_device_needs():
    study = Study.load("hilbo/data/paper.toml")
    mechanics = study.space.mechanics
    sets = {n: {"K1": 2.0, "B1": b, "alpha": 0.2} for n, b in (("best", 1.0), ("mid", 2.0))}
    block = Block("validation", 1, (Planned("best", "mid"),))
    header = Header(study=study.file.hash, participant="P01", session="1", seed=0, blocks=(block,), sets=sets)
    row = sets_table([LiveSession.start(study.file, header)]).set_index("set_id").loc["best"]
    assert row[["N", "T", "memory", "role"]].tolist() == [mechanics.N, float(mechanics.T), mechanics.memory, "best"]
    assert "material" not in row
    assert ("states" in row) == (mechanics.memory == "full")


def test_names_of_sets_resolve_without_a_sets_table():
    rows = [
        {"participant": p, "trial": t, "set_a": f"foam {a}", "set_b": f"foam {b}", "class_a": x, "class_b": y}
        | {"preferred": "a"}
        for p in "ABCD"
        for t, (a, b, x, y) in enumerate(
            [("best", "mid", 3, 2), ("best", "worst", 2, 1), ("mid", "worst", 3, 2), ("best", "mid", 3, 1)], 1
        )
    ]
    paper = paper_tables(pd.DataFrame(rows), responses=STUDY.responses)
    assert paper.table_2 is not None and paper.confusion.loc["best"].sum() == 12
