"""In the place of the program, or of the person, that presents a study's renderings: it confirms whatever is asked for.

`hilbo simulate --live` has it where a study has no device of ours, by the same messages as everybody's program
(docs/guides/stimulus.md).
"""

import contextlib
import http.client
import threading
from collections.abc import Mapping
from typing import Any

from hilbo.app.rehearsal.robot import Client
from hilbo.app.wire.security import Role
from hilbo.session.log.presented import in_numbers
from hilbo.study.file.reading import StudyFile

__all__ = ["StandIn"]

_SAID = {"name": "stand-in", "version": "1", "force": False, "neutral_within_s": 1.0}
_WAIT = 0.2  # s that the server may keep a question without news
_AGAIN = 0.1  # s until a server that did not take a report is asked again


class StandIn:
    """Joins by the link of `role`, and presents in a thread of its own until `close`."""

    def __init__(self, study: StudyFile, link: str, role: Role):
        self._study, self._client, self._path = study, Client(link), f"/api/{role}"
        self._presented: dict[int, dict[str, Mapping[str, float]]] = {}
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._present, name="hilbo-stand-in", daemon=True)
        self._thread.start()

    def presented(self, trial: int) -> dict[str, Mapping[str, float]]:
        """What was presented in a trial so far: side -> values as numbers, of levels their places in the study's
        list."""
        return self._presented.get(trial, {})

    def close(self) -> None:
        """Leave the session."""
        self._ended.set()
        self._thread.join()

    def __enter__(self) -> "StandIn":
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def _present(self) -> None:
        while not self._ended.is_set():
            with contextlib.suppress(OSError, http.client.HTTPException):  # not taken, or nobody is there
                order = self._client.post(f"{self._path}/hello", _SAID)
                run = order["run"]
                while not self._ended.is_set():
                    order = self._client.post(self._path, {"run": run, "wait_s": _WAIT, **self._done(order)})
            self._ended.wait(_AGAIN)

    def _done(self, order: Mapping[str, Any]) -> dict[str, Any]:
        """The report on an order that was followed to the letter."""
        report: dict[str, Any] = {"order": order["order"], "state": "neutral"}
        if order["do"] == "present":
            report |= {"state": "presented", "trial": order["trial"]}
            if order["values"]:
                report["values"] = order["values"]
                trial = int(order["trial"].rpartition(":")[2].partition(".")[0])
                values = in_numbers(self._study, order["values"])
                assert values is not None
                self._presented.setdefault(trial, {})[order["side"]] = values
        return report
