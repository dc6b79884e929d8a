"""The page for a pre-registration: what files fix stands there, and what they do not is left to its author."""

from pathlib import Path

import pytest
from commands import run
from live import RAW

from hilbo.population.rules.registry import RECIPES, RULES
from hilbo.report.registration import registration
from hilbo.session.plan.plan import make_plan, reissue
from hilbo.study.config import Study
from hilbo.study.departures import changed_files, departures
from hilbo.study.estimate.optimum import _LOSS
from hilbo.study.file.plan_file import plan_text, read_plan
from hilbo.study.file.reading import StudyFile
from hilbo.study.tables.sessions import SessionRow
from hilbo.study.template import NewStudy, parameter_of, study_text

PAPER = Path("hilbo/data/paper.toml")
TEXT = PAPER.read_text()


@pytest.fixture
def page(tmp_path):
    def of(text=TEXT, people=("P01", "P02", "P03"), **others):
        path = tmp_path / "study.toml"
        path.write_text(text)
        study = StudyFile.load(path)
        return registration(study, make_plan(study, people, 5, **others), "1.2.3")

    return of


def test_levels_whole_numbers_constraints_and_a_person_who_presents_stand_on_the_page(tmp_path):
    named = ("texture=silk,wood", "grains=0:6::integer", "gain=0.5:20:N")
    text = study_text(NewStudy("s", tuple(map(parameter_of, named)), by="person"))
    text += "[[constraints]]\nterms = {gain = 1, grains = -2.5}\nleast = -3\nmost = 24\n"
    (tmp_path / "study.toml").write_text(text)
    planned = make_plan(StudyFile.load(PAPER), ("P01",), 5)  # of another study, whose points are drawn already
    written = registration(StudyFile.load(tmp_path / "study.toml"), planned, "1.2.3")
    for part in (
        '| texture | "silk", "wood" | | | levels, without an order |',
        "| grains | 0 | 6 |  | linear, whole numbers |",
        "Only stimuli with -3 <= gain - 2.5 grains <= 24 are presented.",
        "A person presents them",
        "correlation 0.5 of any two levels of texture",
    ):
        assert part in written


def test_what_is_fixed_stands_on_the_page(page):
    text = page()
    for part in (
        "hash",
        "seed 5",
        "hilbo 1.2.3",
        "3, P01 to P03",
        "| K1 | 1 | 32 | N/mm | linear |",
        "committee machine (`bcm`)",
    ):
        assert part in text
    assert "25 trials that count" in text and "5 spread over" in text and "weight 0.7" in text
    assert "theta 30, variance 1, thresholds (-0.5, 0.5), noise 0.5" in text
    assert "passive on the device" in text and "No participant is excluded" in text
    assert text.count("To be written by you") == 4


def test_the_page_follows_the_study(page):
    text = page(
        PAPER.read_text()
        .replace('rule = "bcm"', 'rule = "learnt-1"')
        .replace("theta = 30.0\n", "")
        .replace("[parameters.K1]", 'exclude = "trials < 10"\nexclude_flags = ["input_held"]\n[parameters.K1]', 1)
        .replace('acquisition = "ucb"', 'acquisition = "top_category"')
    )
    assert "recipe learnt-1" in text and "the rest learnt" in text and "theta" not in text
    assert "Participants with `trials < 10` are excluded" in text
    assert "Trials with these device flags are excluded: input held (`[study] exclude_flags`)." in text
    assert "probability of the goal)" in text


@pytest.mark.parametrize("rule", ["bcm", *RECIPES])
def test_the_primary_result_is_the_optimum_of_the_study_s_rule(page, rule):
    text = page(TEXT.replace('rule = "bcm"', f'rule = "{rule}"'))
    (primary,) = (line for line in text.splitlines() if line.startswith("* Primary result"))
    assert ("maximum of the population map" in primary) == (rule == "bcm")
    centred = RULES[rule].centred
    assert (f'new participant answers "close" is within {_LOSS} of its maximum' in primary) == centred


def planned(tmp_path, text="", **others):
    study = StudyFile.load(PAPER)
    path = tmp_path / "plan.json"
    path.write_text(text or plan_text(make_plan(study, ["P01", "P02"], 0, **others)))
    return path


PLANNED = StudyFile.load(PAPER).hash


def session_of(name, plan, phases="warm-up, optimisation", began=0.0, study=PLANNED, differs=""):
    return SessionRow(name, "1", phases, plan, began, None, study, differs)


def test_the_page_has_groups_and_protocols_by_material(tmp_path):
    tables = {
        "materials": {"foam": {}, "soft": {"session": {"aggregate_best": {"count": 3}}}},
        "plan": {"people": {"foam": 2, "soft": 1}},
    }
    file = Study.from_dict(RAW | tables).file
    text = registration(file, make_plan(file, ["P01", "P02", "P03"], 0), "1")
    assert "Participants by material: foam 2, soft 1; each was assigned to one at random" in text
    assert "counterbalanced" not in text and text.count("* A trial:") == 1
    own = {"aggregate": {"u": 0.5, "v": 0.5}, "individual:P01": {"u": 0.1, "v": 0.2}}
    plan = make_plan(file, ["A1"], 0, "aggregate-best", sets={"foam": own, "soft": own})
    text = registration(file, plan, "1")
    assert "Each pair of foam is presented 2 times" in text and "Each pair of soft is presented 3 times" in text


def test_departures_from_a_plan(tmp_path):
    path = planned(tmp_path)
    departs, (nothing,) = departures([read_plan(path)], {"P01": {"": 25}, "P02": {"": 25}})
    assert departs == ()
    assert nothing.startswith("Nothing departs from the plan") and "2 participants, 25 answers each" in nothing
    sentences, nothing = departures([read_plan(path)], {"P01": {"": 12}, "P09": {"": 25}})
    assert nothing == () and all(sentence.startswith("Departs from the plan") for sentence in sentences)
    text = " ".join(sentences)
    for part in ("without answers here: P02 (1 of 2)", "Not in the plan", "P09.", "planned: P01 (12 in place of 25)."):
        assert part in text
    assert "P09 (25" not in text


def test_counts_are_compared_material_by_material(tmp_path):
    study = Study.from_dict(RAW | {"materials": {"foam": {}, "soft": {}, "hard": {}}}).file
    plan = make_plan(study, ["P01", "P02"], 0)
    trials = study.selection.trials
    whole = dict.fromkeys(study.materials, trials)
    assert departures([plan], {"P01": whole, "P02": whole})[0] == ()
    less = {name: count - (name == study.materials[0]) for name, count in whole.items() if name != study.materials[1]}
    (sentence,), _ = departures([plan], {"P01": whole, "P02": less})
    first, second = study.materials[:2]
    assert f"{trials - 1} in place of {trials} of {first}" in sentence
    assert f"0 in place of {trials} of {second}" in sentence and "P01" not in sentence


def test_sessions_of_several_plans_are_compared_phase_by_phase(tmp_path):
    study = StudyFile.load(PAPER)
    sets = {"": {name: {"K1": 2.0, "B1": b, "alpha": 0.5} for name, b in (("best", 1.0), ("mid", 2.0), ("worst", 3.0))}}
    one, two = make_plan(study, ["P01"], 0), make_plan(study, ["P02"], 1)
    asked = make_plan(study, ["V01", "V02"], 0, "validation", sets=sets, source="aggregate")
    counts = {"P01": {"": 25}, "P02": {"": 25}}
    held = [session_of("P01", one.hash), session_of("P02", two.hash), session_of("V01", asked.hash, "validation")]
    (sentence,), (nothing,) = departures([one, asked, two], counts, held)
    assert f"from the plans {one.hash}, {two.hash}: 2 participants, 25 answers each" in nothing
    assert sentence.startswith(f"Departs from the plan {asked.hash}. Planned, and without a session here: V02 (1 of 2)")
    held.append(session_of("V02", "", "warm-up, validation"))
    (sentence,), _ = departures([one, asked, two], counts, held)
    assert sentence.endswith("Sessions without a plan: V02 (session 1).")
    held[-1] = session_of("V02", asked.hash, "warm-up, validation")
    departs, said = departures([one, asked, two], counts, held)
    assert departs == () and said[1].endswith("2 participants of the validation; all sessions followed it.")
    (unknown,), _ = departures([one, asked, two], counts)
    assert "is of validation, and the sessions that followed it are unknown" in unknown


def test_another_study_file_than_the_planned_one_departs(tmp_path):
    plan = read_plan(planned(tmp_path))
    counts = {"P01": {"": 25}, "P02": {"": 25}}
    held = [session_of("P01", plan.hash), session_of("P02", plan.hash, study="0" * 16)]
    (sentence,), _ = departures([plan], counts, held, PLANNED)
    assert sentence.endswith(f"study file (planned: {PLANNED}): P02 (session 1, {'0' * 16}).")
    (sentence,), _ = departures([plan], counts, None, "0" * 16)
    assert f"has changed since the plan was made ({'0' * 16}, planned: {PLANNED})" in sentence
    assert departures([plan], counts, None, PLANNED)[0] == ()


def test_a_plan_and_its_copies_and_earlier_versions_count_once(tmp_path):
    plan = read_plan(planned(tmp_path))
    counts = {"P01": {"": 25}, "P03": {"": 25}}
    (sentence,), _ = departures([plan, reissue(plan, "P02", "P03"), plan], counts)
    assert sentence.endswith("Planned, and without answers here: P02 (1 of 3).")


def test_versions_of_the_study_file_are_named_with_their_days():
    held = [
        session_of("P03", "", began=86_400.0 * 3, study="c", differs="selection.trials"),
        session_of("P02", "", began=86_400.0, study="b", differs="session.texts.hello, selection.trials"),
        session_of("P01", "", began=1.0, study="b", differs="session.texts.hello, selection.trials"),
        session_of("P04", "", began=86_400.0 * 4),
        session_of("P05", "", began=None, study="b", differs="session.texts.hello, selection.trials"),
    ]
    first, second = changed_files(held)
    assert "version of the study file, b, which differs in session.texts.hello, selection.trials" in first
    assert "from 1970-01-01 to 1970-01-02" in first
    assert first.endswith("for P01 (session 1), P02 (session 1), P05 (session 1).")
    assert "on 1970-01-04 for P03 (session 1)." in second
    assert changed_files(held[3:4]) == ()


def test_sessions_that_were_held_by_no_plan_or_by_another_are_named(tmp_path):
    path = planned(tmp_path)
    plan, counts = read_plan(path), {"P01": {"": 25}, "P02": {"": 25}}

    def said(*plans):
        sessions = [session_of(name, by) for name, by in zip(counts, plans, strict=False)]
        return departures([read_plan(path)], counts, sessions)

    own = plan.hash
    departs, (nothing,) = said(own, own)
    assert departs == () and nothing.endswith("25 answers each; all sessions followed it.")
    assert "which plan the sessions followed is not known here" in departures([plan], counts)[1][0]
    (sentence,), nothing = said(own, "")
    assert nothing == () and sentence == f"Departs from the plan {own}. Sessions without a plan: P02 (session 1)."
    (sentence,), _ = said("0123", own)
    assert sentence.endswith("Sessions by another plan: P01 (session 1, plan 0123).")
    (sentence,), _ = said(own)
    assert sentence.endswith("lacks the plan of these: P02.")
    twice = reissue(reissue(plan, "P02", "P03"), "P03", "P04")
    path.write_text(plan_text(twice))
    assert twice.replaces[0] == own and len({*twice.replaces, twice.hash}) == 3
    assert not any("plan:" in sentence for sentence in said(*twice.replaces)[0])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--register", "plan.json"], "where the plan is to be"),
        (["--register", "old.md"], "exists already"),
        (["--register", "new.md", "--reissue", "P01=P03"], "--register belongs to a new plan"),
        (["--register", "nowhere/new.md"], "does not exist"),
    ],
)
def test_nothing_is_written_where_the_page_cannot_be(options, words, tmp_path, monkeypatch, capsys):
    study = PAPER.resolve()
    monkeypatch.chdir(tmp_path)
    Path("old.md").write_text("mine")
    code, _, err = run(capsys, monkeypatch, "plan", study, "--participants", 2, *options)
    assert code == 2 and words in err
    assert [path.name for path in tmp_path.iterdir()] == ["old.md"] and Path("old.md").read_text() == "mine"
