"""Two versions of a study file: which of their sessions are read together, and with which one a session is resumed."""

import json

import msgspec
import pytest
from live import RAW, STUDY

from hilbo.errors import InputError
from hilbo.session.choose.logged_session import LoggedSession
from hilbo.session.export.tables import read_sessions, sessions_table, trials_table
from hilbo.session.log.event_log import EventLog, read_log, read_session
from hilbo.session.log.header import header_for
from hilbo.session.log.log_lines import header_line
from hilbo.session.plan.plan import check_plan, make_plan, planned_by, planned_header
from hilbo.study.config import Study
from hilbo.study.file.meaning import MEANING, differing_keys


def changed(**tables):
    """The study of `RAW` with some tables merged with others."""
    return Study.from_dict(RAW | {name: RAW.get(name, {}) | table for name, table in tables.items()})


FREE = {
    "session.texts.hello": changed(session={"texts": {"hello": "Good morning"}}),
    "session.optimisation.steps": changed(session={"optimisation": {"steps": [{"show": "a", "seconds": 3}]}}),
    "selection.trials": changed(selection=RAW["selection"] | {"trials": 7}),
    "gp.noise": changed(gp=RAW["gp"] | {"noise": 0.4}),
    "study.exclude": changed(study={"exclude": "trials < 3"}),
    "aggregation.rule": changed(aggregation={"rule": "average"}),
}
BOUND = {
    "parameters.u.high": changed(parameters={"u": RAW["parameters"]["u"] | {"high": 2.0}}),
    "parameters": Study.from_dict(RAW | {"parameters": dict(reversed(RAW["parameters"].items()))}),
    "study.responses": changed(study={"responses": ["far", "similar", "close"]}),
    "study.attribute": changed(study={"attribute": "softness"}),
    "session.texts.question": changed(session={"texts": {"question": "How soft?"}}),
    "session.labels.close": changed(session={"labels": {"close": "Near"}}),
    "session.definitions.close": changed(session={"definitions": {"close": "The same."}}),
    "constraints": Study.from_dict(RAW | {"constraints": [{"terms": {"u": 1.0, "v": 1.0}, "most": 1.5}]}),
    "stimulus.unblinded": changed(stimulus={"unblinded": True}),
}
LEVELS = {"texture": {"levels": ["silk", "wood"], "correlation": 0.5}}
SAME = {
    "no stimulus": changed(stimulus={}),
    "a longer wait": changed(stimulus={"within": 5.0}),
    "German": changed(session={"language": "de"}),
    "the usual question": changed(session={"texts": {"question": STUDY.file.session.text("question")}}),
    "the usual label": changed(session={"labels": {"close": "Close"}}),
    "a goal": changed(study={"goal": "similar"}),
}


@pytest.mark.parametrize("key", FREE)
def test_what_responses_do_not_depend_on_changes_the_hash_only(key):
    assert FREE[key].file.meaning == STUDY.file.meaning and FREE[key].file.hash != STUDY.file.hash
    assert STUDY.file.changes(FREE[key].file) == [key]


@pytest.mark.parametrize("key", BOUND)
def test_what_responses_depend_on_changes_both(key):
    assert BOUND[key].file.meaning != STUDY.file.meaning and BOUND[key].file.hash != STUDY.file.hash
    words = [key] if key != "parameters" else ["order of the parameters", "parameters"]
    assert STUDY.file.changes(BOUND[key].file) == [key]
    assert set(STUDY.file.changes_of_meaning(BOUND[key].file)) <= set(words)
    assert STUDY.file.changes_of_meaning(BOUND[key].file) and any(f"{key}.".startswith(f"{k}.") for k in MEANING)


@pytest.mark.parametrize("words", SAME)
def test_what_is_asked_all_the_same_has_the_same_meaning(words):
    assert SAME[words].file.meaning == STUDY.file.meaning and STUDY.file.changes_of_meaning(SAME[words].file) == []


def test_a_correlation_of_levels_is_a_hyperparameter():
    one, other = (
        Study.from_dict(RAW | {"parameters": {"texture": LEVELS["texture"] | {"correlation": c}}}).file
        for c in (0.5, 0.6)
    )
    assert one.meaning == other.meaning and one.hash != other.hash


def test_materials_are_compared_one_by_one(tmp_path):
    def of(**materials):
        return Study.from_dict(RAW | {"materials": materials})

    one = of(foam={"parameters": {"u": {"high": 2}}}, session={})
    head = header_for(one.file, "P01", seed=3, materials=["foam"], warm=False)
    with LoggedSession.open(tmp_path, one, head) as session:
        session.ask()
    path = session.log.path
    for other in (
        of(foam={"parameters": {"u": {"high": 2.0}}}, session={}),
        of(foam={"parameters": {"u": {"high": 2}}}, session={"parameters": {"v": {"high": 3}}}, stone={}),
        of(foam={"parameters": {"u": {"high": 2}}, "session": {"validation": {"count": 2}}}, session={}),
    ):
        assert read_session(path, other.file).study == one.file
    with pytest.raises(InputError, match=r"they differ in parameters\.u\.high, which"):
        read_session(path, of(foam={"parameters": {"u": {"high": 3}}}, session={}).file)
    with pytest.raises(InputError, match=r"materials\.foam is not in the study"):
        read_session(path, of(session={}).file)
    named = of(foam={}, session={})
    plan = make_plan(named.file, ["P01", "P02"], 0)
    check_plan(plan, of(foam={"session": {"validation": {"count": 2}}}, session={}, stone={}).file)
    with pytest.raises(InputError, match="renderer or stimulus of session differ"):
        check_plan(plan, of(foam={}, session={"parameters": {"v": {"high": 3}}}).file)


def test_a_study_file_is_the_same_after_it_was_stored():
    for study in (*FREE.values(), *BOUND.values()):
        again = STUDY.file.stored(json.loads(json.dumps(study.file.tables)))
        assert (again.content, again.hash, again.meaning) == (study.file.content, study.file.hash, study.file.meaning)


def test_the_order_of_texts_is_no_difference_of_meaning():
    texts = {"question": "?", "hello": "!"}
    one, other = (changed(session={"texts": dict(items)}).file for items in (texts.items(), reversed(texts.items())))
    assert one.meaning == other.meaning and one.hash != other.hash
    assert differing_keys(one.tables, other.tables) == ["session.texts"]


def answered(folder, study, participant="P01", count=3):
    """Path of a new log with `count` responses in an optimisation by this study."""
    with LoggedSession.open(folder, study, header_for(study.file, participant, seed=3, warm=False)) as session:
        for number in range(count):
            session.ask()
            session.tell(study.responses[number % 3])
    return session.log.path


@pytest.mark.parametrize("key", ["selection.trials", "gp.noise", "session.optimisation.steps"])
def test_a_resumed_session_goes_on_with_its_own_study_file(tmp_path, key):
    answered(tmp_path, STUDY)
    now = FREE[key]
    with LoggedSession.open(tmp_path, STUDY, header_for(STUDY.file, "P01", seed=3, warm=False)) as session:
        expected, counted = session.ask(), len(session.log.before)
    log = session.log.path
    log.write_bytes(b"".join(log.read_bytes().splitlines(keepends=True)[: counted + 1]))  # without the proposal
    with LoggedSession.open(tmp_path, now, header_for(now.file, "P01", seed=3, warm=False)) as session:
        assert session.state.study == STUDY.file and session.ask() == expected
    for head in (
        header_for(now.file, "P01", seed=4, warm=False),
        header_for(now.file, "P01", seed=3, warm=False, dry_run=True),
        header_for(now.file, "P01", seed=3, warm=False, unblinded="try"),
        header_for(now.file, "P01", seed=3, warm=False, plan="0" * 16),
    ):
        with pytest.raises(InputError, match="begun with another seed"):
            LoggedSession.open(tmp_path, now, head)


@pytest.mark.parametrize("key", BOUND)
def test_a_log_whose_responses_mean_something_else_is_refused_with_the_keys(tmp_path, key):
    path = answered(tmp_path, STUDY, count=1)
    for read in (read_session, read_log, EventLog.resume):
        with pytest.raises(InputError, match=rf"another study .* they differ in .*{key}.*, which responses depend on"):
            read(path, BOUND[key].file)


def test_sessions_by_two_versions_are_read_together_and_the_table_says_in_what_they_differ(tmp_path):
    now = FREE["selection.trials"].file
    answered(tmp_path, STUDY, "P01")
    answered(tmp_path, FREE["selection.trials"], "P02", 7)
    said: list[str] = []
    sessions = read_sessions(tmp_path, now, said.append)
    assert [sentence.partition(": ")[2] for sentence in said] == [
        "1 session was begun with another version of the study file, which differs in selection.trials."
    ]
    assert trials_table(sessions).groupby("participant").size().to_dict() == {"P01": 3, "P02": 7}
    table = sessions_table(sessions, now).set_index("participant")
    assert table["differs_in"].to_dict() == {"P01": "selection.trials", "P02": ""}
    assert table["study"].to_dict() == {"P01": STUDY.file.hash, "P02": now.hash}


@pytest.mark.parametrize(
    ("tables", "sentence"),
    [({}, "has no complete study file"), (FREE["gp.noise"].file.tables, "does not fit its hash")],
)
def test_a_log_whose_study_file_was_changed_is_refused(tmp_path, tables, sentence):
    path = answered(tmp_path, STUDY, count=0)
    forged = msgspec.structs.replace(read_log(path)[0], study_tables=tables)
    path.write_bytes(header_line(forged))
    assert read_session(path, STUDY.file).study == STUDY.file  # today's file has the same hash
    with pytest.raises(InputError, match=sentence):
        read_session(path, FREE["selection.trials"].file)


def test_a_plan_serves_a_study_file_that_has_changed_in_what_responses_do_not_depend_on(tmp_path):
    plan, now = make_plan(STUDY.file, ["P01", "P02"], 5), FREE["selection.trials"].file
    header = planned_header(plan, now, "P01")
    assert (header.study, header.plan, header.blocks[-1].count) == (now.hash, plan.hash, 6)  # the plan's, not 7
    fewer = changed(selection=RAW["selection"] | {"trials": 3})
    with pytest.raises(InputError, match=r"has 6 trials that are chosen, as in the plan, and the study file has .* 3"):
        LoggedSession.open(tmp_path, fewer, planned_header(plan, fewer.file, "P01"))
    assert not list(tmp_path.iterdir())
    begun = planned_header(plan, STUDY.file, "P01", session="1")
    assert planned_by(plan, header, begun) and not planned_by(plan, planned_header(plan, now, "P02"), begun)
    with pytest.raises(InputError, match="belongs to another study"):
        check_plan(plan, BOUND["parameters.u.high"].file)


def test_the_meaning_of_the_papers_study_stays():
    """Plans and results hold it: another way to compute it would refuse them."""
    assert Study.load("hilbo/data/paper.toml").file.meaning == "90d8924ba333f426"
