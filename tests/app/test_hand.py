"""A session whose participant's hand is on the handle when a rendering is to begin, and the flags of its trials: the
real server, with a device in Python."""

import pytest
from fake_device import FakeDevice
from live_server import Live

from hilbo.app.hub import runner
from hilbo.app.pages import blind
from hilbo.device.reasons import HoldReason, SampleFlag, State
from hilbo.session.export.tables import trials_table
from hilbo.study.file.plan_file import Block, Planned

WARM_UP = (Block("warm-up", 4, tuple(map(Planned, ("best", "mid", "worst", "best")))),)


class LiveFake(Live):
    """A session on a device whose hand a test moves."""

    def __init__(self, folder, *, pressed=False, blocks=WARM_UP, **options):
        super().__init__(folder, blocks=blocks, **options)
        self.fake = FakeDevice(pressed)

    def connect(self):
        return self.fake


def test_a_rendering_begins_once_the_hand_has_left_and_the_page_asks_for_that(tmp_path):
    with LiveFake(tmp_path, pressed=True) as live:
        live.begin()
        view = live.until(lambda view: "handles" in view["title"])
        assert view["phase"] == "wait" and "stays down, lift it" in view["message"] and view["step"] is None
        assert live.whole()["phase_words"] == "Waiting for the hand to leave the device"
        assert live.fake.starts == 0
        live.fake.pressed = False
        live.answer()
        assert live.fake.told.index("start") > live.fake.told.index("send")
        assert "note" not in {event.kind for event in live.events()}
        live.replays()


@pytest.mark.parametrize("late", [False, True])
def test_a_hand_that_stays_interrupts_the_trial_and_nothing_is_forced(tmp_path, monkeypatch, late):
    """`late`: it comes back between the set and START, which the device refuses."""
    monkeypatch.setattr(runner, "_LEAVES", 0.2)
    session = LiveFake(tmp_path, pressed=not late)
    send = session.fake.send

    def come_back(*parameter_set, **numbers):
        session.fake.pressed = True
        return send(*parameter_set, **numbers)

    if late:
        monkeypatch.setattr(session.fake, "send", come_back)
    with session as live:
        live.begin()
        live.until(lambda _: live.events("note"))
        (note,) = live.events("note")
        assert (
            note.data["text"]
            == "The participant did not release the device within 0.2 s; the trial restarts after Begin is pressed."
        )
        live.until(lambda view: view["may"]["begin"])
        assert "The participant did not release" in str(live.whole()["log"])
        trial = live.hub.state.pending
        assert (trial.id, trial.presentation, trial.step, trial.status) == (1, 2, None, "pending")
        assert "start" not in live.fake.told and live.fake.now == State.STOPPED
        monkeypatch.setattr(live.fake, "send", send)
        live.fake.pressed = False
        live.begin()
        live.answer()
        assert live.hub.state.trials[0].status == "answered"
        assert not live.hub.state.stops(0)  # the rendering is not blamed
        live.replays()


def test_an_emergency_stop_while_the_hand_is_waited_for_stays_until_it_is_cleared(tmp_path):
    with LiveFake(tmp_path, pressed=True) as live:
        live.begin()
        live.until(lambda view: "handles" in view["title"])
        live.command("estop")
        live.until(lambda v: v["device"]["state"] == "estop" and v["phase"] == "trouble", live.whole)
        live.fake.pressed = False
        live.device_did("ready", "estop")
        assert live.fake.now == State.ESTOP and "start" not in live.fake.told
        live.command("clear")
        live.answer()


def test_the_flags_of_a_trial_are_in_the_log_on_the_page_and_in_the_table(tmp_path):
    flag = SampleFlag
    with LiveFake(tmp_path) as live:
        live.begin()
        live.question()
        live.fake.arrives(flag.RUNNING, flag.RUNNING | flag.SATURATED | flag.SLEWED, flag.RUNNING | flag.SLEWED)
        live.answer()
        live.question()
        live.answer()
        first, second = (event.data["telemetry"] for event in live.events("answer"))
        assert first == {"samples": 3, "saturated": 1, "slewed": 2} and second == {"samples": 0}
        whole = live.whole()
        assert "Flagged of 3 samples: saturated 1, slewed 2." in str(whole["log"])
        assert ["W1", "different", "saturated; slewed"] in [row["cells"][:3] for row in whole["table"]["rows"]]
        assert "satur" not in str(live.view())
        live.replays()
        table = trials_table([live.replayed()])
        assert table["flags"].tolist() == ["saturated slewed", ""]
        assert table["telemetry_samples"].tolist() == [3, 0]


def test_an_answer_after_a_restart_of_the_server_has_no_record_of_flags(tmp_path):
    with LiveFake(tmp_path) as live:
        live.begin()
        live.until(lambda view: view["phase"] == "answer")
    with LiveFake(tmp_path) as live:
        live.answer()
        assert "telemetry" not in live.events("answer")[0].data
        assert live.hub.state.trials[0].telemetry is None
        live.replays()


def test_the_reason_of_a_hold_is_on_the_experimenter_s_page(tmp_path):
    with LiveFake(tmp_path) as live:
        live.begin()
        live.question()
        live.fake.stopped_by(HoldReason.HEAT, State.HOLD)
        words = "the mean force was above what the motor bears continuously"
        view = live.until(lambda v: v["phase"] == "trouble" and v["device"]["state"] == "hold", live.whole)
        assert ["Reason", words] in view["device"]["rows"]
        assert view["phase_words"] == f"Stopped: The device is in HOLD: {words}."
        live.until(lambda v: f"The device is in hold: {words}. W1 is void." in str(v["log"]), live.whole)
        live.fake.notices.append("tick 7: STOPPED, it received a stop")
        view = live.until(lambda v: v["log"][0][0] == "", live.whole)
        assert view["log"][0][2] == "The device, tick 7: STOPPED, it received a stop."
        seqs = [seq for seq, _, _ in blind.experimenter(live.hub, view)["log"]]
        assert seqs and all(seqs)


def test_a_start_that_a_stop_has_overtaken_is_said_and_tried_again_from_the_first_step(tmp_path, monkeypatch):
    session = LiveFake(tmp_path)
    start = session.fake.start

    def overtaken(**order):
        monkeypatch.setattr(session.fake, "start", start)
        session.fake.stop()
        start(**order)

    monkeypatch.setattr(session.fake, "start", overtaken)
    with session as live:
        monkeypatch.setattr(runner, "_LATER", 0.5)  # s for which the sentence is shown
        live.begin()
        view = live.until(lambda v: v["phase"] == "trouble", live.whole)
        assert view["phase_words"] == "Stopped: refused: STALE" and live.fake.now == State.STOPPED
        live.answer()
        assert live.hub.state.trials[0].status == "answered"
        shown = [event.data["show"] for event in live.events("stimulus") if event.data["on"]]
        assert shown[:2] == ["reference", "reference"] and "a" in shown[2:]  # again from the first step
        live.replays()
