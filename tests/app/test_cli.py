"""`hilbo session` refuses in one sentence, before anything is begun; `hilbo doctor` says what to fix."""

import contextlib
import hashlib
import json
import socket
import tomllib

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from commands import run
from live_server import DATA, study_of
from msgspec import structs

from hilbo.app.hub.opening import Wanted, opened
from hilbo.app.rehearsal.rehearsal import example_sets, fast_study, rehearse
from hilbo.app.server import serve
from hilbo.cli import doctor
from hilbo.cli.main import app
from hilbo.device.local.simulator import Simulator
from hilbo.errors import InputError
from hilbo.hardware_bridge import Renderer
from hilbo.session.choose.warm_start import read_warm_start
from hilbo.session.log import actions
from hilbo.session.log.event_log import read_log
from hilbo.session.log.header import header_for
from hilbo.session.log.log_files import log_paths
from hilbo.session.plan.participants import add_person
from hilbo.session.plan.plan import make_plan, planned_part, reissue
from hilbo.session.withdrawal.withdrawal import delete_participant
from hilbo.simulation.presets import preset_of
from hilbo.study.config import Study
from hilbo.study.file.plan_file import hashed, plan_text, read_plan
from hilbo.study.file.protocols import protocol
from hilbo.study.template import NewStudy, parameter_of, study_text

PERSON = {"participant": "P01", "consent_time": "2026-03-02T10:00", "protocol_number": "7", "age": "", "handedness": ""}


def command(*arguments):
    """A command of hilbo, in this process."""
    return app([str(a) for a in arguments], standalone_mode=False)


def refused(*arguments):
    """The sentence with which it is refused."""
    with pytest.raises(InputError) as caught:
        command("session", *arguments)
    return str(caught.value)


def test_bad_input_is_one_sentence_and_begins_nothing(tmp_path, monkeypatch):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "of the tests")  # commands would choose the user's
    logs = tmp_path / "logs"
    place = ("--logs", logs, "--port", 0, "--participant", "P01")
    device = ("--device", tmp_path / "none")
    words = refused(DATA.parent / "video_quality.toml", *place, "--dry-run", *device)
    assert "a program or a person presents, and no device is used; leave --device out" in words
    with pytest.raises(InputError, match="cannot be read"):
        rehearse(tmp_path / "none.toml", tmp_path / "rehearsal")
    assert not (tmp_path / "rehearsal").exists()
    assert "cannot be read" in refused(tmp_path / "none.toml", *place)
    assert "participants.csv: cannot be read" in refused(DATA, *place)
    assert "an id has" in refused(DATA, "--logs", logs, "--port", 0, "--participant", "Jane Doe")
    assert "no such session was begun" in refused(DATA, *place, "--resume")
    for label in ("x" * 300, "a\nb", ""):
        assert "it must have 1 to 64 characters" in refused(DATA, *place, "--dry-run", "--session", label)
    (tmp_path / "plan.json").write_text("{}")
    assert "is no plan" in refused(DATA, *place, "--plan", tmp_path / "plan.json", "--dry-run")
    add_person(logs / "participants.csv", PERSON | {"participant": "P02"})
    assert '"P01" is not in the list' in refused(DATA, *place)
    assert "is no map" in refused(DATA, *place, "--dry-run", "--warm-start", tmp_path / "none.nc")
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        assert "choose another --port" in refused(DATA, *place[:2], "--port", other.getsockname()[1], *place[4:])
    assert list(logs.glob("*.jsonl")) == []


@pytest.mark.parametrize("phase", ["optimisation", "validation"])
def test_a_rehearsal_asks_for_a_session_that_can_begin(tmp_path, monkeypatch, phase):
    """Which session it is comes from the plan alone, or from a seed and a material."""
    text = study_text(NewStudy("s", (parameter_of("u=0:1"), parameter_of("v=0:1"))))
    materials = "\n[materials.foam]\n[materials.gel]\n" if phase == "optimisation" else ""
    (tmp_path / "base.toml").write_text(text + materials)

    def asked(study, arguments, decide):
        raise RuntimeError(*arguments)

    monkeypatch.setattr("hilbo.app.rehearsal.rehearsal._by_stand_in", asked)
    with pytest.raises(RuntimeError) as caught:
        rehearse(tmp_path / "base.toml", tmp_path / "out", phase=phase, seed=3)
    served(monkeypatch, *caught.value.args)


def test_a_study_is_made_fast_whether_it_has_steps_or_not(tmp_path):
    text = study_text(NewStudy("s", (parameter_of("texture=silk,wood"), parameter_of("gain=0:1:N"))))
    for source in (text, text.partition("[session]")[0]):
        (tmp_path / "base.toml").write_text(source)
        session = Study.load(fast_study(tmp_path / "base.toml", tmp_path / "fast.toml", 0.1, 2)).file.session
        for phase in ("warm-up", "optimisation", "validation", "aggregate-best"):
            assert {step.seconds for step in protocol(session, phase).steps} == {0.1}


def test_a_session_is_resumed_only_with_its_own_study_and_never_begun_twice(tmp_path, monkeypatch, capsys):
    study_of(tmp_path)
    file, logs = tmp_path / "study.toml", tmp_path / "logs"
    logs.mkdir()
    add_person(logs / "participants.csv", PERSON)
    wanted = Wanted(file, "P01", logs=logs)
    hub, log = opened(wanted, lambda *_: None, lambda *_: None)
    assert log.state.header.consent == PERSON["consent_time"]
    with pytest.raises(InputError, match="another hilbo"):
        opened(wanted._replace(resume=True), lambda *_: None, lambda *_: None)
    log.close()
    with pytest.raises(InputError, match="--resume"):
        opened(wanted, lambda *_: None, lambda *_: None)
    other = tmp_path / "other.toml"
    other.write_text(DATA.read_text().replace('"close"]', '"near"]'))
    with pytest.raises(InputError, match=r"another study .* they differ in study\.responses"):
        opened(wanted._replace(resume=True, study=other), lambda *_: None, lambda _: None)
    text = log.path.read_bytes()
    log.path.write_bytes(text.replace(b"P01", b"P02", 1))
    with pytest.raises(InputError, match="damaged"):
        opened(wanted._replace(resume=True), lambda *_: None, lambda *_: None)
    log.path.write_bytes(text)
    again, log = opened(wanted._replace(resume=True), lambda *_: None, lambda *_: None)
    log.close()
    assert again.tag == hub.tag
    assert again.state == hub.state
    capsys.readouterr()
    file.write_text(file.read_text() + '[session.texts]\nhello = "Good morning"\n')
    served(monkeypatch, file, "--logs", logs, "--port", 0, "--participant", "P01", "--resume")
    assert "as when the session began; now it differs in session.texts.hello\n" in capsys.readouterr().err


def served(monkeypatch, *arguments):
    """What keeps the keys of a session that is begun and ended; nobody is waited for."""
    gates = []
    monkeypatch.setattr(serve, "serve", lambda place, hub, started: gates.append(place.gate))
    command("session", *arguments)
    return gates.pop()


def test_each_session_of_a_person_has_keys_of_its_own(tmp_path, monkeypatch):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "of the tests")
    study = study_of(tmp_path)
    plans = {label: tmp_path / f"plan {label}.json" for label in ("1", "2")}
    for label, path in plans.items():
        path.write_text(plan_text(make_plan(study.file, ["P01"], session=label)))
    file, logs = tmp_path / "study.toml", tmp_path / "logs"
    place = (file, "--logs", logs, "--port", 0, "--dry-run", "--participant")
    first = served(monkeypatch, *place, "P01", "--plan", plans["1"])
    _, key = first.redeem(first.invite("participant"))
    others = [("P01", "--plan", plans["2"]), ("P01", "--session", "1-x"), ("P01-1", "--session", "x")]
    gates = [served(monkeypatch, *place, *other) for other in others]
    assert not any(gate.admits("participant", key) for gate in gates)
    keys = [gate.redeem(gate.invite("participant"))[1] for gate in gates]
    for other, kept in zip(others, keys, strict=True):
        again = served(monkeypatch, *place, *other)
        assert [again.admits("participant", one) for one in (key, *keys)] == [one == kept for one in (key, *keys)]
    assert served(monkeypatch, *place, "P01", "--plan", plans["1"]).admits("participant", key)


def a_map(study, path):
    """The map.nc of a population that likes one corner."""
    sides = [np.linspace(0.0, 1.0, 4)] * study.space.dim
    unit = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1)
    names = study.space.names
    coords = {p.name: np.asarray(p.to_physical(jnp.asarray(sides[0]))) for p in study.space.parameters}
    values = {"mean": 2.0 - unit.sum(axis=-1), "variance": np.full(unit.shape[:-1], 0.1)}
    xr.Dataset({name: (names, value) for name, value in values.items()}, coords).to_netcdf(path, engine="h5netcdf")
    return path


def begun(wanted):
    """Log, first two proposals."""
    hub, log = opened(wanted, lambda *_: None, lambda *_: None)
    with log:
        state, proposals = log.state, []
        for number, response in enumerate(("different", "close"), 1):
            event = actions.propose(state, hub.chooser, 0.0)
            proposals.append(event.data)
            state = state.after(event)
            answer = actions.answer(state, number, "c", {"class_a": response}, 1.0, felt=False)
            assert answer is not None
            state = state.after(answer)
    return log, proposals


@pytest.mark.deep  # compiles a session's choice twice: 2 s
def test_a_warm_start_is_in_the_log_and_a_resumed_session_chooses_the_same(tmp_path):
    study = study_of(tmp_path)
    file, logs = a_map(study, tmp_path / "map.nc"), tmp_path / "logs"
    header = header_for(study.file, "P01", seed=7, warm=False)
    plan = make_plan(study.file, ["P01"])
    row = structs.replace(plan.participants[0], header=planned_part(header))
    (tmp_path / "plan.json").write_text(plan_text(hashed(structs.replace(plan, participants=(row,)))))
    wanted = Wanted(
        tmp_path / "study.toml", "P01", logs=logs, plan=tmp_path / "plan.json", warm_start=file, dry_run=True
    )
    log, first = begun(wanted)
    assert log.state.header.seed == 7
    assert log.state.header.warm_start == f"={hashlib.sha256(file.read_bytes()).hexdigest()[:16]}"
    assert [data["choice"]["by"] for data in first] == ["map", "map"]
    again = wanted._replace(resume=True)
    assert begun(again)[1] == first
    with pytest.raises(InputError, match="give that map with --warm-start"):
        opened(again._replace(warm_start=None), lambda *_: None, lambda _: None)
    candidates = read_warm_start(file, study, 7).points
    first_unit = study.space.to_unit(np.array([first[0]["renderings"]["a"][n] for n in study.space.names]))
    assert float(jnp.min(jnp.max(jnp.abs(candidates - first_unit[None, :]), axis=1))) < 1e-9


def test_a_warm_start_that_is_refused_leaves_no_log(tmp_path):
    study = study_of(tmp_path)
    logs = tmp_path / "logs"
    wanted = Wanted(tmp_path / "study.toml", "P01", logs=logs, warm_start=tmp_path / "none.nc", dry_run=True)
    with pytest.raises(InputError, match="is no map"):
        opened(wanted, lambda *_: None, lambda *_: None)
    plan = make_plan(
        study.file, ["P01"], 0, "validation", sets={"": example_sets(study, preset_of("paper"))}, source="aggregate"
    )
    (tmp_path / "plan.json").write_text(plan_text(plan))
    planned = wanted._replace(plan=tmp_path / "plan.json", warm_start=a_map(study, tmp_path / "map.nc"))
    with pytest.raises(InputError, match="nothing is chosen"):
        opened(planned, lambda *_: None, lambda _: None)
    assert not list(tmp_path.rglob("*.jsonl"))


def test_a_device_that_cannot_be_used_is_one_sentence_and_leaves_no_log(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "of the tests")
    monkeypatch.setattr("hilbo.device.handshake._BOOT", 0.3)  # s that a silent line is waited for
    study = study_of(tmp_path)
    logs = tmp_path / "logs"
    place = (tmp_path / "study.toml", "--logs", logs, "--port", 0, "--participant", "P01", "--dry-run")
    with (
        contextlib.closing(Simulator(finger="none")) as simulator,
        Renderer.open(simulator.port, patience=10.0),
        socket.create_server(("127.0.0.1", 0)) as silent,
    ):
        cases = [
            (("--device", tmp_path / "ttyACM0"), 2, "ttyACM0"),
            (("--device", simulator.port), 2, "another program"),
            (("--device", f"socket://127.0.0.1:{silent.getsockname()[1]}"), 1, "answer"),
            (("--sim", "damping=0.05"), 2, "damping"),
            (("--device", tmp_path / "none", "--warm-start", a_map(study, tmp_path / "map.nc")), 2, "none"),
        ]
        for arguments, code, word in cases:
            status, out, err = run(capsys, monkeypatch, "session", *place, *arguments)
            assert (status, out) == (code, ""), err
            assert word in err.splitlines()[-1]
            assert err.splitlines()[-1].startswith("hilbo: ")
            assert "Traceback" not in err
            assert not list(logs.glob("*.jsonl"))


def test_a_session_that_was_begun_keeps_its_log_when_the_device_is_not_there(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "of the tests")
    study_of(tmp_path)
    file, logs = tmp_path / "study.toml", tmp_path / "logs"
    _, log = opened(Wanted(file, "P01", logs=logs, dry_run=True), lambda *_: None, lambda _: None)
    log.close()
    before = log.path.read_bytes()
    place = (file, "--logs", logs, "--port", 0, "--participant", "P01", "--dry-run", "--resume")
    assert run(capsys, monkeypatch, "session", *place, "--device", tmp_path / "ttyACM0")[0] == 2
    assert log.path.read_bytes() == before


def test_a_log_of_somebody_else_or_of_another_material_is_not_resumed(tmp_path):
    """P_1's session x and P's session 1_x have files of two names, and one that was renamed is known by its header."""
    study_of(tmp_path)
    file, logs = tmp_path / "study.toml", tmp_path / "logs"
    file.write_text(file.read_text() + "\n[materials.foam]\n[materials.gel]\n")
    wanted = Wanted(file, "P_1", "x", logs=logs, material="foam", dry_run=True)
    opened(wanted, lambda *_: None, lambda *_: None)[1].close()
    other = opened(wanted._replace(participant="P", session="1_x"), lambda *_: None, lambda *_: None)[1]
    other.close()
    other.path.write_bytes((logs / "P_1_x.session.jsonl").read_bytes())
    for change, words in (
        ({"participant": "P", "session": "1_x"}, "is session x of participant P_1; choose another --session"),
        ({"material": "gel"}, "was begun with the material foam; choose another --session, or --material"),
    ):
        with pytest.raises(InputError, match=words):
            opened(wanted._replace(resume=True, **change), lambda *_: None, lambda _: None)
    opened(wanted._replace(resume=True), lambda *_: None, lambda *_: None)[1].close()


def test_of_two_sessions_of_one_person_at_once_the_second_is_refused(tmp_path):
    study_of(tmp_path)
    wanted = Wanted(tmp_path / "study.toml", "P01", "1", logs=tmp_path, dry_run=True)
    people = tmp_path / "participants.csv"
    people.write_text("participant,consent_time,protocol_number\nP01,2026-05-04T10:15,7\nP02,2026-05-04T10:15,7\n")

    def started(**changes):
        return opened(wanted._replace(dry_run=False)._replace(**changes), lambda *_: None, lambda *_: None)[1]

    first = started()
    for change in ({"session": "2"}, {"session": "2", "seed": 5}):
        with pytest.raises(InputError, match=r"P01_1\.session\.jsonl: session 1 of P01 is running; end that one first"):
            started(**change)
    assert [path.name for path in log_paths(tmp_path)] == ["P01_1.session.jsonl"]
    for change in ({"session": "2", "dry_run": True}, {"participant": "P02"}):
        started(**change).close()
    first.close()
    second = started(session="3")
    with pytest.raises(InputError, match="session 3 of P01 is running"):
        started(resume=True)
    assert first.path.is_file()
    second.close()
    started(resume=True).close()


def test_a_session_that_was_begun_under_another_name_is_not_begun_again(tmp_path):
    study_of(tmp_path)
    wanted = Wanted(tmp_path / "study.toml", "P01", "day 1", logs=tmp_path, dry_run=True)
    log = opened(wanted, lambda *_: None, lambda *_: None)[1]
    log.close()
    log.path.rename(tmp_path / "P01_day-1.session.jsonl")
    with pytest.raises(InputError, match=f"is session day 1 of P01; rename it to {log.path.name} and add --resume"):
        opened(wanted, lambda *_: None, lambda *_: None)
    (tmp_path / "P01_day-1.session.jsonl").rename(log.path)
    opened(wanted._replace(resume=True), lambda *_: None, lambda *_: None)[1].close()


def test_options_that_contradict_the_plan_are_refused_and_another_label_begins_it_anew(tmp_path):
    study_of(tmp_path)
    file, path = tmp_path / "study.toml", tmp_path / "plan.json"
    file.write_text(file.read_text() + "\n[materials.foam]\n[materials.gel]\n")
    plan = make_plan(Study.load(file).file, ["P01"], 5, materials=["gel"], session="gel")
    path.write_text(plan_text(plan))
    seed = plan.participants[0].header.seed
    wanted = Wanted(file, "P01", logs=tmp_path / "logs", plan=path, dry_run=True)
    wanted.logs.mkdir()
    for change, words in (
        ({"material": "foam"}, "plans the session of P01 with the material gel; leave --material foam out"),
        ({"seed": 5}, f"plans the session of P01 with the seed {seed}; leave --seed 5 out"),
    ):
        for resume in (False, True):
            with pytest.raises(InputError, match=words):
                opened(wanted._replace(resume=resume, **change), lambda *_: None, lambda _: None)
    assert not list(wanted.logs.iterdir())
    for same, name in (({"material": "gel", "seed": seed}, "P01_gel"), ({"session": "gel-2"}, "P01_gel-2")):
        log = opened(wanted._replace(**same), lambda *_: None, lambda _: None)[1]
        log.close()
        assert log.path.name == f"{name}.session.jsonl"
        opened(wanted._replace(resume=True, **same), lambda *_: None, lambda _: None)[1].close()
    first, second = (read_log(wanted.logs / f"P01_{label}.session.jsonl")[0] for label in ("gel", "gel-2"))
    assert second == structs.replace(first, session="gel-2")


def test_a_session_is_resumed_by_a_plan_that_replaces_its_own(tmp_path):
    study = study_of(tmp_path)
    file, path, logs = tmp_path / "study.toml", tmp_path / "plan.json", tmp_path / "logs"
    plan = make_plan(study.file, ["P01", "P02", "P03"])
    path.write_text(plan_text(plan))
    wanted = Wanted(file, "P01", logs=logs, plan=path, dry_run=True)
    logs.mkdir()
    opened(wanted, lambda *_: None, lambda *_: None)[1].close()
    path.write_text(plan_text(reissue(plan, "P02", "P04")))
    opened(wanted._replace(resume=True), lambda *_: None, lambda *_: None)[1].close()
    delete_participant(tmp_path, "P03")
    opened(wanted._replace(resume=True), lambda *_: None, lambda *_: None)[1].close()
    assert len(read_plan(path).replaces) == 2
    for other in (
        make_plan(study.file, ["P01"]),
        structs.replace(make_plan(study.file, ["P01"], 1), replaces=(plan.hash,)),  # what was begun is not in it
    ):
        path.write_text(plan_text(hashed(other)))
        with pytest.raises(InputError, match="was begun by another plan"):
            opened(wanted._replace(resume=True), lambda *_: None, lambda *_: None)


def test_a_session_without_a_plan_needs_a_material_and_is_resumed_with_its_own_seed(tmp_path):
    study_of(tmp_path)
    file = tmp_path / "study.toml"
    file.write_text(file.read_text() + "\n[materials.foam]\n[materials.gel]\n")
    wanted = Wanted(file, "P01", logs=tmp_path / "logs", seed=3, dry_run=True)
    wanted.logs.mkdir()
    with pytest.raises(InputError, match="has the materials foam, gel; add --material with the one of this session"):
        opened(wanted, lambda *_: None, lambda *_: None)
    assert not list(wanted.logs.iterdir())
    opened(wanted._replace(material="gel"), lambda *_: None, lambda _: None)[1].close()
    with pytest.raises(InputError, match="was begun with the seed 3; choose another --session, or --seed"):
        opened(wanted._replace(resume=True, seed=4), lambda *_: None, lambda _: None)
    log = opened(wanted._replace(resume=True, seed=None), lambda *_: None, lambda _: None)[1]
    log.close()
    assert (log.state.header.seed, log.state.header.blocks[0].material) == (3, "gel")


def test_a_dry_run_stays_one_and_a_session_with_a_person_too(tmp_path, monkeypatch):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "of the tests")
    study_of(tmp_path)
    file, logs = tmp_path / "study.toml", tmp_path / "logs"
    logs.mkdir()
    add_person(logs / "participants.csv", PERSON)
    place = (file, "--logs", logs, "--port", 0, "--participant", "P01", "--device", tmp_path / "ttyACM0")
    for session, dry, word in (("1", True, "begun as a dry run"), ("2", False, "leave --dry-run out")):
        wanted = Wanted(file, "P01", session, logs=logs, dry_run=dry)
        _, log = opened(wanted, lambda *_: None, lambda *_: None)
        log.close()
        assert read_log(log.path)[0].dry_run == dry
        other = () if dry else ("--dry-run",)
        assert word in refused(*place, "--session", session, "--resume", *other)
        assert "another hilbo" not in refused(*place, "--session", session, "--resume", *other)
        opened(wanted._replace(resume=True), lambda *_: None, lambda *_: None)[1].close()


def test_links_are_for_this_computer_unless_the_network_is_asked_for(monkeypatch):
    place = serve.bound(0)
    assert place.socket.getsockname()[0] == "127.0.0.1"
    assert all(link.startswith("http://127.0.0.1:") for link in place.links().values())
    place.socket.close()
    monkeypatch.setattr(serve, "lan_addresses", lambda: ["192.0.2.7"])
    place = serve.bound(0, lan=True)
    links = place.links()
    assert links["participant"].startswith("http://192.0.2.7:")
    assert links["experimenter"].startswith("http://127.0.0.1:")
    assert links["participant"].partition("#")[2] != links["experimenter"].partition("#")[2]
    assert serve.qr_image(links["participant"]).startswith("data:image/svg+xml;base64,")
    assert serve.qr_text(links["participant"]).count("\n") > 10
    place.socket.close()
    monkeypatch.setattr(serve, "lan_addresses", lambda: [])
    with pytest.raises(InputError, match="no network"):
        serve.bound(0, lan=True)


def test_the_doctor_finds_all_well_with_the_simulated_device(tmp_path, capsys):
    def connect(damping, delay):
        return Renderer.open("sim", damping=damping, options={"finger": "none"}, patience=10.0)

    checks = {check.name: check for check in doctor.checks(DATA, connect, tmp_path, 0)}
    assert set(checks) >= {
        "versions", "disk", "server's port", "browser", "serial ports", "study", "precision and cache",
        "feasible set", "time of a step", "device", "device loopback", "damping",
    }  # fmt: skip
    assert [name for name, check in checks.items() if check.level == "bad"] == []
    assert "0 wrong" in checks["device loopback"].words


def test_the_doctor_says_what_to_mend(tmp_path):
    def connect(*_):
        return Renderer.open("sim", options={"finger": "none", "damping": 0.5}, patience=10.0)

    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        (tmp_path / "file").write_text("")
        checks = {check.name: check for check in doctor.checks(DATA, connect, tmp_path / "file", port)}
    assert checks["damping"].level == "bad"
    assert "measure-damping" in checks["damping"].fix
    assert checks["server's port"].level == "bad"
    assert checks["disk"].level == "bad"
    assert all(check.fix for check in checks.values() if check.level == "bad")
    (broken := tmp_path / "study.toml").write_text("schema = 2")
    (tmp_path / "out").mkdir()
    checks = {check.name: check for check in doctor.checks(broken, lambda *_: unplugged(), tmp_path / "out", 0)}
    assert checks["study"].level == checks["device"].level == "bad"
    assert json.dumps([check._asdict() for check in checks.values()])


def unplugged():
    raise InputError("there is no such port")


def test_the_doctor_says_what_constraints_leave():
    new = NewStudy("x", (parameter_of("a=0:2"), parameter_of("b=0:2")), constraints=("a + b <= 2",))
    check = doctor._feasible(Study.from_dict(tomllib.loads(study_text(new))))
    assert (check.level, check.words) == ("good", "50.0 % of the box is within the constraints")
