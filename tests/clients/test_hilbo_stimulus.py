"""The Python client and its examples, as they are copied: in sessions of the real server."""

import ast
import asyncio
import contextlib
import subprocess
import sys
import threading

import pytest
from live_server import PATIENCE
from live_stimulus import CLIENTS, SINGLE, LiveStimulus, Presenter, all_answered, module


@pytest.fixture
def live(tmp_path):
    with LiveStimulus(tmp_path, blocks=SINGLE) as session:
        yield session


@contextlib.contextmanager
def running(name, *arguments):
    """An example as its user runs it."""
    command = [sys.executable, str(CLIENTS / name), *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.out, process.err = process.communicate(timeout=PATIENCE)


@pytest.mark.parametrize(
    ("name", "words"),
    [("example_patch.py", ["Reference", "Test", "\x1b[48;2;"]), ("example_asyncio.py", ["present reference", "'hue'"])],
)
def test_an_example_presents_a_whole_session(live, name, words):
    with running(name, live.link()) as process:
        sent = all_answered(live)
    assert [data["program"] for data in sent] == 3 * [name.removesuffix(".py")]
    assert all(word in process.out for word in words) and "Traceback" not in process.err


def test_an_example_says_in_a_sentence_why_it_cannot_join(live):
    with running("example_patch.py", live.link() + "x") as process:
        assert process.wait(PATIENCE) == 1
    assert process.err.startswith("This link has been used, or is not of this session") and process.err.count("\n") == 1


def test_the_example_for_psychopy_uses_what_the_client_has():
    """PsychoPy itself needs a screen; docs/guides/stimulus.md says when it ran."""
    client = module("hilbo_stimulus").Stimulus
    tree = ast.parse((CLIENTS / "example_psychopy.py").read_text())
    used = {n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute) and getattr(n.value, "id", "") == "stimulus"}
    assert used and all(hasattr(client, name) for name in used)


def test_the_client_needs_the_standard_library_alone():
    tree = ast.parse((CLIENTS / "hilbo_stimulus.py").read_text())
    names = {a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}
    names |= {n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
    assert {name.split(".")[0] for name in names} <= set(sys.stdlib_module_names)


def test_asyncio_presents_beside_other_tasks(live):
    client = module("hilbo_stimulus")

    async def present(stimulus):
        async for order in stimulus.orders():
            done = stimulus.presented if order.do == "present" else stimulus.neutral
            await asyncio.to_thread(done)

    async def both():
        with await asyncio.to_thread(client.Stimulus, live.link(), "async", "3") as stimulus:
            presenting = asyncio.create_task(present(stimulus))
            confirmations = await asyncio.to_thread(all_answered, live)
            presenting.cancel()
        return confirmations

    sent = asyncio.run(both())
    assert [(data["program"], data["version"]) for data in sent] == 3 * [("async", "3")]


def test_a_program_that_is_started_again_finds_its_session_by_the_key_file(tmp_path):
    with LiveStimulus(tmp_path, blocks=SINGLE, silence=0.5) as live:
        link, file = live.link(), str(tmp_path / "stimulus.key")
        with Presenter(link, key_file=file):
            live.until(lambda v: v["device"]["state"] == "stopped", live.whole)
        assert (tmp_path / "stimulus.key").stat().st_mode & 0o077 == 0
        with Presenter(link, key_file=file):
            assert len(all_answered(live)) == 3


def test_two_programs_with_one_key_file_do_not_take_over_from_each_other(tmp_path, caplog):
    """The second says once why it waits, and presents as soon as the first is gone."""
    with LiveStimulus(tmp_path, blocks=SINGLE, silence=0.5) as live:
        link, file = live.link(), str(tmp_path / "stimulus.key")
        first = Presenter(link, key_file=file)
        live.until(lambda v: v["device"]["state"] == "stopped", live.whole)
        with Presenter(link, key_file=file) as second:
            with first:
                live.until(lambda _: caplog.messages, lambda: None)
                live.begin()
                live.answer()
                assert first.shown and not second.shown
            all_answered(live)
            assert second.shown
        conditions = [event.data["condition"] for event in live.events("device")]
    waits = [words for words in caplog.messages if words.startswith("waiting: ")]
    assert len(waits) == 1 and "is still heard; end that one" in waits[0]
    assert conditions == ["stopped", "ready", "lost", "ready"]


def test_a_new_link_ends_the_program_that_had_the_old_one(live):
    with Presenter(live.link()) as old:
        live.until(lambda v: v["device"]["state"] == "stopped", live.whole)
        live.by_hand()
        with pytest.raises(sys.modules["hilbo_stimulus"].StimulusError, match="no longer part"):
            live.until(lambda _: False, lambda: old.stimulus.next(0.1))


@pytest.mark.deep
def test_a_device_that_stops_by_itself_voids_the_trial_which_comes_again(tmp_path):
    stopped, limp = [], []
    with LiveStimulus(tmp_path, blocks=SINGLE, felt=1.0) as live:
        stimulus = module("hilbo_stimulus").Stimulus(
            live.link(), name="haptic", force=True, go_neutral=lambda: limp.append(1)
        )

        def present():
            for order in stimulus:
                if order.do != "present":
                    stimulus.neutral()
                elif stimulus.presented() and order.show == "test" and not stopped:
                    stopped.append(order.number)
                    stimulus.begin_again("it held")
                    assert limp

        presenting = threading.Thread(target=present)
        presenting.start()
        live.until(lambda v: v["device"]["state"] == "stopped", live.whole)
        live.begin()
        live.until(lambda _: any(event.data["condition"] == "lost" for event in live.events("device")), lambda: None)
        all_answered(live)
        stimulus.close()
        presenting.join(PATIENCE)
        state = live.replayed()
    assert sum(trial.status == "answered" for trial in state.trials) == 3
    assert [str(trial.voided) for trial in state.trials if trial.status == "void"]


def test_no_order_to_present_is_handed_over_while_somebody_touches(tmp_path):
    with LiveStimulus(tmp_path, blocks=SINGLE) as live:
        client, calls = module("hilbo_stimulus"), []
        said = {"force": True, "go_neutral": lambda: calls.append(1), "neutral_within_s": 0.5}
        with client.Stimulus(live.link(), "arm", "1", **said) as stimulus:
            live.until(lambda v: v["device"]["state"] == "stopped", live.whole)
            assert calls  # for the stop that is measured, without a word of the program's own loop
            live.begin()
            live.until(lambda _: stimulus.order.do == "present", lambda: None)
            stimulus.contact = True
            handed = stimulus.next(0.15)
            assert handed is None or handed.do != "present"
            stimulus.contact = False
            live.until(lambda order: order is not None and order.do == "present", lambda: stimulus.next(0.1))


def test_what_is_no_number_is_refused_before_it_is_sent(live):
    with Presenter(live.link()) as program:
        for value in (float("nan"), float("inf")):
            with pytest.raises(ValueError, match="which is no number"):
                program.stimulus.presented({"hue": value, "light": 1.0})
        assert len(all_answered(live)) == 3


def test_a_program_whose_neutral_fails_is_lost_and_does_not_say_that_it_is(tmp_path):
    def broken():
        raise RuntimeError("the amplifier does not answer")

    with LiveStimulus(tmp_path, blocks=SINGLE) as live:
        client = module("hilbo_stimulus")
        said = {"force": True, "go_neutral": broken, "neutral_within_s": 0.01}
        with client.Stimulus(live.link(), "arm", "1", **said):
            live.until(lambda v: "has not confirmed neutral" in v["device"]["words"], live.whole)
            assert all(event.data["condition"] != "ready" for event in live.events("device"))


def test_an_order_that_comes_after_the_silence_is_not_followed(live):
    with Presenter(live.link()) as program:
        live.until(lambda v: v["device"]["state"] == "stopped", live.whole)
        stimulus = program.stimulus
        run = stimulus._run
        stimulus._take("a run that is over", {"order": 10**6, "do": "present"})
        assert stimulus.order.number < 10**6
        stimulus._take(run, {"order": 10**6, "do": "present", "trial": "x"})
        assert stimulus.order.number == 10**6


def test_an_order_is_handed_over_as_soon_as_the_hand_leaves(tmp_path):
    with LiveStimulus(tmp_path, blocks=SINGLE) as live:
        client = module("hilbo_stimulus")
        said = {"force": True, "go_neutral": lambda: None, "neutral_within_s": 0.5}
        with client.Stimulus(live.link(), "arm", "1", **said) as stimulus:
            live.until(lambda v: v["device"]["state"] == "stopped", live.whole)
            live.begin()
            live.until(lambda _: stimulus.order.do == "present", lambda: None)
            stimulus.contact = True
            waiting = threading.Thread(target=lambda: orders.append(stimulus.next(PATIENCE)))
            orders = []
            waiting.start()
            stimulus.contact = False
            waiting.join(PATIENCE / 2)
            assert not waiting.is_alive() and orders[0] is not None
