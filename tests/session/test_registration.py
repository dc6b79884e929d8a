"""The page for a pre-registration: what files fix stands there, and what they do not is left to its author."""

from pathlib import Path

import pytest
from commands import run

from hilbo.population.rules.registry import RECIPES, RULES
from hilbo.report.registration import registration
from hilbo.session.plan.plan import make_plan, reissue
from hilbo.study.departures import Held, departures
from hilbo.study.estimate.optimum import _LOSS
from hilbo.study.file.plan_file import plan_text, read_plan
from hilbo.study.file.reading import StudyFile
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
        "Nothing is presented but what keeps -3 <= gain - 2.5 grains <= 24.",
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
    assert "`trials < 10` holds are left out" in text
    assert "Trials with these device flags are excluded: input held (`[study] exclude_flags`)." in text
    assert "probability of the highest answer)" in text


@pytest.mark.parametrize("rule", ["bcm", *RECIPES])
def test_the_primary_result_is_the_optimum_of_the_study_s_rule(page, rule):
    text = page(TEXT.replace('rule = "bcm"', f'rule = "{rule}"'))
    (primary,) = (line for line in text.splitlines() if line.startswith("* Primary result"))
    assert ("maximum of the population map" in primary) == (rule == "bcm")
    centred = RULES[rule].centred
    assert (
        f"most often near, of those to which a new person gives the highest answer at most {_LOSS}" in primary
    ) == centred


def planned(tmp_path, text="", **others):
    study = StudyFile.load(PAPER)
    path = tmp_path / "plan.json"
    path.write_text(text or plan_text(make_plan(study, ["P01", "P02"], 0, **others)))
    return path, study.hash


def test_departures_from_a_plan(tmp_path):
    path, study = planned(tmp_path)
    departs, (nothing,) = departures(read_plan(path), study, 25, {"P01": [25], "P02": [25]})
    assert departs == ()
    assert nothing.startswith("Nothing departs from the plan") and "2 participants, 25 answers each" in nothing
    sentences, nothing = departures(read_plan(path), "0" * 16, 25, {"P01": [12, 25], "P09": [25]})
    assert nothing == () and all(sentence.startswith("Departs from the plan") for sentence in sentences)
    text = " ".join(sentences)
    for part in ("planned with (0000", "without answers here: P02 (1 of 2)", "Not in the plan", "P09.", "P01 (12, 25)"):
        assert part in text
    assert "P09 (25)" not in text


def test_sessions_that_were_held_by_no_plan_or_by_another_are_named(tmp_path):
    path, study = planned(tmp_path)
    plan, counts = read_plan(path), {"P01": [25], "P02": [25]}

    def said(*plans):
        sessions = [Held(name, "1", by) for name, by in zip(counts, plans, strict=False)]
        return departures(read_plan(path), study, 25, counts, sessions)

    own = plan.hash
    departs, (nothing,) = said(own, own)
    assert departs == () and nothing.endswith("25 answers each; their sessions were held by it.")
    assert "by which plan they were held is not said here" in departures(plan, study, 25, counts)[1][0]
    (sentence,), nothing = said(own, "")
    assert nothing == () and sentence == f"Departs from the plan {own}. Held by no plan: P02 (session 1)."
    (sentence,), _ = said("0123", own)
    assert sentence.endswith("Held by another plan: P01 (session 1, plan 0123).")
    (sentence,), _ = said(own)
    assert sentence.endswith("does not say by which plan these were held: P02.")
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
