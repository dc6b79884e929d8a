"""A session whose log is deleted, replaced or cut while it runs stops, says so, and acknowledges nothing more."""

import os
import shutil

import pytest
from live_server import Live, refused

from hilbo.session.log.event_log import read_log


def replace(path):
    shutil.copy(path, path.with_name("save"))
    os.replace(path.with_name("save"), path)


@pytest.mark.parametrize(
    "fault",
    [os.unlink, replace, lambda path: os.truncate(path, 400), lambda path: path.parent.rename(f"{path.parent} 2")],
    ids=["deleted", "replaced", "truncated", "folder renamed"],
)
def test_the_session_stops_and_every_acknowledged_answer_is_in_the_copy(tmp_path, fault):
    (tmp_path / "logs").mkdir()
    with Live(tmp_path / "logs") as live:
        live.begin()
        live.answer()
        live.answer()
        view = live.question()
        fault(live.path)
        seen = live.until(lambda view: view["alert"], live.whole)
        assert f"{live.path}: " in seen["alert"] and "Acknowledged so far: 2 answers, in" in seen["alert"]
        assert not {"note", "pause", "undo", "void", "abort"} & set(seen["may"]) and "estop" in seen["may"]
        with refused(503):
            live.answer(view)
        live.until(lambda view: view["phase"] == "wait" and not view["may"]["begin"])
        live.until(lambda _: live.hub.rig.snapshot.state == "STOPPED", lambda: live.hub.rig.snapshot)
        (copy,) = live.path.parent.glob("*.rescued.jsonl")
        assert sum(event.kind == "answer" for event in read_log(copy, live.study.file)[1]) == 2
