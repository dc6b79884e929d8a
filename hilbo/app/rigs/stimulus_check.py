"""Check of a stimulus program: renderings are presented and stopped by the server and rig of a session, without a
participant, an experimenter or a log.
"""

import asyncio
import time
from collections.abc import Callable
from typing import Any, NamedTuple

from hilbo.app.rigs.rig import Showing
from hilbo.app.rigs.stimulus_rig import StimulusRig
from hilbo.app.wire.watchers import Watchers
from hilbo.errors import InputError
from hilbo.study.file.reading import StudyFile

__all__ = ["Measured", "StimulusCheck"]

_OFTEN = 5  # renderings, and stops in them


class Measured(NamedTuple):
    """Result of a check: the program's name and version in words (`words`), times (s) until each rendering was
    confirmed and until each stop was acknowledged, and why the check failed, or ""."""

    words: str
    presented: tuple[float, ...]
    stopped: tuple[float, ...]
    why: str


def _example(study: StudyFile) -> dict[str, float]:
    """A rendering of a study, as orders have it: the middle of all ranges; with [renderer] a passive one, with K0,
    and with an equality one that satisfies it."""
    space = study.space
    if space.mechanics is None and not any(constraint.equality for constraint in space.constraints):
        middles = ((p, p.middle) for p in space.parameters)
        return {p.name: float(round(middle)) if p.discrete else middle for p, middle in middles}
    from hilbo.search.rendering import Rendering
    from hilbo.search.space import SearchSpace

    searched = SearchSpace(space.parameters, space.mechanics, space.constraints)
    return Rendering.at(searched, searched.candidates(1, 0)[0]).parameters


class StimulusCheck:
    """In the place of a hub, for `serve`. It waits `patience` s for the program to join; `measured` is None until the
    check is over."""

    def __init__(self, study: StudyFile, patience: float):
        self.rig = StimulusRig(study, "check")
        self.watchers = Watchers(lambda: "")
        self.measured: Measured | None = None
        self._study, self._patience = study, patience
        self._rendering = _example(study)
        self._done: Callable[[], Any] = lambda: None
        self._task: asyncio.Task | None = None

    def begin(self, done: Callable[[], Any]) -> None:
        """Start to measure, in the running event loop; `done` is called when `measured` is set."""
        self._done = done
        self._task = asyncio.get_running_loop().create_task(self._measure())

    async def open(self) -> None:
        """Do nothing: there is no device to open."""

    async def close(self) -> None:
        """Cancel the measurement."""
        if self._task is not None:
            self._task.cancel()

    def text(self, key: str) -> str:
        """The participant's text for a key, in the study's own words or language."""
        return self._study.session.text(key)

    def hang_up(self) -> None:
        """End all waiting requests of the program."""
        self.rig.hang_up()

    async def _measure(self) -> None:
        """Have renderings presented and stopped, `_OFTEN` times, set `measured`, and call `done`. An error of the rig
        ends it, and is its `why`."""
        presented: list[float] = []
        stopped: list[float] = []
        why = ""
        try:
            await self._joined()
            for number in range(_OFTEN):
                presented.append(await self._timed(self.rig.show(self._showing(number))))
                stopped.append(await self._timed(self.rig.estop()))
                await self.rig.clear()
        except (RuntimeError, InputError) as error:
            why = str(error)
        self.measured = Measured(self.rig.words, tuple(presented), tuple(stopped), why)
        await asyncio.sleep(0.1)  # so that the program hears the last order
        self._done()

    async def _joined(self) -> None:
        """Wait until a program has joined and has stopped once. Raises `RuntimeError` after `patience` s."""
        end = time.monotonic() + self._patience
        while self.rig.snapshot.lost:
            if time.monotonic() > end:
                raise RuntimeError(self.rig.snapshot.lost)
            await asyncio.sleep(0.02)

    def _showing(self, number: int) -> Showing:
        """A request for a rendering in trial `number` + 1."""
        return Showing(number + 1, 1, 0, "a", self._rendering, None)

    @staticmethod
    async def _timed(work: Any) -> float:
        """Await `work`, and return how long it took, s."""
        begun = time.perf_counter()
        await work
        return time.perf_counter() - begun
