"""The hub of a live session as its parts see it: what the runner, interruptions, commands and pages may use of a `Hub`.

The hub makes its parts, so that they cannot import it. Only `commit` writes to the log.
"""

import asyncio
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol, runtime_checkable

from hilbo.app.rigs.rig import Notice, Rig
from hilbo.app.wire.security import Role
from hilbo.session.log.records import Event
from hilbo.session.log.state import LiveSession

__all__ = ["HubInterface", "RunnerInterface", "WatchersInterface"]


@runtime_checkable
class RunnerInterface(Protocol):
    """The task that presents trials (`Runner`)."""

    stage: str
    """What it does now, such as "choosing", "step", "answer", "trouble"."""
    step: int | None
    """Index of the step of the trial that is being presented."""
    ends: float
    """When that step ends, s, on the monotonic clock."""
    trouble: str
    """Why the session does not continue; empty where it does."""
    fits_after: int
    """Number of fits made after an answer, while the participant waited."""

    def restart(self) -> None:
        """Cancel the present work and start again from the current state."""

    def wake(self) -> None:
        """Have the task check the condition that it waits for (Begin, or the rig) again."""

    def forget(self) -> None:
        """Record that the rig has no active stimulus, so that the next one is prepared again."""


@runtime_checkable
class WatchersInterface(Protocol):
    """The open pages and programs (`Watchers`)."""

    @property
    def participant_here(self) -> bool:
        """Whether the participant's page, or a program in its place, has given a sign of life lately."""
        ...


@runtime_checkable
class HubInterface(Protocol):
    """The session that is being run (`Hub`). Attributes that only the hub sets are properties."""

    begun: bool
    """Whether the participant has pressed Begin since the server started or the page came back."""
    state: LiveSession
    """The session's state: the events of the log, replayed."""
    chooser: Any
    """Proposes the trials (`LiveChooser`)."""
    compute: ThreadPoolExecutor
    """The thread in which trials are chosen."""
    tag: str
    """Prefix of the trials' names in browsers."""
    gap: float
    """Pause between two trials, s."""
    delays: list[dict[str, float]]
    """Seconds from each answer to the next active parameters, by part."""
    without_map: str
    """Why there is no map, as a sentence; empty where there is one."""
    alert: str | None
    """Why the log cannot be written."""
    trust: list[list[str]]
    """Names and values that say how reliable the map is."""
    invite: Callable[[Role], dict[str, str]] | None
    """Makes a new link for a role."""

    @property
    def rig(self) -> Rig:
        """Presents the renderings; available once the hub is open."""
        ...

    @property
    def runner(self) -> RunnerInterface:
        """The task that presents trials."""
        ...

    @property
    def watchers(self) -> WatchersInterface:
        """The open pages and programs."""
        ...

    @property
    def warm(self) -> asyncio.Future:
        """Done when everything that the session needs is compiled."""
        ...

    @property
    def recent(self) -> Sequence[Event | Notice]:
        """The latest events, and unsolicited messages of the device, which are not in the log; newest first."""
        ...

    @property
    def lost(self) -> bool:
        """Whether the log's file is lost; nothing is presented any more."""
        ...

    @property
    def fault(self) -> str | None:
        """What fails in watching for interruptions, as a sentence; None while all works."""
        ...

    @property
    def draws(self) -> bool:
        """Whether the map is compiled, so that slices are available."""
        ...

    async def commit(self, make: Callable[[LiveSession, float], Event | None], *, mine: bool = False) -> Any:
        """Call `make(state, time in s)` with the newest state, write the event that it makes to the log, apply it, and
        return it; None, with nothing written, if it makes none. `mine`: the runner itself asks, and is not restarted.
        Raises what `make` raises, and `LogError`."""

    async def check_log(self) -> None:
        """Check that the log's file is still the open log; set `lost` and stop presenting if it is not."""
        ...

    async def map(self) -> dict[str, Any] | None:
        """Slices of the posterior (`Maps.slices`); None if there are none to show, empty before they are compiled."""
        ...

    def publish(self) -> None:
        """Notify all open pages and programs that there is a newer view."""
