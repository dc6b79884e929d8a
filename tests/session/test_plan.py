"""Plans: whole studies in advance, the same from the same seed, refused when changed or of another study."""

import hashlib
import json
from collections import Counter

import msgspec
import numpy as np
import pandas as pd
import pytest
from live import RAW, STUDY

from hilbo import Study
from hilbo.app.pages.session_views import participant_view
from hilbo.errors import InputError
from hilbo.session.choose.look_ahead import LiveChooser
from hilbo.session.log import actions as live
from hilbo.session.log.header import header_for, material_seed, warm_up
from hilbo.session.log.records import Trial
from hilbo.session.log.state import LiveSession
from hilbo.session.plan.counterbalance import assigned
from hilbo.session.plan.plan import make_plan, planned_header, reissue
from hilbo.session.plan.validation_sets import aggregate_best_sets, check_participants, validation_sets
from hilbo.study.cohort import cohort_of
from hilbo.study.file.plan_file import Block, plan_text, read_plan
from hilbo.study.file.protocols import protocol
from hilbo.study.results.result_json import FoundOptimum, FoundPerson, Result, read_result

PEOPLE = [f"P{i:02d}" for i in range(1, 9)]
SETS = {name: {"u": 0.1 + 0.3 * i, "v": 0.9 - 0.2 * i} for i, name in enumerate(("best", "mid", "worst"))}
OTHER = Study.from_dict(RAW | {"study": RAW["study"] | {"attribute": "softness"}})
MATERIALS = Study.from_dict(RAW | {"materials": {"foam": {}, "soft": {}, "hard": {}}})


def written(folder, content):
    """A plan that is read back, with the hash of this content."""
    rest = {key: value for key, value in content.items() if key != "hash"}
    text = json.dumps(rest, sort_keys=True, ensure_ascii=False, separators=(",", ":"))
    whole = rest | {"hash": hashlib.sha256(text.encode()).hexdigest()[:16]}
    (folder / "plan.json").write_text(json.dumps(whole))
    return read_plan(folder / "plan.json")


def test_a_plan_is_reproduced_from_its_seed_and_survives_json(tmp_path):
    plan = make_plan(STUDY.file, PEOPLE, 3)
    assert plan == make_plan(STUDY.file, PEOPLE, 3) != make_plan(STUDY.file, PEOPLE, 4)
    again = written(tmp_path, json.loads(plan_text(plan)))
    assert again == plan
    header = planned_header(again, STUDY.file, "P03")
    assert header.plan == plan.hash and header.participant == "P03"
    assert [block.phase for block in header.blocks] == ["warm-up", "optimisation"]
    seeds = [row.header.seed for row in plan.participants]
    assert len(set(seeds)) == len(seeds)


def test_a_changed_plan_another_study_and_strangers_are_refused(tmp_path):
    plan = make_plan(STUDY.file, PEOPLE, 3)
    changed = json.loads(plan_text(plan))
    changed["participants"][0]["header"]["seed"] += 1
    (tmp_path / "plan.json").write_text(json.dumps(changed))
    with pytest.raises(InputError, match="was changed after it was made"):
        read_plan(tmp_path / "plan.json")
    twice = json.loads(plan_text(plan))
    twice["participants"][1] = twice["participants"][0]
    with pytest.raises(InputError, match="names a participant twice"):
        written(tmp_path, twice)
    with pytest.raises(InputError, match="belongs to another study"):
        planned_header(plan, OTHER.file, "P01")
    with pytest.raises(InputError, match='participant "P99" is not in the plan'):
        planned_header(plan, STUDY.file, "P99")
    for content in ({}, json.loads(plan_text(plan)) | {"notes": ""}):
        with pytest.raises(InputError, match="is no plan"):
            written(tmp_path, content)
    with pytest.raises(InputError, match="each once"):
        make_plan(STUDY.file, ["P01", "P01"])
    for label in ("x" * 65, "a\nb", ""):
        with pytest.raises(InputError, match="label"):
            make_plan(STUDY.file, ["P01"], session=label)
    assert planned_header(make_plan(STUDY.file, ["P01"], session="x" * 64), STUDY.file, "P01").session == "x" * 64


def test_three_materials_come_in_all_orders():
    plan = make_plan(MATERIALS.file, [f"P{i}" for i in range(12)], 0)
    assert plan.complete and plan.complete_at == "multiples of 6 participants"
    seen = Counter(
        tuple(block.material for block in row.header.blocks if block.phase == "optimisation")
        for row in plan.participants
    )
    assert len(seen) == 6 and set(seen.values()) == {2}
    assert not make_plan(MATERIALS.file, [f"P{i}" for i in range(8)], 0).complete


def test_validation_shows_each_pair_four_times_and_each_set_eight():
    plan = make_plan(STUDY.file, PEOPLE, 0, "validation", sets={"": SETS}, source="aggregate")
    for person in PEOPLE:
        header = planned_header(plan, STUDY.file, person)
        trials = header.blocks[1].trials
        assert len(trials) == header.blocks[1].count == 12
        assert Counter(name for t in trials for name in (t.a, t.b)) == dict.fromkeys(SETS, 8)
        assert set(Counter(frozenset((t.a, t.b)) for t in trials).values()) == {4}
        assert Counter(t.first for t in trials) == {"a": 6, "b": 6}
    orders = {planned_header(plan, STUDY.file, person).blocks[1].trials for person in PEOPLE}
    assert len(orders) > 1
    with pytest.raises(InputError, match="give --from"):
        make_plan(STUDY.file, PEOPLE, 0, "validation")
    with pytest.raises(InputError, match="no individual map"):
        make_plan(STUDY.file, PEOPLE, 0, "validation", sets={"": SETS}, source="individual")


def test_individual_sets_are_shown_to_their_owner_only():
    sets = {f"{person} {name}": values for person in PEOPLE for name, values in SETS.items()}
    plan = make_plan(STUDY.file, PEOPLE, 0, "validation", sets={"": sets}, source="individual")
    header = planned_header(plan, STUDY.file, "P02")
    own = [name.split(" ") for name in header.sets if not name.startswith("warm-up")]
    assert sorted(role for _, role in own) == sorted(SETS) and len({code for code, _ in own}) == 1
    assert not any("P02" in name for name in header.sets)
    with pytest.raises(InputError, match="other participants cannot be validated"):
        reissue(plan, "P02", "P30")


def test_aggregate_best_of_three_materials_rests_between_them():
    own = {"aggregate": SETS["best"]} | {f"individual:P{i}": {"u": 0.01 * i, "v": 0.5} for i in range(24)}
    plan = make_plan(MATERIALS.file, PEOPLE[:6], 0, "aggregate-best", sets=dict.fromkeys(MATERIALS.file.materials, own))
    header = planned_header(plan, MATERIALS.file, "P01")
    assert [block.phase for block in header.blocks] == ["warm-up", *["aggregate-best"] * 3]
    assert [block.rest for block in header.blocks] == [0, 0, 600, 600]
    assert {block.count for block in header.blocks[1:]} == {48}
    names = {name for trial in header.blocks[2].trials for name in (trial.a, trial.b)}
    assert names <= set(header.sets) and len(names) == 25


def test_a_plan_calls_nobodys_sets_by_their_id():
    own = {f"individual:P{i:02d}": {"u": 0.04 * i, "v": 0.5} for i in range(1, 25)}
    sets = {"": {"aggregate": SETS["best"]} | own}
    plan = make_plan(STUDY.file, ["J01", "J02"], 0, "aggregate-best", sets=sets)
    assert plan == make_plan(STUDY.file, ["J01", "J02"], 0, "aggregate-best", sets=sets)
    header = planned_header(plan, STUDY.file, "J01")
    named = [name for name in header.sets if name.startswith("individual:")]
    assert len(named) == 24 and not any(person in plan_text(plan) for person in own)
    order = [header.sets[name]["u"] for name in named]
    assert order != sorted(order)  # nor does their order say whose they are
    assert {tuple(header.sets[name].items()) for name in named} == {tuple(values.items()) for values in own.values()}


ROW = ("participants", 0, "header")
FORGED_PLANS = {
    "another participant's session": ((*ROW, "participant"), "P02"),
    "a participant who is a path": (("participants", 0, "participant"), "../P01"),
    "no blocks": ((*ROW, "blocks"), []),
    "a block that is none": ((*ROW, "blocks", 0), 7),
    "a set out of range": ((*ROW, "sets", "best", "u"), 1e308),
    "a set below its range": ((*ROW, "sets", "best", "u"), -3.0),
    "a set that is no number": ((*ROW, "sets", "best", "u"), None),
    "no sets": ((*ROW, "sets"), {}),
    "a seed that is none": ((*ROW, "seed"), -1),
    "nobody": (("participants",), []),
    "participants that are none": (("participants",), 7),
    "a source that is none": (("source",), "hearsay"),
}


@pytest.mark.parametrize("words", FORGED_PLANS)
def test_a_plan_whose_hash_fits_and_says_what_cannot_be_is_refused(words, tmp_path):
    plan = json.loads(plan_text(make_plan(STUDY.file, PEOPLE, 0, "validation", sets={"": SETS}, source="aggregate")))
    (*way, last), value = FORGED_PLANS[words]
    place = plan
    for key in way:
        place = place[key]
    place[last] = value
    with pytest.raises(InputError):
        planned_header(written(tmp_path, plan), STUDY.file, "P01")


def test_a_row_is_reissued_with_its_order_and_seed():
    plan = make_plan(MATERIALS.file, PEOPLE, 0)
    changed = reissue(plan, "P03", "P30")
    old, new = (planned_header(changed, MATERIALS.file, person) for person in ("P03", "P30"))
    assert new == msgspec.structs.replace(old, participant="P30") and changed.hash != plan.hash
    assert changed.replaces == (plan.hash,)
    with pytest.raises(InputError, match="must be in the plan"):
        reissue(plan, "P99", "P30")


GROUPS = {"materials": {"foam": {}, "soft": {}, "hard": {}}, "plan": {"people": {"foam": 6, "soft": 2, "hard": 2}}}
GROUPED = Study.from_dict(RAW | GROUPS)


def materials_of(plan):
    return [[block.material for block in row.header.blocks if block.phase != "warm-up"] for row in plan.participants]


def test_each_participant_is_assigned_to_one_material_at_random_in_the_planned_numbers():
    people = [f"P{i:02d}" for i in range(10)]
    plans = [make_plan(GROUPED.file, people, seed) for seed in range(3)]
    for plan in plans:
        rows = materials_of(plan)
        assert all(len(row) == 1 for row in rows)
        for half in (rows[:5], rows[5:]):  # blocks of five, as the numbers' ratio is 3 : 1 : 1
            assert sorted(row[0] for row in half) == ["foam", "foam", "foam", "hard", "soft"]
        assert plan.complete and plan.materials == ("foam", "soft", "hard")
    groups = GROUPS["plan"]["people"]
    drawn = [tuple(assigned(groups, seed)) for seed in range(300)]
    assert materials_of(plans[2]) == [[name] for name in drawn[2]] and len(set(drawn)) > 100
    firsts = [names[0] for names in drawn]
    assert abs(firsts.count("foam") / 300 - 0.6) < 4 * (0.6 * 0.4 / 300) ** 0.5
    assert plans[2] == make_plan(GROUPED.file, people, 2)
    with pytest.raises(InputError, match=r"there are 9 participants, and \[plan\] people of the study file has 10"):
        make_plan(GROUPED.file, people[:9], 0)
    assert materials_of(make_plan(GROUPED.file, ["P99"], 0, materials=["soft"])) == [["soft"]]


@pytest.mark.parametrize(
    ("people", "sentence"),
    [
        (
            {"foam": 6, "stone": 1},
            r"plan\.people\.stone is of no material of the study, its materials: foam, soft, hard",
        ),
        ({"foam": 0}, r"plan\.people is .* must be a table of materials and numbers of participants"),
        ({"foam": 1.5}, r"plan\.people is .* must be a table of materials and numbers of participants"),
    ],
)
def test_wrong_numbers_of_people_are_refused(people, sentence):
    with pytest.raises(InputError, match=sentence):
        Study.from_dict(RAW | GROUPS | {"plan": {"people": people}})


def test_materials_have_protocols_of_their_own():
    tables = GROUPS | {
        "materials": {
            "foam": {"session": {"aggregate_best": {"count": 1}}},
            "soft": {"session": {"aggregate_best": {"count": 3, "rest": 300.0}}},
            "hard": {"session": {"validation": {"steps": [{"show": s, "seconds": 2} for s in ("a", "neutral", "b")]}}},
        }
    }
    study = Study.from_dict(RAW | tables)
    assert study.file.meaning == GROUPED.file.meaning and study.file.hash != GROUPED.file.hash
    own = {"aggregate": SETS["best"], "individual:P01": SETS["mid"], "individual:P02": SETS["worst"]}
    plan = make_plan(study.file, ["A1"], 0, "aggregate-best", sets=dict.fromkeys(study.file.materials, own))
    blocks = {block.material: block for block in plan.participants[0].header.blocks[1:]}
    assert {name: block.count for name, block in blocks.items()} == {"foam": 2, "soft": 6, "hard": 4}
    assert {block.rest for block in plan.participants[0].header.blocks[2:]} <= {300.0, 600.0}
    named = dict.fromkeys(study.file.materials, SETS)
    plan = make_plan(study.file, ["V1"], 0, "validation", sets=named, source="aggregate")
    state = LiveSession.start(study.file, planned_header(plan, study.file, "V1"))
    for number, block in enumerate(state.header.blocks[1:], 1):
        trial = Trial(1, number, 1, {}, 0.0)
        assert sum(seconds for _, seconds in state.steps_of(trial)) == (6 if block.material == "hard" else 13)
    with pytest.raises(InputError, match=r"materials\.foam\.session\.texts is not a key"):
        Study.from_dict(RAW | {"materials": {"foam": {"session": {"texts": {"hello": "?"}}}}})
    with pytest.raises(InputError, match=r'materials\.foam\.session\.validation\.steps .* must show "a" and "b"'):
        Study.from_dict(
            RAW | {"materials": {"foam": {"session": {"validation": {"steps": [{"show": "a", "seconds": 1}]}}}}}
        )


def test_people_are_validated_with_the_materials_of_which_they_have_a_map():
    def own(*people):
        return {f"{person} {role}": SETS[role] for person in people for role in ("best", "mid", "worst")}

    sets = {"foam": own("P01", "P03"), "soft": own("P02", "P03"), "hard": {}}
    plan = make_plan(GROUPED.file, ["P01", "P02", "P03"], 0, "validation", sets=sets, source="individual")
    assert [sorted(row) for row in materials_of(plan)] == [["foam"], ["soft"], ["foam", "soft"]]
    with pytest.raises(InputError, match="P04 has no individual map"):
        make_plan(GROUPED.file, ["P04"], 0, "validation", sets=sets, source="individual")


def choosing(label, *materials, **changes):
    """Material -> the seed of what a session of the seed 7 chooses with it."""
    head = header_for(STUDY.file, "P01", label, 7, warm=False)
    blocks = tuple(Block("optimisation", 2, material=name) for name in materials)
    head = msgspec.structs.replace(head, blocks=blocks, **changes)
    return {name: material_seed(head, name) for name in materials}


def test_nobody_meets_the_points_of_an_earlier_session_or_of_another_material():
    labels, materials = ("1", "2", "red", "1.0"), (None, "red", "blue")
    seeds = [choosing(label, material)[material] for label in labels for material in materials]
    assert len(set(seeds)) == len(seeds) and choosing("1", None) == {None: 7}
    assert choosing("2", "red", "blue") == choosing("2", "blue", "red") == choosing("2", "red") | choosing("2", "blue")
    plan = make_plan(STUDY.file, ["P01"])
    assert planned_header(plan, STUDY.file, "P01").schema == header_for(STUDY.file, "P01", warm=False).schema == 3


def test_warm_up_renderings_are_feasible_spread_and_seeded():
    study = Study.load("hilbo/data/paper.toml")
    block, sets = warm_up(study.file, 5)
    assert (
        block.count == 12 and len(block.trials) == 24 and warm_up(study.file, 5)[1] == sets != warm_up(study.file, 6)[1]
    )
    physical = np.array([list(values.values()) for values in sets.values()])
    unit = np.asarray(study.space.to_unit(physical))
    assert bool(np.all(study.space.feasible(unit)))
    apart = np.linalg.norm(unit[:12, None] - unit[None, :12], axis=2) + 9 * np.eye(12)
    assert apart.min() > 0.03


def test_a_warm_up_keeps_the_constraints():
    bound = {"terms": {"u": 1.0, "v": 1.0}, "most": 0.8}
    study = Study.from_dict(RAW | {"constraints": [bound]})
    for seed in range(4):
        sets = warm_up(study.file, seed)[1]
        assert sets and all(values["u"] + values["v"] <= 0.8 for values in sets.values())


def test_a_planned_validation_session_runs_blind():
    head = planned_header(
        make_plan(STUDY.file, PEOPLE, 0, "validation", sets={"": SETS}, source="aggregate"), STUDY.file, "P01"
    )
    state = LiveSession.start(STUDY.file, head)
    chooser, seen = LiveChooser(state), []
    while state.screen != "done":
        if state.screen == "ready":
            state = state.after(live.go_on(state, 0.0))
            continue
        state = state.after(live.propose(state, chooser, 0.0))
        seen.append(json.dumps(participant_view(state)))
        asks = protocol(STUDY.file.session, state.header.blocks[state.pending.block].phase).asks
        values = {ask: "a" if ask == "preferred" else "close" for ask in asks}
        state = state.after(live.answer(state, state.pending.id, "c", values, 1.0, felt=False))
    assert len(seen) == 24 and chooser.fits == 0
    for secret in ("best", "mid", "worst", "warm-up 1", "0.1", "0.9", "margin", "mean", "sets"):
        assert not any(f'"{secret}' in text for text in seen), secret


def result():
    people = [{"participant": f"P0{i}", "optimum": {"parameters": SETS["mid"]}} for i in (1, 2)]
    hashes = {"study": STUDY.file.hash, "meaning": STUDY.file.meaning, "goal": "close"}
    return {**hashes, "seed": 0, "optimum": {"parameters": SETS["best"]}, "participants": people}


def test_results_are_checked(tmp_path):
    path = tmp_path / "result.json"
    path.write_text(json.dumps(result()))
    aggregate_result = read_result(path, STUDY)
    assert aggregate_result == msgspec.convert(result(), Result)
    assert set(aggregate_best_sets(STUDY, aggregate_result)) == {"aggregate", "individual:P01", "individual:P02"}
    with pytest.raises(InputError, match="result of another study"):
        read_result(path, OTHER)
    with pytest.raises(InputError, match=r'is the optimum of "close", and the study\'s goal is "similar"'):
        read_result(path, Study.from_dict(RAW | {"study": RAW["study"] | {"goal": "similar"}}))
    path.write_text("{}")
    with pytest.raises(InputError, match=r"is no result\.json"):
        read_result(path, STUDY)
    check_participants([aggregate_result], ["V01"], "aggregate")
    check_participants([aggregate_result], ["P01"], "individual")
    with pytest.raises(InputError, match="invite people who are not"):
        check_participants([aggregate_result], ["V01", "P02"], "aggregate")
    with pytest.raises(InputError, match="no individual map"):
        check_participants([aggregate_result], ["V01"], "individual")


def test_a_study_changes_protocols_and_texts():
    raw = RAW | {
        "session": {
            "texts": {"question": "Wie ähnlich?"},
            "labels": {"close": "Nah"},
            "optimisation": {"steps": [{"show": "a", "seconds": 3}]},
            "aggregate_best": {"count": 3, "rest": 60},
        }
    }
    study = Study.from_dict(raw)
    assert study.file.hash != STUDY.file.hash and study.file.session.text("question") == "Wie ähnlich?"
    assert (
        protocol(study.file.session, "optimisation").seconds == 3
        and protocol(study.file.session, "aggregate-best").count == 3
    )
    assert study.file.session.label("close") == "Nah" and study.file.session.label("similar") == "Similar"
    assert "highly close" in study.file.session.definition("close")
    paper = protocol(STUDY.file.session, "validation")
    assert sum(step.seconds for step in paper.steps if step.show != "neutral") == 12
    assert protocol(STUDY.file.session, "optimisation").seconds == 8


@pytest.mark.parametrize(
    ("session", "sentence"),
    [
        ({"texts": {"quesiton": "?"}}, r"session\.texts\.quesiton is no text of a session"),
        ({"labels": {"near": "?"}}, r"session\.labels\.near is no text of a session, those are different"),
        ({"colour": "red"}, r"session\.colour is not a key of a study file"),
        ({"validation": {"steps": [{"show": "a", "seconds": 1}]}}, r'must show "a" and "b"'),
        (
            {"validation": {"steps": [{"show": "a", "seconds": 1}, {"show": "b", "seconds": 1}]}},
            r'must have "neutral" or "reference" between',
        ),
        ({"optimisation": {"steps": [{"show": "a", "seconds": 0}]}}, r"session\.optimisation\.steps is .* must be"),
        ({"optimisation": {"steps": [{"show": "a", "second": 1}]}}, r"session\.optimisation\.steps is .* must be"),
        ({"warm_up": {"count": 0}}, r"session\.warm_up\.count is 0; it must be a whole number from 1"),
    ],
)
def test_a_wrong_session_table_is_one_sentence(session, sentence):
    with pytest.raises(InputError, match=sentence):
        Study.from_dict(RAW | {"session": session})


def test_people_planned_in_two_batches_share_no_seed():
    one, other = (make_plan(STUDY.file, people, seed=3).participants for people in (["A1", "A2"], ["B1", "B2"]))
    assert len({row.header.seed for row in [*one, *other]}) == 4
    longer = make_plan(STUDY.file, ["A1", "A2", "A3"], seed=3).participants
    assert [row.header.seed for row in longer[:2]] == [row.header.seed for row in one]


def test_ids_that_differ_in_capitals_only_are_refused():
    with pytest.raises(InputError, match='participants "P01" and "p01" differ in capitals only'):
        make_plan(STUDY.file, ["P01", "P02", "p01"])


def test_a_result_by_another_rule_is_told_apart_from_other_trials():
    result = Result(
        STUDY.file.hash, STUDY.file.meaning, "close", FoundOptimum({}), (FoundPerson("P01"),), rule="average"
    )
    answers = pd.DataFrame({"participant": "P01", "trial": [1], "response": "close", "u": 0.5, "v": 0.5})
    cohort = cohort_of(answers, STUDY)
    with pytest.raises(InputError, match=r'is by the rule "average", and the study\'s is "bcm"'):
        validation_sets(STUDY, result, cohort, "aggregate", ["P01"])
