"""Lines of a live session on the terminal: what is written when, and that the session never waits for it."""

import threading
from pathlib import Path

import pytest
from live import Driver

from hilbo.app.pages.session_lines import SessionLines, line_of
from hilbo.session.log import actions as live
from hilbo.session.log.state import LiveSession


def before_all(driver):
    return LiveSession.start(driver.state.study, driver.state.header)


def lines_of(driver):
    """All lines of a driver's events, in their order."""
    state, lines = before_all(driver), []
    for event in driver.events:
        after = state.after(event)
        lines += [line] if (line := line_of(state, event, after, "hilbo export")) else []
        state = after
    return lines


def test_a_whole_session():
    driver = Driver()
    driver.step()
    for _ in range(200):
        if driver.state.screen == "done":
            break
        for doing in ("feel", "answer", "go"):
            driver.do(doing, 1)
    lines, of = lines_of(driver), sum(block.count for block in driver.state.header.blocks)
    assert driver.state.screen == "done" and lines[0] == "The participant has begun."
    assert lines[-1] == "No trial is left. Ctrl-C ends the server; then hilbo export"
    counts = [int(line.split()[0]) for line in lines if line.endswith(f"of {of} responses.")]
    assert len(counts) == 3 and all(count >= part * of / 4 for part, count in enumerate(counts, 1))
    assert lines.count(lines[0]) == lines.count(lines[-1]) == 1


def test_stops_and_breaks_have_a_line():
    driver = Driver()
    driver.step()
    driver.log(live.pause(driver.state, "participant", 50.0))
    driver.log(live.resume(driver.state, 51.0))
    driver.log(live.abort(driver.state, "enough", 52.0))
    assert lines_of(driver)[-3:] == [
        "A break, requested by the participant.",
        "The break is over.",
        "The session is ended early: enough.",
    ]


@pytest.mark.parametrize("fails", [False, True])
def test_a_terminal_that_takes_nothing_stops_nobody(fails):
    """Events are taken while a write blocks; after an error further lines are written."""
    free, written = threading.Event(), []

    def write(line):
        assert free.wait(10)
        written.append(line)
        if fails and len(written) == 1:
            raise OSError("Input/output error")

    driver = Driver()
    driver.step()
    driver.log(live.pause(driver.state, "participant", 50.0))
    driver.log(live.abort(driver.state, "enough", 51.0))
    lines, state = SessionLines(Path("study.toml"), Path("logs"), write), before_all(driver)
    for event in driver.events:
        lines(state, event, state := state.after(event))
    assert not written
    free.set()
    for _ in range(1000):
        if len(written) == 2:
            break
        threading.Event().wait(0.01)
    assert "A break" in written[0] and written[1].endswith("The session is ended early: enough.")
