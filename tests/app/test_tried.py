"""`hilbo try` without a browser: what it refuses, what is hidden, what the log says, and who gets to know what."""

import socket
import threading
import webbrowser

import numpy as np
import pytest
from commands import run
from live_server import DATA, PATIENCE, refused
from live_stimulus import ByHand
from try_person import Person

from hilbo.app.hub.opening import Wanted, opened
from hilbo.app.rehearsal.robot import Client
from hilbo.app.server import serve
from hilbo.app.server.tried import FIXED, NAMES, Tried, check_study, hidden_reference
from hilbo.cli.tried import study_text
from hilbo.errors import InputError
from hilbo.session.log.event_log import read_log
from hilbo.study.file.reading import StudyFile

OWN = study_text(None, 15)


def study_in(folder, text=OWN) -> StudyFile:
    (folder / "study.toml").write_text(text)
    return StudyFile.load(folder / "study.toml")


def test_what_is_hidden_is_the_seed_s_and_inside_the_ranges(tmp_path):
    study = study_in(tmp_path)
    references = [hidden_reference(study, seed) for seed in range(20)]
    assert references[3] == hidden_reference(study, 3)
    unit = np.array([[p.to_unit(np.array(values[p.name])) for p in study.space.parameters] for values in references])
    assert np.all((unit > 0.19) & (unit < 0.81)) and len(np.unique(unit)) == unit.size
    assert tuple(references[0]) == NAMES


def test_the_shipped_study_is_presented_as_it_says(tmp_path):
    study = study_in(tmp_path)
    check_study(study)
    assert study.stimulus.unblinded and study.selection.trials == 15
    assert f"K0 = {FIXED['K0']} N/mm, T = {1000 * FIXED['T']:.0f} ms" in OWN


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (DATA.read_text(encoding="utf-8"), "has a [renderer]"),
        (OWN.replace("parameters.alpha", "parameters.beta"), "presents K1, B1, alpha"),
        (
            OWN.replace('["different", "similar", "close"]', '["no", "yes"]').replace("[1.0, 3.0]", "[1.0]"),
            "has 2 responses; the page of hilbo try has three",
        ),
        (OWN.replace("[stimulus]", '[stimulus]\nby = "person"'), "leave by and experimenter_sees out"),
        (OWN.replace("[stimulus]", "[stimulus]\nexperimenter_sees = false"), "leave by and experimenter_sees out"),
        (OWN.replace('{show = "a"', '{show = "reference", seconds = 1}, {show = "a"'), "test and reference at once"),
    ],
)
def test_a_study_that_the_page_cannot_present_is_refused(tmp_path, text, words):
    with pytest.raises(InputError) as caught:
        check_study(study_in(tmp_path, text))
    assert words in str(caught.value)


def test_bad_input_is_one_sentence_and_leaves_nothing(tmp_path, capsys, monkeypatch):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        busy = str(taken.getsockname()[1])
        (tmp_path / "out").mkdir()
        (tmp_path / "out" / "mine").write_text("")
        mine, other = tmp_path / "mine.toml", tmp_path / "other.toml"
        mine.write_text(OWN)
        other.write_text(DATA.read_text(encoding="utf-8"))
        for words, *arguments in (
            ("nowhere.toml: cannot be read", tmp_path / "nowhere.toml"),
            (f"--port {busy}: cannot be used", "--no-open", "--port", busy),
            ("exists already", "--no-open", "--out", tmp_path / "out"),
            ("leave the option out", mine, "--trials", 20),
            ("has a [renderer]", other, "--out", tmp_path / "new"),
        ):
            code, out, err = run(capsys, monkeypatch, "try", *arguments)
            assert (code, out, err.count("\n")) == (2, "", 1) and words in err
    monkeypatch.setattr(webbrowser, "get", lambda: (_ for _ in ()).throw(webbrowser.Error("none")))
    code, _, err = run(capsys, monkeypatch, "try")
    assert code == 2 and "no browser was found" in err and "--no-open" in err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.toml", "other.toml", "out"]
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["mine"]


@pytest.fixture
def session(tmp_path):
    """A served session of seed 3, the stimulus and the participant by hand, and its log."""
    study = study_in(tmp_path)
    reference = hidden_reference(study, 3)
    wanted = Wanted(tmp_path / "study.toml", "try-3", seed=3, logs=tmp_path / "logs", reference=reference)
    hub, log = opened(wanted, lambda _: None, lambda _: None)
    hub.gap = 0.0
    place, ready, ends = serve.bound(0), threading.Event(), []
    thread = threading.Thread(
        target=serve.serve, args=(place, hub, lambda stop: (ends.append(stop), ready.set()), Tried(study, reference))
    )
    thread.start()
    assert ready.wait(PATIENCE)
    yield study, reference, place, log
    ends[0]()
    thread.join(PATIENCE)
    log.close()


@pytest.mark.deep
def test_a_whole_session_its_log_and_its_map(session):
    study, reference, place, log = session
    participant, program, person = Client(place.link("participant")), ByHand(place.link("stimulus")), Person(reference)
    with refused(401):
        participant.get("/api/try")
    facts = program.get("/api/try")
    assert facts["reference"] == reference and len(facts["table"]) == 18
    with refused(400, "after the last answer"):
        program.get("/api/try/map")
    begun = False
    while (view := participant.get("/api/participant"))["phase"] != "done":
        begun = begun or (view["may"]["begin"] and bool(participant.post("/api/participant/begin", {})))
        shows = program.order["do"] == "present"
        program.report("presented", values=program.order["values"]) if shows else program.report("neutral")
        if view["questions"] and shows:
            answers = {"class_a": person(program.order["values"])}
            message = {"trial": view["trial"]["id"], "client": "test", "answers": answers}
            participant.post("/api/participant/answer", message)
            program.report("neutral", order=program.order["order"])
    map_ = {}
    while not map_:
        map_ = program.get("/api/try/map")
    assert [len(s["trials"]) for s in map_["slices"]] == [15] * 3
    assert {p["name"]: p["hidden"] for p in map_["parameters"]} == reference
    best = {p["name"]: p["optimum"] for p in map_["parameters"]}
    assert person.distance(best) < 0.5
    header, events, _ = read_log(log.path, study)
    assert header.unblinded == "try" and header.consent is None and header.sets == {"reference": reference}
    assert sum(event.kind == "answer" for event in events) == 15
