"""A stand-in for the program or the person that presents a study's renderings: it confirms every order.

`hilbo simulate --live` uses it for a study with [stimulus], by the messages of any such program
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
_AGAIN = 0.1  # s until a report that was not accepted is sent again


class StandIn:
    """Joins by the link of `role`, and confirms orders in a separate thread until `close`, which the end of a with
    block calls."""

    def __init__(self, study: StudyFile, link: str, role: Role):
        self._study, self._client, self._path = study, Client(link), f"/api/{role}"
        self._presented: dict[int, dict[str, Mapping[str, float]]] = {}
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._present, name="hilbo-stand-in", daemon=True)
        self._thread.start()

    def presented(self, trial: int) -> dict[str, Mapping[str, float]]:
        """Confirmed values of a trial so far: side -> values as numbers (a level as its index in the study's list);
        empty for an unknown trial."""
        return self._presented.get(trial, {})

    def close(self) -> None:
        """Leave the session, and wait for the thread to end."""
        self._ended.set()
        self._thread.join()

    def __enter__(self) -> "StandIn":
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def _present(self) -> None:
        """The thread: say hello, then report on each order as soon as it comes; after an error of the connection, begin
        again."""
        while not self._ended.is_set():
            with contextlib.suppress(OSError, http.client.HTTPException):  # not accepted, or no server
                order = self._client.post(f"{self._path}/hello", _SAID)
                run = order["run"]
                while not self._ended.is_set():
                    order = self._client.post(self._path, {"run": run, "wait_s": _WAIT, **self._done(order)})
            self._ended.wait(_AGAIN)

    def _done(self, order: Mapping[str, Any]) -> dict[str, Any]:
        """The report that an order was carried out exactly; confirmed values are recorded for `presented`."""
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
